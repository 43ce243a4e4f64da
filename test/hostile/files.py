# SPDX-License-Identifier: Apache-2.0
"""Files from strangers: valid ones, spoilt, and the readers that must refuse or read them.

Every reader has one exception, `InputError`, whose text is one line; whatever else comes out is a
fault. The processor time of every single read is bounded.
"""

from __future__ import annotations

import random
import re
import time
import tracemalloc
import warnings
from collections.abc import Callable
from pathlib import Path

from remaster_ros.errors import InputError
from remaster_ros.kinematics.serial_chain import SerialChain

TIME_LIMIT_S = 3.0
"""Processor time of one read; the valid files take a few milliseconds."""
MEMORY_LIMIT = 64 * 1024**2

_NUMBER = re.compile(rb'-?[0-9]+(?:\.[0-9]*)?(?:[eE][-+]?[0-9]+)?')
_NUMBERS = (
    b'', b'0', b'-1', b'nan', b'.nan', b'inf', b'-.inf', b'1e999', b'1e308', b'-1e-320', b'1_0',
    b'0x10', b'9' * 25, b'9' * 5000, b'1,5', b'true', b'"7"', b'null', b'[]',
    b'4611686018427387904', '٣'.encode(),
)  # fmt: skip
_PIECES = (
    b'\0', b'\xff', b'\xed\xa0\x80', b'\xe2\x80\xa8', b'\r', b'\t', b'"', b"'", b',', b':', b'- ',
    b'*a', b'&a [*a]', b'!!python/object/apply:os.system [id]', b'!!binary x', b'<<: {a: 1}',
    b'? [1]\n: 2\n', b'---\n', b'%YAML 9.9\n', b'[' * 3000, b'{' * 3000, b'{"a":' * 3000,
    b'<!DOCTYPE a [<!ENTITY b "c">]>', b'&b;', b'&#0;', b'<a>' * 3000, b'<![CDATA[', b'-->',
    b'x' * 70_000, b'\n' * 1000,
)  # fmt: skip


class Spoiler:
    """Spoils the bytes of a file: flips, cuts, doubled and swapped lines, numbers, oddities."""

    def __init__(self, rng: random.Random) -> None:
        self._rng = rng
        self._ways = (self._flip, self._number, self._number, self._piece, self._lines, self._cut)

    def __call__(self, data: bytes) -> bytes:
        """Return a spoilt copy."""
        for _ in range(self._rng.choice((1, 1, 1, 2, 4))):
            data = self._rng.choice(self._ways)(data)
        return data

    def _flip(self, data: bytes) -> bytes:
        changed = bytearray(data)
        for _ in range(self._rng.choice((1, 1, 4))):
            if changed:
                changed[self._rng.randrange(len(changed))] ^= 1 << self._rng.randrange(8)
        return bytes(changed)

    def _number(self, data: bytes) -> bytes:
        found = list(_NUMBER.finditer(data))
        if not found:
            return data
        where = self._rng.choice(found)
        return data[: where.start()] + self._rng.choice(_NUMBERS) + data[where.end() :]

    def _piece(self, data: bytes) -> bytes:
        at = self._rng.randrange(len(data) + 1)
        return data[:at] + self._rng.choice(_PIECES) + data[at:]

    def _lines(self, data: bytes) -> bytes:
        lines = data.splitlines(keepends=True)
        if not lines:
            return data
        a, b = self._rng.randrange(len(lines)), self._rng.randrange(len(lines))
        way = self._rng.choice(('delete', 'double', 'swap'))
        if way == 'delete':
            del lines[a]
        elif way == 'double':
            lines.insert(b, lines[a])
        else:
            lines[a], lines[b] = lines[b], lines[a]
        return b''.join(lines)

    def _cut(self, data: bytes) -> bytes:
        a = self._rng.randrange(len(data) + 1)
        b = min(len(data), a + self._rng.choice((1, 1, 5, 50, len(data))))
        return data[:a] + data[b:]


def check_read(read: Callable[[], object], measure_memory: bool = False) -> bool:
    """Read once; return whether it was accepted, and fail on anything but `InputError`.

    Raises
    ------
    AssertionError
        Another exception, a warning, an error of more than one line, or too much time or memory.
    """
    if measure_memory:
        tracemalloc.start()
    begin = time.thread_time()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter('error')
            read()
        taken, message = True, ''
    except InputError as error:
        taken, message = False, str(error)
    finally:
        took = time.thread_time() - begin
        peak = tracemalloc.get_traced_memory()[1] if measure_memory else 0
        tracemalloc.stop()
    assert '\n' not in message, repr(message)
    assert len(message) < 2000, f'a message of {len(message)} characters'
    assert took < (10 if measure_memory else 1) * TIME_LIMIT_S, f'{took:.1f} s'
    assert peak < MEMORY_LIMIT, f'{peak / 1e6:.0f} MB'
    return taken


def spoil_and_read(
    path: Path, read: Callable[[], object], rng: random.Random, times: int
) -> tuple[int, int]:
    """Spoil one file again and again and read; return how many were taken and refused.

    The file is left as it was.

    Raises
    ------
    AssertionError
        As `check_read`; the text holds what the file held.
    """
    spoil = Spoiler(rng)
    original = path.read_bytes()
    taken = 0
    try:
        for _ in range(times):
            data = spoil(original)
            path.write_bytes(data)
            try:
                taken += check_read(read)
            except Exception as error:
                raise AssertionError(
                    f'{type(error).__name__}: {error}; {path.name} held {data[:20_000]!r}'
                ) from error
    finally:
        path.write_bytes(original)
    return taken, times - taken


def read_urdf(path: Path) -> SerialChain:
    """Read a URDF file as the session reader does."""
    from remaster_ros.session.files import decode_text, read_limited

    return SerialChain.from_urdf(decode_text(read_limited(path, 2**24, 'x'), path))
