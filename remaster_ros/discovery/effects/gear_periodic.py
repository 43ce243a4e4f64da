"""Gear periodic error: the teeth of a gearbox, many times per turn of the joint."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from remaster_ros.discovery.effects.base import Cell, Design, Effect, at_joint
from remaster_ros.discovery.effects.context import Context

# Lower orders are the encoder's. Twice the ratio of a 200:1 harmonic drive is the highest known.
LOWEST_ORDER = 3
HIGHEST_ORDER = 400


def cells(context: Context) -> Iterator[Cell]:
    """Sine and cosine at every whole order that the rows are enough to tell."""
    highest = int(min(HIGHEST_ORDER, 4 * len(context)))
    orders = range(LOWEST_ORDER, highest + 1)
    for joint in context.moving:
        for order in orders:

            def columns(context: Context, joint: int = joint, order: int = order) -> Design:
                phase = order * context.measurements.q[:, joint - 1]
                return at_joint(joint, np.sin(phase), np.cos(phase))

            yield EFFECT.cell(
                joints=(joint,),
                parameters=(f'sin{order}_{joint}', f'cos{order}_{joint}'),
                columns=columns,
                drawn_from=context.joints * len(orders),
                variant=str(order),
            )


EFFECT = Effect(
    name='gear_periodic',
    place='joint_angle',
    driver='own_angle',
    form='sin/cos',
    equation='δq_j = a sin(N q_j) + b cos(N q_j), N whole, 3 to 400',
    source='Tuttle & Seering 1996, IEEE Trans. Robot. Autom. 12 (harmonic drives)',
    unit='rad',
    plausible=(1e-5, 1e-3),
    sentence='The gearbox of {subject} runs unevenly, in step with its teeth.',
    separate_by='poses that step the joint finely through one period, all else held',
    cells=cells,
    cause_per='joints',
    costly=True,
)
