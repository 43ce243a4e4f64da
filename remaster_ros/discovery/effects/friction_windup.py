"""Wind-up by friction: a joint lags behind its encoder by an angle with the sign of its speed."""

from __future__ import annotations

from collections.abc import Iterator

from remaster_ros.discovery.effects.base import Candidate, Effect, needs_motion
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.sizes import of_joint
from remaster_ros.types import FloatArray


def candidates(context: Context) -> Iterator[Candidate]:
    """Yield a candidate for each joint that turned: δq_j = w_j f_j + v_j (g_j - f_j).

    f_j, g_j: shares of friction, -1 to 1, that take the sign of the joint's velocity within a
    short and a long travel after a reversal (Dahl).
    """
    return EFFECT.at_joints(
        context,
        context.turning,
        lambda context, joint: [part[:, joint - 1] for part in context.motion.friction],
        ['windup_{joint}', 'late_windup_{joint}'],
        drawn_from=context.joints,
    )


def _wound(context: Context, candidate: Candidate, draws: FloatArray) -> str:
    """Phrase for how much a joint's angle differs between its two directions of motion.

    Twice the first parameter; ``draws``: rad, (draws, 2).
    """
    (joint,) = candidate.joints
    difference = of_joint(context, joint, 2.0 * draws[:, 0])
    return f'joint {joint} differs by {difference} between its two directions'


EFFECT = Effect(
    name='friction_windup',
    place='joint_angle',
    driver='sign_of_velocity',
    form='step',
    equation='δq_j = w_j f_j, δ df_j/dq_j = 1 − f_j sign(q̇_j) for travels δ of 1e-4 and 1e-3 rad',
    source='Dahl 1968, Aerospace Corp. TOR-0158; Taghirad & Bélanger 1998 (harmonic drives)',
    unit='rad',
    plausible=(1e-6, 5e-4),
    sentence='Friction winds up the gears of {subject}: the direction of motion changes the true '
    'angle.',
    separate_by='the same path there and back',
    remedy='Have the friction of the gearbox checked (grease, preload); where it must be exact, '
    'come from the same side.',
    size=_wound,
    candidates=candidates,
    needs=needs_motion,
)
