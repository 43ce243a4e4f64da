# SPDX-License-Identifier: Apache-2.0
"""Angles on a robot's teach pendant ("pad") and those of its URDF: sign, zero and coupling.

Of k joints, with the pad's angles p and the URDF's q,

    q = S (I + K) p + a

where S has the signs, row i of K the joints whose pad angles are added to that of joint i, and a
the URDF's angles at the pad's zero. A zero-offset δ of the URDF's joints (true angle = reported
angle + offset) is d = (S (I + K))⁻¹ δ on the pad: at any configuration the pad has to show d more
than it does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from remaster_ros.types import Controller, FloatArray


@dataclass(frozen=True, eq=False)
class PadAngles:
    """Linear map between the k joint angles on a teach pendant and those of the URDF, rad."""

    # S (I + K), (k, k), and its inverse, both of whole numbers
    matrix: FloatArray
    from_urdf: FloatArray
    zero: FloatArray  # a, rad, (k,)
    # Joint indices sorted so that each follows those whose angles are added to its angle
    order: tuple[int, ...]

    @classmethod
    def of(cls, controller: Controller | None, joint_names: Sequence[str]) -> PadAngles:
        """Return the map of a controller; joints that it does not name have equal angles.

        ``controller``: None gives the identity; ``joint_names``: of the URDF's k joints. Raises
        ValueError if a coupling names another joint, IndexError if couplings go in a circle
        (`coupled_in_circle`).
        """
        k = len(joint_names)
        matrix, zero = np.eye(k), np.zeros(k)
        joints = {} if controller is None else controller.joints
        for i, name in enumerate(joint_names):
            if name in joints:
                for other, share in joints[name].coupling.items():
                    matrix[i, joint_names.index(other)] += share
                matrix[i] *= joints[name].sign
                zero[i] = np.radians(joints[name].zero_deg)
        order: list[int] = []
        while len(order) < k:
            free = [
                i
                for i in range(k)
                if i not in order and all(j in order or j == i for j in np.flatnonzero(matrix[i]))
            ]
            order.append(free[0])
        return cls(matrix, np.round(np.linalg.inv(matrix)), zero, tuple(order))

    def to_urdf(self, pad: FloatArray) -> FloatArray:
        """Convert the pad's angles to the URDF's, rad, (..., k)."""
        return pad @ self.matrix.T + self.zero

    def to_pad(self, q: FloatArray) -> FloatArray:
        """Convert the URDF's angles to the pad's, rad, (..., k)."""
        return self.offsets_on_pad(q - self.zero)

    def offsets_on_pad(self, offsets: FloatArray) -> FloatArray:
        """Convert zero-offsets of URDF joints to what is added to pad angles, rad, (..., k)."""
        return offsets @ self.from_urdf.T

    def coupled(self, joint: int) -> tuple[int, ...]:
        """Return the indices of the joints whose pad angles are added to that of a joint.

        ``joint``: its index. All indices are from 0, the returned ones ascending; () if there
        are none.
        """
        return tuple(j for j in np.flatnonzero(self.matrix[joint]).tolist() if j != joint)


def pad_in_words(controller: Controller) -> list[str]:
    """Return each URDF joint angle as a formula of pad angles, one line per joint that differs."""
    lines = []
    for joint, pad in controller.joints.items():
        if pad.sign == 1 and pad.zero_deg == 0.0 and not pad.coupling:
            continue
        names: list[tuple[int, str]] = [(pad.sign, pad.name)]
        names += [(pad.sign * n, controller.joints[j].name) for j, n in pad.coupling.items()]
        text = ''.join(f' {"+" if sign > 0 else "-"} {name}' for sign, name in names)
        text = text.removeprefix(' + ') if pad.sign > 0 else f'-{text.removeprefix(" - ")}'
        zero = (
            f' {"+" if pad.zero_deg > 0.0 else "-"} {abs(pad.zero_deg):g}°' if pad.zero_deg else ''
        )
        lines.append(f'{joint} = {text}{zero}')
    return lines


def coupled_in_circle(coupling: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the name of a joint whose angle depends on itself through couplings; '' if none does.

    ``coupling``: name of a joint -> the joints whose pad angles are added to its angle.
    """
    for joint in coupling:
        reached, pending = set(), list(coupling[joint])
        while pending:
            other = pending.pop()
            if other not in reached:
                reached.add(other)
                pending += coupling.get(other, {})
        if joint in reached:
            return joint
    return ''
