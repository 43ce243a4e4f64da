"""Backlash: where a joint stops depends on the side it came from."""

from __future__ import annotations

from collections.abc import Iterator

from remaster_ros.discovery.effects.base import Candidate, Effect, needs_approach
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.moments import switched
from remaster_ros.discovery.effects.sizes import of_joint
from remaster_ros.types import FloatArray


def candidates(context: Context) -> Iterator[Candidate]:
    """Yield a candidate for each joint that moved: δq_j = b_j sign(q_j - from_q_j).

    The parameter b_j is half the play, rad or m. The sign is that of the joint's last move.
    """
    return EFFECT.at_joints(
        context,
        context.moving,
        lambda context, joint: [context.approach[:, joint - 1]],
        ['half_backlash_{joint}'],
        drawn_from=context.joints,
    )


def _play(context: Context, candidate: Candidate, draws: FloatArray) -> str:
    """Phrase for the play of a joint: how far apart it stops coming from its two sides.

    ``draws``: of half the play, rad or m, (draws, 1).
    """
    joint = candidate.joints[0]
    return f'joint {joint} stops {of_joint(context, joint, 2.0 * draws[:, 0])} apart, side by side'


EFFECT = Effect(
    name='backlash',
    place='joint_angle',
    driver='approach',
    form='step',
    equation='δq_j = ½ B_j sign(q_j − from_q_j)',
    source='Nordin & Gutman 2002, Automatica 38',
    unit='rad',
    plausible=(1e-5, 2e-3),
    sign=1,
    sentence='Where a move of {subject} ends depends on the side it comes from (gear play).',
    separate_by='each pose approached from both sides, by small and by large moves',
    remedy='Approach every pose from the same side, and have the play of the gearbox adjusted.',
    slide_sentence='Where a move of {subject} ends depends on the side it comes from (play of a '
    'screw, rack or belt).',
    slide_remedy='Approach every pose from the same side, and have the play of the drive '
    'adjusted.',
    size=_play,
    candidates=candidates,
    changes=switched,
    needs=needs_approach,
)
