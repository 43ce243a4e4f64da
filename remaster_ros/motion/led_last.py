# SPDX-License-Identifier: Apache-2.0
"""Where an arm was led last, and whether it is reported there.

A report that is fresh, finite and plausible may still be wrong: positions that are frozen, say.
What was commanded is known without any report. An arm that is reported elsewhere is not led on
before a person has compared the report with the robot's own display.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from remaster_ros.motion.joint_units import JointUnits
from remaster_ros.types import FloatArray


class LedLast:
    """Memory of where the last command led the arm, for bridge and compensator.

    ``names, units``: of the joints; ``tolerance_rad``: an arm that is no further off is there;
    ``end``: where it was led before this process was started, rad or m, (k,), or between which
    places, (n, k); None if that is not known; ``confirms``: the service by which a person
    confirms the report.
    Attributes: ``end``: where the last command led, (k,); None if that is not known.
    """

    def __init__(
        self,
        names: Sequence[str],
        units: JointUnits,
        tolerance_rad: float,
        end: FloatArray | None,
        confirms: str,
    ) -> None:
        self._names, self._units, self._tolerance_rad = names, units, tolerance_rad
        self._confirms = confirms
        # Where the arm is, rad or m, (k,); several where it was held somewhere between them.
        self._places: tuple[FloatArray, ...] = () if end is None else tuple(np.atleast_2d(end))
        self._before: tuple[FloatArray, ...] = self._places
        # Where it is reported, which a person was asked to compare with the robot's display.
        self._asked: FloatArray | None = None

    @property
    def end(self) -> FloatArray | None:
        """Last commanded position, rad or m, (k,), or None; of several positions the last one."""
        return self._places[-1] if self._places else None

    def lead_to(self, *places: FloatArray) -> None:
        """Note a command that leads to a position, rad or m, (k,).

        Of several positions, the arm is at one of them or on the lines from each to the next.
        """
        self._before, self._places = self._places, places

    def take_back(self) -> None:
        """Forget the last command, which was not sent: the positions of the one before hold again.

        Of two commands in a row only the last one can be taken back.
        """
        self._places = self._before

    def differs(self, q: FloatArray, other: FloatArray) -> bool:
        """Whether two joint positions, (k,), are further apart than the tolerance.

        In any joint; of a slide the tolerance is as in `JointUnits`.
        """
        return self._units.largest(q - other) > self._tolerance_rad

    def elsewhere(self, q: FloatArray) -> str:
        """Message that the arm is reported elsewhere than it was led, with the remedy; '' if not.

        ``q``: where it is reported, rad or m, (k,). Elsewhere is farther than the tolerance
        from all positions of the last command and the lines between them; '' if none is known.
        """
        if not self._places:
            return ''
        end = self._nearest(q)
        if not self.differs(q, end):
            return ''
        units = self._units
        off = np.abs(q - end) > self._tolerance_rad * units.per_radian
        joints = ', '.join(
            f'{name} at {units.in_degrees(i, q[i])}, '
            f'{units.in_degrees(i, q[i] - end[i], sign="+")} from there'
            for i, name in enumerate(self._names)
            if off[i]
        )
        shown = 'positions' if any(units.slides) else 'angles'
        return (
            f'the arm is not reported where the last command led: {joints}; compare with the '
            f"robot's own display: where it shows the same {shown}, {self._confirms} confirms "
            'them; where it does not, joint_states are wrong: see to the driver first'
        )

    def _nearest(self, q: FloatArray) -> FloatArray:
        """Return the position nearest to `q`, (k,), of those led to and the lines between them.

        There must be one, else ValueError.
        """
        scale = self._units.per_radian
        found = list(self._places)
        for start, end in pairwise(self._places):
            way, gone = (end - start) / scale, (q - start) / scale
            length = float(way @ way)
            share = float(np.clip(way @ gone / length, 0.0, 1.0)) if length else 0.0
            found.append(start + share * (end - start))
        return min(found, key=lambda place: self._units.largest(q - place))

    def ask(self, q: FloatArray) -> None:
        """Note the reported position, (k,), that a person was asked to compare."""
        self._asked = q

    def confirm(self, q: FloatArray) -> str:
        """Accept a reported position, (k,), if a person was asked about it before.

        It is accepted as where the arm was led, and '' returned, if it is within the tolerance
        of the position that a person was asked about last, by `ask` or by the last call.
        Otherwise it is not accepted: ``q`` is now the position asked about, and what the
        person has to compare is returned (`elsewhere`; '' if the arm is where it was led).
        """
        asked, self._asked = self._asked, q
        if asked is None or self.differs(asked, q):
            return self.elsewhere(q)
        self._places, self._asked = (q,), None
        return ''

    def forget_question(self) -> None:
        """Forget the position that a person was asked about, if any."""
        self._asked = None
