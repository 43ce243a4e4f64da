"""Settling: a joint is measured before it has arrived, short by a share of its last move."""

from __future__ import annotations

from collections.abc import Iterator

from remaster_ros.discovery.effects.base import Cell, Effect, needs_approach
from remaster_ros.discovery.effects.context import Context


def cells(context: Context) -> Iterator[Cell]:
    """One cell per joint: δq_j = -s_j (q_j - from_q_j)."""
    return EFFECT.at_joints(
        context.moving,
        lambda context, joint: [-context.last_move[:, joint - 1]],
        ['settling_{joint}'],
        drawn_from=context.joints,
    )


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
    sentence='When measured, {subject} still lags by a share of the last move (wait longer).',
    separate_by='longer waiting before each measurement, and large moves from both sides',
    cells=cells,
    needs=needs_approach,
    family='settling joints',
)
