"""Encoder scale: a joint turns a little more than it reports, in proportion."""

from __future__ import annotations

from collections.abc import Iterator

from remaster_ros.discovery.effects.base import Cell, Effect
from remaster_ros.discovery.effects.context import Context


def cells(context: Context) -> Iterator[Cell]:
    """One cell per joint: δq_j = s_j q_j."""
    return EFFECT.at_joints(
        context.moving,
        lambda context, joint: [context.measurements.q[:, joint - 1]],
        ['scale_{joint}'],
        drawn_from=context.joints,
    )


EFFECT = Effect(
    name='encoder_scale',
    place='joint_angle',
    driver='own_angle',
    form='linear',
    equation='δq_j = s_j q_j',
    source='Mooring, Roth & Driels 1991, Fundamentals of Manipulator Calibration, ch. 2',
    unit='rad/rad',
    plausible=(1e-6, 1e-2),
    sentence='The true turn of {subject} is not what is reported (gear ratio or encoder scale).',
    separate_by='poses that turn the joint through its whole range',
    cells=cells,
    family='encoder scales',
)
