# SPDX-License-Identifier: Apache-2.0
"""Steps on the robot's own pad that set the zero of each joint, in the pad's numbers.

At a position where the pad shows x it has to show y = x + d afterwards, with d the offset on the
pad (`PadAngles`), whatever the position is, and whether the controller stores the zero of the
motor or of the shown angle. With coupled joints, a new zero of the first may change what the pad
shows for the next. So they are all driven to their positions first, and are set there one after
the other without a move between, each after those that are added to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.kinematics.pad_angles import PadAngles
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.types import AngleUnit, BoolArray, Controller, FloatArray, PadJoint

# Units as in `importing.units`; digits with which rounding is less than 0.0001 degrees.
_PER_RAD = {'deg': 180.0 / np.pi, 'rad': 1.0, 'gon': 200.0 / np.pi}
_DIGITS = {'deg': 4, 'rad': 6, 'gon': 4, 'mm': 3}
_MM_PER_M = 1e3
# If the URDF's zero is out of reach, the position is a multiple of this, degrees or mm.
_STEP_DEG = 10.0
_STEP_MM = 10.0


@dataclass(frozen=True)
class MasteringStep:
    """Numbers on the robot's pad (teach pendant) with which the zero of one joint is set."""

    joint: str  # Name in the URDF
    pad_name: str
    unit: AngleUnit | Literal['mm']  # Unit on the pad; mm for a prismatic joint
    # False if the joint's own zero stays, and the pad's number changes with a coupled joint
    determined: bool
    # Offset of the URDF's joint and its standard deviation, degrees; mm for a prismatic joint
    offset: float
    std: float
    # Numbers on the pad at the position of setting, before and after, in `unit`
    drive_to: float
    set_to: float
    zero_in_reach: bool  # Whether the joint can be driven to where the pad shows 0 afterwards

    @property
    def slides(self) -> bool:
        """Whether the joint is prismatic."""
        return self.unit == 'mm'

    @property
    def digits(self) -> int:
        """Number of decimal places with which values are shown in the pad's unit."""
        return _DIGITS[self.unit]

    def shown(self, value: float) -> str:
        """Value in the pad's unit as the pad shows it, with its sign and `digits` decimals."""
        return f'{value:+.{self.digits}f}'

    def in_degrees(self, value: float) -> float:
        """An angle of the pad's unit in degrees. Raises ValueError for a prismatic joint."""
        if self.unit == 'mm':
            raise ValueError(f'{self.joint} slides: {value} mm is no angle')
        return float(np.degrees(value / _PER_RAD[self.unit]))

    @property
    def is_plain(self) -> bool:
        """Whether the pad has the URDF's name and unit, and the joint is set to 0."""
        return self.pad_name == self.joint and self.unit in ('deg', 'mm') and self.set_to == 0.0

    @property
    def to_set_zero(self) -> str:
        """Position to drive to if the controller can only set 0, as the pad shows it, in `unit`.

        It is `drive_to` less `set_to`.
        """
        return self.shown(self.drive_to - self.set_to)


def mastering(
    controller: Controller | None,
    chain: SerialChain,
    offsets: FloatArray,
    std: FloatArray,
    known: BoolArray,
) -> tuple[tuple[MasteringStep, ...], ...]:
    """Joints to set, in groups: drive to all positions of a group first, then set them in order.

    Parameters
    ----------
    controller
        How the pad counts the joints; None if as the URDF does, in degrees.
    chain
        The k joints of the URDF.
    offsets, std
        Zero-offsets of the URDF's joints, rad, m for prismatic joints, (k,).
    known
        Whether the data determine them, (k,); the others stay as they are.

    Raises
    ------
    InputError
        ``controller`` has a sign, a zero or a coupling for a prismatic joint.
    """
    pad = PadAngles.of(controller, chain.joint_names)
    applied = np.where(known, offsets, 0.0)
    change = pad.offsets_on_pad(applied)
    after = pad.to_pad(_places(chain, applied))
    before = after - change
    joints = {} if controller is None else controller.joints

    def zero_in_reach(i: int) -> bool:
        place = after.copy()
        place[i] = 0.0
        at, off = pad.to_urdf(place)[i], abs(applied[i])
        return bool(chain.lower[i] <= at - off and at + off <= chain.upper[i])

    def step(i: int) -> MasteringStep:
        name = chain.joint_names[i]
        shown = joints.get(name, PadJoint(name))
        # Of another one that is coupled to it as well.
        pad_setting = (
            shown.coupling or shown.sign != 1 or shown.zero_deg or change[i] != applied[i]
        )
        if chain.slides[i] and pad_setting:
            raise InputError(
                f"joint '{name}' slides, and the session's controller has a sign, a zero or a "
                'coupling of it, which are of angles: take that joint out of controller'
            )
        unit: AngleUnit | Literal['mm'] = 'mm' if chain.slides[i] else shown.unit
        per_rad = _MM_PER_M if unit == 'mm' else _PER_RAD[unit]
        to_shown = _MM_PER_M if unit == 'mm' else 180.0 / np.pi
        digits = _DIGITS[unit]
        # What is set is rounded first: the difference is what counts.
        set_to = round(per_rad * float(after[i]), digits)
        return MasteringStep(
            name,
            shown.name,
            unit,
            bool(known[i]),
            float(to_shown * offsets[i]),
            float(to_shown * std[i]),
            round(set_to + per_rad * float(before[i] - after[i]), digits) + 0.0,
            set_to + 0.0,
            zero_in_reach(i),
        )

    # Also a joint with a zero of its own that stays, where a coupled one's does not.
    moved = [i for i in range(len(chain)) if known[i] or change[i] != 0.0]
    return tuple(tuple(step(i) for i in group) for group in _coupled_groups(moved, pad))


def _places(chain: SerialChain, offsets: FloatArray) -> FloatArray:
    """True joint positions at which zeros are set, rad or m, (k,): 0, else mid-range.

    0 if plus and minus the joint's offset, (k,), are both within its limits; else the middle
    of the limits, rounded to 10 degrees or 10 mm. Limits of joints that turn are first cut to
    ±180 degrees.
    """
    turn = np.where(chain.slides, np.inf, np.pi)
    lower, upper = np.maximum(chain.lower, -turn), np.minimum(chain.upper, turn)
    step = np.where(chain.slides, _STEP_MM / _MM_PER_M, np.radians(_STEP_DEG))
    middle = step * np.round(0.5 * (lower + upper) / step)
    # There the joint reports 0 less its offset.
    reached = (lower <= -np.abs(offsets)) & (np.abs(offsets) <= upper)
    return np.where(reached, 0.0, middle)


def _coupled_groups(joints: Sequence[int], pad: PadAngles) -> list[list[int]]:
    """Groups of coupled joints (indices from 0), each joint after those that are added to it.

    A joint without a coupling is a group of its own. Sorted by the least index in each group.
    """
    groups: list[list[int]] = []
    for i in joints:
        coupled = [g for g in groups if any(i in pad.coupled(j) or j in pad.coupled(i) for j in g)]
        groups = [group for group in groups if group not in coupled]
        groups.append([i, *(j for group in coupled for j in group)])
    return sorted((sorted(group, key=pad.order.index) for group in groups), key=min)
