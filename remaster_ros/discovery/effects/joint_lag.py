"""Joint lag: a joint's reports are later than where it is, more than those of the others."""

from __future__ import annotations

from collections.abc import Iterator

from remaster_ros.discovery.effects.base import Candidate, Effect, needs_motion
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.sizes import number
from remaster_ros.types import FloatArray


def candidates(context: Context) -> Iterator[Candidate]:
    """Yield a candidate for each joint that turned: δq_j = l_j q̇_j, l_j: delay of reports, s."""
    return EFFECT.at_joints(
        context,
        context.turning,
        lambda context, joint: [context.motion.velocity[:, joint - 1]],
        ['lag_{joint}'],
        drawn_from=context.joints,
    )


def _late(context: Context, candidate: Candidate, draws: FloatArray) -> str:
    """Phrase for how late or early a joint's reports are, ms, by draws, s, (draws, 1)."""
    late = 1e3 * draws[:, 0]
    mean = float(late.mean())
    shown = number(abs(mean), float(late.std()), ' ms')
    (joint,) = candidate.joints
    return f'the reports of joint {joint} are {shown} {"late" if mean >= 0.0 else "early"}'


EFFECT = Effect(
    name='joint_lag',
    place='joint_angle',
    driver='velocity',
    form='linear',
    equation='δq_j = l_j q̇_j',
    source='Siciliano et al. 2009, Robotics, ch. 8: the velocity error of a servo; bus cycles',
    unit='s',
    plausible=(1e-5, 5e-3),
    sentence='What is reported of {subject} is of another time than of the other joints.',
    separate_by='the joint moved by itself, at several speeds',
    remedy='Have the controller report measured positions of one moment; in use, allow for the '
    'lag in proportion to the speed, or stop before what must be exact.',
    size=_late,
    candidates=candidates,
    needs=needs_motion,
)
