# SPDX-License-Identifier: Apache-2.0
"""Words of a column header: its unit, its axis and its kind (name, time, …)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain as flat

from remaster_ros.importing.units import split_unit

AXES = ('x', 'y', 'z')
TOKEN = re.compile(r'[^\W\d_]+|\d+|#')
_CAMEL = re.compile(r'(?<=[a-z])(?=[A-Z])|(?<=[XYZ])(?=[A-Z][a-z])')
# Surveyors' words for coordinates: east, north and up are right-handed, like X, Y and Z.
_AXIS_WORDS = {
    **dict.fromkeys(('rechtswert', 'easting', 'east', 'e', 'ost', 'ostwert'), 'x'),
    **dict.fromkeys(('hochwert', 'northing', 'north', 'n', 'nord', 'nordwert'), 'y'),
    **dict.fromkeys(('höhe', 'hoehe', 'height', 'elevation', 'elev', 'h'), 'z'),
}
# Words that a surveyed height has in addition, and X and Y do not have.
_SURVEYED = {'ortho', 'orthometric', 'ellipsoidal', 'ell', 'local', 'grid'}
# Words of headers, in the languages of the programs and pendants seen so far.
_WORDS = {
    'name': {
        *('name', 'point', 'pointname', 'pt', 'label', 'punkt', 'punktname', 'id', 'nr', 'no'),
        *('number', 'nummer', '#', 'index', 'observation', 'messpunkt', 'prüfpunkt', 'row', 'nom'),
    },
    'time': {
        *('time', 'timestamp', 'stamp', 't', 'zeit', 'datetime', 'zeitstempel', 'secs'),
        *('epoch', 'ts'),
    },
    'date': {'date', 'datum', 'fecha'},
    'clock': {'uhrzeit', 'clock', 'heure', 'hora', 'ora'},
    'pose': {'pose', 'goal', 'poses', 'ziel', 'zielpose'},
    'configuration': {'configuration', 'config', 'konfiguration'},
    'split': {'split', 'subset', 'partition'},
    'sensor': {'sensor', 'instrument', 'station'},
    'marker': {'marker', 'reflector', 'reflektor'},
    'temperature': {'temperature', 'temp', 'temperatur', 'ambient'},
    'samples': {'samples', 'shots', 'messungen'},
}
# Words for the owner of a clock: `ros time`, `controller time`.
_CLOCKS = {
    *('pc', 'ros', 'robot', 'system', 'sys', 'wall', 'host', 'log', 'unix', 'utc', 'local'),
    *('controller', 'msg', 'message', 'header', 'recv', 'receive', 'capture', 'measurement'),
}
_KINDS = {word: kind for kind, words in _WORDS.items() for word in words}


@dataclass(frozen=True)
class Header:
    """Words of a header in lower case, and its unit."""

    words: tuple[str, ...]
    unit: str

    @classmethod
    def of(cls, text: str) -> Header:
        """Words and numbers of a header, lower case (tcp, pos, 1 of ``tcpPos1``), and its unit."""
        name, unit = split_unit(text)
        words = TOKEN.findall(_CAMEL.sub(' ', name))
        return cls(tuple(word.lower() for word in words), unit)

    def kind(self) -> str:
        """Kind of a column other than joints and points; '' if it has none.

        'name', 'time', 'date', 'clock' (time of day), 'pose', 'configuration', 'split',
        'sensor', 'marker', 'temperature' or 'samples'.
        """
        words = [word for word in self.words if word not in ('s', 'c', 'ns', 'ms', 'air', 'nsec')]
        joined = ''.join(words)
        if joined in _KINDS:
            return _KINDS[joined]
        kinds = {_KINDS.get(word, '') for word in words}
        return next(iter(kinds)) if len(kinds) == 1 else _first_kind(words)


def _first_kind(words: Sequence[str]) -> str:
    """Kind of a header of several words, '' if unknown.

    Examples are `point name`, `time stamp` and `no of samples`.
    """
    kinds = [_KINDS.get(word, '') for word in words]
    if len(words) == 2 and kinds[0] in ('name', 'time') and kinds[1] in ('name', 'time'):
        return kinds[0]
    if len(words) == 2 and words[0] in _CLOCKS and kinds[1] == 'time':
        return 'time'
    if 'samples' in kinds:
        return 'samples'
    return 'temperature' if 'temperature' in kinds and len(words) <= 2 else ''


def with_axis(words: Sequence[str]) -> tuple[str, ...]:
    """Words of a header with each axis as a word of its own: 'p', 'x' for `px`, 'x' for `easting`.

    `px`, `posx`, `sx`, `dx`, `rx`, `tx` and `vx`, and the same of y and z, are split. Words
    that surveyors put before a height only (`grid`, `ellipsoidal`, …) are dropped, so that the
    headers of X, Y and Z differ in the axis alone.
    """
    words = [_AXIS_WORDS.get(word, word) for word in words if word not in _SURVEYED]
    split = (
        (word[:-1], word[-1]) if re.fullmatch(r'(?:p|pos|s|d|r|t|v)[xyz]', word) else (word,)
        for word in words
    )
    return tuple(flat.from_iterable(split))
