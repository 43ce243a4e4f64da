# SPDX-License-Identifier: Apache-2.0
"""A robot's controller as its pad shows it, and a person who does there what a file says.

It has code of its own: true angles, how the pad counts, and what mastering sets. Two kinds of
controllers: one keeps the zero of each motor (setting a joint changes what the pad shows of those
that are coupled to it), the other of each angle that it shows.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

PER_DEGREE = {'deg': 1.0, 'rad': math.pi / 180.0, 'gon': 10.0 / 9.0}
Keeps = Literal['motors', 'shown']


@dataclass
class Axis:
    """One joint: on the pad, and how the URDF's angle comes from there, degrees."""

    name: str
    joint: str
    sign: int = 1
    zero: float = 0.0
    added: tuple[str, int] | None = None


class Pad:
    """Angles in degrees inside; in ``unit`` for whoever looks at the pad."""

    def __init__(
        self, axes: Sequence[Axis], wrong: Mapping[str, float], unit: str, keeps: Keeps
    ) -> None:
        """Begin at true zero; ``wrong`` is what is missing in what each joint reports, degrees."""
        self.axes = {axis.name: axis for axis in axes}
        self.unit, self.keeps = unit, keeps
        self.true = dict.fromkeys(self.axes, 0.0)
        self.kept = dict.fromkeys(self.axes, 0.0)
        # A joint behind the one that is added to it.
        for name in sorted(self.axes, key=self._depth):
            axis = self.axes[name]
            missing = -axis.sign * wrong.get(axis.joint, 0.0)
            if keeps == 'shown' and axis.added:
                missing -= axis.added[1] * self.kept[axis.added[0]]
            self.kept[name] = missing

    def _depth(self, name: str) -> int:
        added = self.axes[name].added
        return 0 if added is None else 1 + self._depth(added[0])

    def _ideal(self, name: str) -> float:
        """Return what a pad with right zeros would show."""
        axis = self.axes[name]
        angle = axis.sign * (self.true[name] - axis.zero)
        return angle if axis.added is None else angle - axis.added[1] * self._ideal(axis.added[0])

    def _degrees(self, name: str) -> float:
        axis = self.axes[name]
        if self.keeps == 'shown':
            return self._ideal(name) + self.kept[name]
        angle = axis.sign * (self.true[name] - axis.zero) + self.kept[name]
        return (
            angle if axis.added is None else angle - axis.added[1] * self._degrees(axis.added[0])
        )

    def shows(self, name: str) -> float:
        """Return what the pad shows of a joint."""
        return self._degrees(name) * PER_DEGREE[self.unit]

    def missing(self) -> dict[str, float]:
        """Return what each of the URDF's joints, as reported by the pad, lacks, degrees."""
        lacks = {}
        for name, axis in self.axes.items():
            shown = self._degrees(name)
            if axis.added is not None:
                shown += axis.added[1] * self._degrees(axis.added[0])
            lacks[axis.joint] = self.true[name] - (axis.sign * shown + axis.zero)
        return lacks

    def drive(self, name: str, angle: float) -> None:
        """Jog a joint until the pad shows an angle; what it shows of the others stays."""
        before = {other: self._degrees(other) for other in self.axes}
        before[name] = angle / PER_DEGREE[self.unit]
        for other in sorted(self.axes, key=self._depth):
            self.true[other] += self.axes[other].sign * (before[other] - self._degrees(other))

    def set(self, name: str, angle: float) -> None:
        """Master a joint where it stands: the pad shows this angle there from now on."""
        self.kept[name] += angle / PER_DEGREE[self.unit] - self._degrees(name)


def master_as_told(text: str, pad: Pad, only_zero: bool = False) -> None:
    """Do literally what remaster.txt says of the pad.

    With ``only_zero`` the controller sets nothing but 0, for which the file has other places.
    """
    lines = text.splitlines()
    if any('set that place as the joint' in line for line in lines):
        _master_plainly(lines, pad)
        return
    head = next(i for i, line in enumerate(lines) if line.split()[:3] == ['on', 'the', 'pad'])
    columns = re.split(r' {2,}', lines[head].strip())
    rows: dict[str, dict[str, str]] = {}
    together: list[list[str]] = []
    at_zero: dict[str, float] = {}
    table = lines[head + 1 : lines.index('', head)]
    for i, line in enumerate(table):
        if line.startswith('  Coupled: drive'):
            order = re.search(r'^ +set (.*): also where', table[i + 1])
            assert order is not None, table[i + 1]
            driven = re.search(r'drive (.*) to their angles first', line)
            assert driven is not None
            names = order[1].split(', then ')
            assert set(driven[1].split(' and ')) == set(names)
            together.append(names)
            continue
        instead = re.fullmatch(r'    (.+): (\S+) (deg|rad|gon)', line)
        if instead:
            assert instead[3] == pad.unit
            at_zero[instead[1]] = float(instead[2])
            continue
        cells = re.split(r' {2,}', line.strip())
        if len(cells) == len(columns):
            rows[cells[0]] = dict(zip(columns, cells, strict=True))
    assert rows
    coupled = {name for names in together for name in names}
    for names in [*together, *([name] for name in rows if name not in coupled)]:
        places = {
            name: [_angle(rows[name][key], pad) for key in ('drive to', 'set to')]
            for name in names
        }
        if only_zero:
            for name, place in places.items():
                if place[1] != 0.0:
                    places[name] = [at_zero[name], 0.0]
        for name in names:
            pad.drive(name, places[name][0])
        for name in names:
            pad.set(name, places[name][1])


def _angle(cell: str, pad: Pad) -> float:
    number, unit = cell.split()
    assert unit == pad.unit
    return float(number)


def _master_plainly(lines: Sequence[str], pad: Pad) -> None:
    """Drive each joint of the table to the angle in its last column, and set it to zero."""
    head = next(i for i, line in enumerate(lines) if line.split()[:1] == ['joint'])
    for line in lines[head + 1 : lines.index('', head)]:
        name, *numbers = line.split()
        pad.drive(name, float(numbers[-1]))
        pad.set(name, 0.0)
