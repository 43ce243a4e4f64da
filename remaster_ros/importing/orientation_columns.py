# SPDX-License-Identifier: Apache-2.0
"""Columns of an orientation that was measured with a point, by their headers."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence

from remaster_ros.importing.columns import Columns, claim
from remaster_ros.importing.headers import AXES, Header, with_axis
from remaster_ros.importing.units import ANGLES

# Words for the position in a pose.
_PLACES = {'position', 'translation', 'pos', 'point', 't'}
_TURNED = {
    *('quaternion', 'quat', 'orientation', 'rotation', 'rot', 'q', 'rotvec', 'rvec', 'euler'),
}
# Names of three angles, in their order.
_ANGLES = (
    ('roll', 'pitch', 'yaw'),
    ('omega', 'phi', 'kappa'),
    ('alpha', 'beta', 'gamma'),
    *(tuple('xyz'), tuple('abc'), tuple('wpr')),
)
_AS_AXIS = {'i': 'x', 'j': 'y', 'k': 'z', 'r': 'w'}


def find_orientation(headers: Sequence[Header], taken: set[int], found: Columns) -> None:
    """Find the columns of an orientation measured with the points of a single marker.

    A quaternion whose headers have x, y, z, w goes into `found.orientations`; three angles, or
    a quaternion numbered 0 to 3 or 1 to 4, into `found.ambiguous_orientation`. `found` and
    `taken` are changed in place; nothing is done with no or several markers, or if several
    orientations are as likely.
    """
    groups: dict[tuple[str, ...], dict[str, int]] = defaultdict(dict)
    for i, header in enumerate(headers):
        if i not in taken and header.unit in ('', *ANGLES):
            stem, axis = _orientation_component(header.words)
            if axis:
                groups[stem].setdefault(axis, i)
    if len(found.points) != 1:
        return
    (marker,) = found.points
    complete = [
        tuple(columns[axis] for axis in names)
        for columns in groups.values()
        for names in ('xyzw', *_ANGLES, '0123', '1234')
        if {*columns} == {*names}
    ]
    if len(complete) > 1:
        # A log may also have the orientation that the robot reports of its tool.
        complete = [
            columns for columns in complete if _has_words_of_point(headers, found, columns)
        ]
    if len(complete) == 1:
        claim(found, complete[0], taken)
        if {*'xyzw'} in map(set, groups.values()):
            found.orientations[marker] = complete[0]
        else:
            found.ambiguous_orientation = complete[0]


def _has_words_of_point(headers: Sequence[Header], found: Columns, columns: Sequence[int]) -> bool:
    """Whether the headers of an orientation and of the point have the same other words.

    Words for axes, positions and rotations are not compared; `columns`: those of the
    orientation.
    """
    stems = [
        tuple(word for word in with_axis(headers[i].words) if word not in (*AXES, *_PLACES))
        for i in found.point[:1]
    ]
    return stems == [_orientation_component(headers[columns[0]].words)[0]]


def _orientation_component(words: tuple[str, ...]) -> tuple[tuple[str, ...], str]:
    """Other words of a header, and the orientation component that it names.

    The component is an angle such as 'roll', a letter, or a digit of a quaternion. () and ''
    if the header names none.
    """
    turned = {*words} & _TURNED
    for at, word in enumerate(words):
        other_words = tuple(w for w in (*words[:at], *words[at + 1 :]) if w not in _TURNED)
        if any(word in names for names in _ANGLES[:3]):
            return other_words, word
        if axis := re.fullmatch(r'(?:q|quat|orientation|rot|r)_?([xyz])|(?:q|quat)_?w', word):
            return other_words, axis[1] or 'w'
        if axis := re.fullmatch(r'q([ijkr])', word):
            return other_words, _AS_AXIS[axis[1]]
        if turned and re.fullmatch(r'[xyzw]|[0-4]', word):
            return other_words, word
        if len(words) == 1 and word in 'abcwpr':
            return other_words, word
    return (), ''
