"""Settling: a joint is measured before it has arrived, short by a share of its last move."""

from __future__ import annotations

from collections.abc import Iterator

from remaster_ros.discovery.effects.base import Candidate, Effect, needs_approach
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.moments import switched
from remaster_ros.discovery.effects.sizes import largest, of_joint, span_of
from remaster_ros.types import FloatArray


def candidates(context: Context) -> Iterator[Candidate]:
    """Yield a candidate for each joint that moved: δq_j = -s_j (q_j - from_q_j), 0 if unknown."""
    return EFFECT.at_joints(
        context,
        context.moving,
        lambda context, joint: [-context.last_move[:, joint - 1]],
        ['settling_{joint}'],
        drawn_from=context.joints,
    )


def _short(context: Context, candidate: Candidate, draws: FloatArray) -> str:
    """Phrase for how far a joint stays short of its target after its largest move.

    ``draws``: of the missing share of a move, (draws, 1).
    """
    joint = candidate.joints[0]
    move = largest(context.last_move[:, joint - 1])
    short = of_joint(context, joint, draws[:, 0] * move)
    return f'joint {joint} is {short} short after {span_of(context, joint, move)}'


EFFECT = Effect(
    name='settling',
    place='joint_angle',
    driver='last_move',
    form='linear',
    equation='δq_j = −s_j (q_j − from_q_j)',
    source='creep and position error of a first-order servo after a move',
    unit='rad/rad',
    plausible=(1e-5, 1e-2),
    sign=1,
    sentence='When measured, {subject} had not arrived: a share of the last move was missing '
    '(wait longer).',
    separate_by='longer waiting before each measurement, and large moves from both sides',
    remedy='Wait longer before each measurement, and in use before each action that must be '
    'exact; check the integral gain of the servo.',
    size=_short,
    candidates=candidates,
    changes=switched,
    needs=needs_approach,
)
