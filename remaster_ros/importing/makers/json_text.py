# SPDX-License-Identifier: Apache-2.0
"""JSON: a list of objects or of lists, an object of lists, or an object a line (JSON lines)."""

from __future__ import annotations

import json
import json.decoder
import json.scanner
import re
from bisect import bisect_left
from collections import Counter
from typing import Any

from remaster_ros.errors import InputError
from remaster_ros.importing.makers import records
from remaster_ros.importing.makers.named import NUMBER, UNUSED, NamedColumns, unexpected

_START = re.compile(r'\s*(?:\{\s*"|\[\s*[\[{])')


def read(text: str) -> NamedColumns | None:
    """Records of JSON or of JSON lines as named columns; None for other text.

    None also for a list in each line, a matrix as programs print it, or a single joint target of
    RAPID. Raises InputError, with the line, for damaged JSON, a key that is there twice, or
    JSON without records of equal keys.
    """
    if not _START.match(text):
        return None
    try:
        data = _Decoder(text).whole()
    except RecursionError:
        raise InputError('line 1: brackets within brackets without end') from None
    if data is None or _is_joint_target(data):
        return None
    found = records.read('JSON', data)
    if found is None:
        raise InputError(
            'line 1: JSON without a list of records with equal keys; one for each configuration, '
            'such as {"joints": […], "point": […]}, is expected'
        )
    return found


def _is_joint_target(data: Any) -> bool:
    """Whether decoded JSON is a joint target of RAPID: [[axes],[external axes]], one unused.

    `data`: numbers in it as text. A log of one line is JSON as well, of two lists of numbers; of
    several lines it is none.
    """
    if not isinstance(data, records.Items) or len(data) != 2:
        return False
    axes, external = data
    return isinstance(axes, records.Items) and any(
        isinstance(cell, str) and NUMBER.fullmatch(cell) and float(cell) == UNUSED
        for cell in (external if isinstance(external, records.Items) else ())
    )


class _Decoder(json.JSONDecoder):
    """JSON decoder that keeps numbers as text, and the line of each object and array."""

    def __init__(self, text: str) -> None:
        super().__init__(parse_float=str, parse_int=str, parse_constant=str)
        self._text = text
        self._ends = [match.start() for match in re.finditer('\n', text)]
        self.parse_array = self._array
        self.parse_object = self._object
        self.scan_once = json.scanner.py_make_scanner(self)  # type: ignore[attr-defined]

    def whole(self) -> Any:
        """Decoded value of the text; a list of all if it has several, the first an object.

        None if there are several values and the first is no object (a list in each line), or
        if text that begins with [[ is not JSON (a printed matrix). Raises InputError, with the
        line, for other text that is not JSON.
        """
        values = records.Items()
        at = 0
        blank = re.compile(r'[\s,]*')
        while (at := blank.match(self._text, at).end()) < len(self._text):  # type: ignore[union-attr]
            try:
                value, at = self.raw_decode(self._text, at)
            except json.JSONDecodeError as error:
                if not values and re.match(r'\s*\[\s*\[', self._text):
                    # Lists in lines that other programs print.
                    return None
                line = self._text.split('\n')[error.lineno - 1]
                raise unexpected(error.lineno, line, f'JSON ({error.msg})') from None
            values.append(value)
        if len(values) > 1 and not isinstance(values[0], records.Mapping):
            # A list in each line.
            return None
        values.line = 1
        return values[0] if len(values) == 1 else values

    def _line(self, at: int) -> int:
        """Line number, from 1, of an index into the text."""
        return bisect_left(self._ends, at) + 1

    def _array(self, at: tuple[str, int], scan_once: Any, **options: Any) -> Any:
        """Decode an array as `Items`, which has its line; return it and the index behind it.

        `at`: text, and index behind the opening bracket. The module json calls this, and its
        `scan_once` and `options` are passed on to its own function.
        """
        values, end = json.decoder.JSONArray(at, scan_once, **options)  # type: ignore[attr-defined]
        found = records.Items(values)
        found.line = self._line(at[1] - 1)
        return found, end

    def _object(self, at: tuple[str, int], *args: Any, **options: Any) -> Any:
        """Decode an object as `Mapping`, which has its line; return it and the index behind it.

        `at`: text, and index behind the opening brace. The module json calls this; of its
        further arguments `args` the hooks are not used. Raises InputError if a key is there
        twice.
        """
        strict, scan_once, memo = args[0], args[1], args[4] if len(args) > 4 else None
        pairs, end = json.decoder.JSONObject(  # type: ignore[attr-defined]
            at, strict, scan_once, None, lambda pairs: pairs, memo
        )
        line = self._line(at[1] - 1)
        for key, count in Counter(key for key, _ in pairs).items():
            if count > 1:
                raise unexpected(line, key, 'each key once')
        found = records.Mapping(pairs)
        found.line = line
        return found, end
