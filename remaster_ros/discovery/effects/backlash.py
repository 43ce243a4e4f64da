"""Backlash: where a joint stops depends on the side it came from."""

from __future__ import annotations

from collections.abc import Iterator

from remaster_ros.discovery.effects.base import Cell, Effect, needs_approach
from remaster_ros.discovery.effects.context import Context


def cells(context: Context) -> Iterator[Cell]:
    """One cell per joint: δq_j = b_j sign(q_j - from_q_j)."""
    return EFFECT.at_joints(
        context.moving,
        lambda context, joint: [context.approach[:, joint - 1]],
        ['half_backlash_{joint}'],
        drawn_from=context.joints,
    )


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
    sentence='Where {subject} stops depends on the side it comes from (gear play).',
    separate_by='each pose approached from both sides, by small and by large moves',
    cells=cells,
    needs=needs_approach,
    family='backlashes',
)
