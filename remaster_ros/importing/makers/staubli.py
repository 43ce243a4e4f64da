# SPDX-License-Identifier: Apache-2.0
"""Joint variables of Staubli's VAL 3 (.dtx and older data files in XML)."""

from __future__ import annotations

import re
from bisect import bisect_right
from collections import Counter

from remaster_ros.importing.makers.named import NUMBER, NamedColumns, axes_in_order, unexpected

_TAG = re.compile(r'<[^<>]*>')
_ATTRIBUTE = re.compile(r'([\w:]+)\s*=\s*"([^"]*)"')
# Attributes other than the joints.
_KNOWN = ('name', 'key', 'size', 'access', 'public', 'type', 'xsi:type')
_JOINT = re.compile(r'j\d+')


def read(text: str) -> NamedColumns | None:
    """Joints of a Staubli data file (VAL 3), degrees; None for other text.

    A joint that is not written is at 0. Elements of an array are named ``name[0]`` and so on.
    Raises InputError, with the line, for elements that cannot be read.
    """
    if not re.search(r'<[^<>]*\bj\d\s*=\s*"', text):
        return None
    found: list[tuple[int, str, dict[str, str]]] = []
    name, several = '', False
    without_key: list[tuple[int, str]] = []
    starts = [newline.end() for newline in re.finditer('\n', text)]
    for tag in _TAG.finditer(text):
        number = bisect_right(starts, tag.start()) + 1
        attributes = dict(_ATTRIBUTE.findall(tag[0]))
        if 'name' in attributes:
            name = attributes['name']
            several = attributes.get('size', '1') != '1'
        joints = {key.upper(): cell for key, cell in attributes.items() if _JOINT.fullmatch(key)}
        if not joints:
            continue
        other_text = _ATTRIBUTE.sub('', tag[0].partition(' ')[2]).strip(' \t\r\n/>')
        names = [match[1] for match in _ATTRIBUTE.finditer(tag[0])]
        # A joint that is not written is at 0: nothing else may stand there.
        if (
            other_text
            or len({*names}) < len(names)
            or not {*names} <= {*_KNOWN, *map(str.lower, joints)}
        ):
            raise unexpected(number, tag[0], 'j1="…" j2="…" once each and nothing else')
        if not all(NUMBER.fullmatch(cell.strip()) for cell in joints.values()):
            raise unexpected(number, tag[0], 'j1="…" j2="…" with a number each')
        key = attributes.get('key', '') if several else ''
        if 'key' not in attributes and 'name' not in attributes:
            without_key.append((len(found), name))
        found.append((number, f'{name}[{key}]' if key else name, joints))
    last = max((int(axis[1:]) for *_, joints in found for axis in joints), default=0)
    zeros = {f'J{i}': '0' for i in range(1, last + 1)}
    found = [(number, key, {**zeros, **joints}) for number, key, joints in found]
    # Elements of an array, where no keys are written.
    repeated, count = Counter(name for _, name in without_key), Counter[str]()
    for i, name in without_key:
        if repeated[name] > 1:
            found[i] = found[i][0], f'{name}[{count[name]}]', found[i][2]
            count[name] += 1
    for line, piece in enumerate(
        _TAG.sub(lambda tag: '\n' * tag[0].count('\n'), text).split('\n'), 1
    ):
        if re.search(r'\bj\d+\s*=|[<>]', piece):
            raise unexpected(line, piece, 'a whole element, <Value … j1="…" … />,')
    return axes_in_order('joints of VAL 3', found, ('J',), maker='Staubli')
