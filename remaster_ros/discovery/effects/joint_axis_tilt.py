"""Joint axis tilt: a joint's axis is not parallel or square to the one before as drawn."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from remaster_ros.discovery.effects.base import Candidate, Design, Effect, ModelChange, turned
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.sizes import along_mean, angle
from remaster_ros.types import FloatArray

# A tilt along the axis before is, with that joint's zero-offset, another name for a shift of the
# link: of the two the shift is the simpler.
RARITY = 3


def candidates(context: Context) -> Iterator[Candidate]:
    """Yield tilts of each joint but the first, about axes of its frame that are not its own axis.

    For each joint a candidate of all these axes together, and one of each axis alone.
    """
    for joint in range(2, context.joints + 1):
        directions = tilt_directions(context, joint)
        # A tilt has any direction; on a whole arm some of them are other names for a link's.
        for axes in (''.join(directions), *directions):
            rarity = 1 if len(axes) > 1 else RARITY * len(directions)
            turns = np.array([directions[axis] for axis in axes])
            yield EFFECT.candidate(
                partial(_tilted, joint=joint, axes=list(turns)),
                [f'tilt_{axis}_{joint}' for axis in axes],
                joints=(joint,),
                drawn_from=(context.joints - 1) * rarity,
                variant=axes,
                model_change=ModelChange(joint - 1, np.zeros((len(axes), 3)), turns),
            )


def _tilted(context: Context, joint: int, axes: list[FloatArray]) -> Design:
    """Return columns of tilts of a joint (1-based) about axes of its frame, rad per unit.

    ``axes``: unit vectors, (3,), in the joint's frame as fixed to the link before, ahead of the
    joint's own motion.
    """
    # Where the joint is before its own move: one that slides carries its frame's origin along.
    before = context.frames[:, joint - 2] @ context.chain.T_fixed[joint - 1]
    turn = before[:, :3, :3]
    return turned(context, [turn @ axis for axis in axes], before[:, :3, 3])


def tilt_directions(context: Context, joint: int) -> dict[str, FloatArray]:
    """Unit vectors of the joint's frame by name ('x', 'y', 'z'), without those along its axis.

    Along means within 26° of the line of the axis.
    """
    joint_axis = context.chain.axes[joint - 1]
    return {
        name: axis
        for name, axis in zip('xyz', np.eye(3), strict=True)
        if abs(axis @ joint_axis) < 0.9
    }


def _tilt(context: Context, candidate: Candidate, draws: FloatArray) -> str:
    """Text on the tilt of a joint's axis, by draws, rad, (draws, 1 or 2), and on its direction."""
    size = along_mean(draws) if candidate.size > 1 else draws[:, 0]
    axes = ' and '.join(candidate.variant)
    return f'the axis of joint {candidate.joints[0]} is tilted by {angle(size)} about {axes}'


EFFECT = Effect(
    name='joint_axis_tilt',
    place='link_rotation',
    driver='constant',
    form='constant',
    equation='δp = (R u φ) × (p − o_j), u ⊥ axis j, fixed to the link before joint j',
    source='Hayati & Mirmirani 1985, J. Robotic Systems 2 (the fifth parameter)',
    unit='rad',
    plausible=(1e-5, 2e-2),
    sentence='At {subject} the axis is tilted against its drawing.',
    separate_by='all joint solutions of each pose: the tilt changes sign with the branch',
    remedy='Load apply/robot_model.urdf: tilts, with the zero-offsets that belong to them.',
    size=_tilt,
    candidates=candidates,
    in_family=lambda candidate: candidate.size == 1,
)
