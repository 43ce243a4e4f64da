"""Inertial deflection: a joint gives way to the inertia of what it carries."""

from __future__ import annotations

from collections.abc import Iterator

from remaster_ros.discovery.effects.base import Candidate, Effect, needs_gravity, needs_motion
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.sizes import largest, of_joint
from remaster_ros.types import FloatArray


def candidates(context: Context) -> Iterator[Candidate]:
    """Yield a candidate for each revolute joint that moved in the rows to fit (`Context.turning`).

    δq_j = s_j τ_j, s_j: compliance to be fitted, rad/(N m); τ_j: torque of the links' inertia
    forces about the joint, N m.
    """
    return EFFECT.at_joints(
        context,
        context.turning,
        lambda context, joint: [context.motion.inertial_torque[:, joint - 1]],
        ['inertia_{joint}'],
        drawn_from=context.joints,
    )


def _gave_way(context: Context, candidate: Candidate, draws: FloatArray) -> str:
    """Phrase for a joint's deflection under its largest inertial torque in the session.

    ``draws``: of the compliance, rad/(N m), (draws, 1).
    """
    joint = candidate.joints[0]
    torque = largest(context.motion.inertial_torque[:, joint - 1])
    moved = of_joint(context, joint, draws[:, 0] * torque)
    return f'joint {joint} gives way by {moved} under {torque:.0f} N m of inertia'


EFFECT = Effect(
    name='inertial_deflection',
    place='joint_angle',
    driver='inertial_torque',
    form='linear',
    equation="δq_j = s_j τ_j(q, q̇, q̈), τ by the links' inertia forces −m a",
    source='Luh, Walker & Paul 1980, J. Dyn. Sys. Meas. Control 102; Spong 1987, ibid. 109',
    unit='rad/(N m)',
    plausible=(1e-6, 3e-4),
    sign=1,
    sentence='Acceleration bends {subject} (soft gearbox or bearing).',
    separate_by='the same path at two speeds: the deflection grows with their square',
    remedy='Accelerate less where it must be exact, and have gearbox and bearing checked for '
    'play; where the weight carried bends the joint too, correct that by its torque.',
    size=_gave_way,
    candidates=candidates,
    needs=lambda context: needs_motion(context) or needs_gravity(context),
)
