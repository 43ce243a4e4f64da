"""Joint coupling: one joint's angle depends on another's."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from remaster_ros.discovery.effects.base import Cell, Design, Effect
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.sizes import up_to


def cells(context: Context) -> Iterator[Cell]:
    """Joint j by every other joint l: linear, or sine and cosine."""
    count = 2 * context.joints * max(1, len(context.moving) - 1)
    for joint in range(1, context.joints + 1):
        for other in context.moving:
            if other == joint:
                continue
            pair = f'{joint}_by_{other}'
            for form, unit, parameters in (
                ('linear', 'rad/rad', [f'coupling_{pair}']),
                ('sin/cos', 'rad', [f'sin_{pair}', f'cos_{pair}']),
            ):
                yield EFFECT.cell(
                    partial(_followed, joint=joint, other=other, form=form),
                    parameters,
                    joints=(joint, other),
                    driver=f'angle_of_joint_{other}',
                    form=form,
                    unit=unit,
                    drawn_from=count,
                )


def _followed(context: Context, joint: int, other: int, form: str) -> Design:
    angle = context.measurements.q[:, other - 1]
    features = [angle] if form == 'linear' else [np.sin(angle), np.cos(angle)]
    return Design(joint - 1, np.stack(features, axis=-1))


EFFECT = Effect(
    name='joint_coupling',
    place='joint_angle',
    driver='other_angle',
    form='linear or sin/cos',
    equation='δq_j = c q_l, or a sin q_l + b cos q_l, l ≠ j',
    source='Sciavicco & Siciliano 2000, Modelling and Control, sec. 5 (coupled transmissions)',
    unit='rad/rad',
    plausible=(1e-6, 1e-2),
    sentence='The angle of {subject} follows the angle of {other} (coupled drives).',
    separate_by='poses that turn one of the two joints and hold the other',
    remedy='Check the coupling that is set in the controller for these joints; correct what '
    'is left by the angle of the other joint.',
    size=up_to('joint {joint} turns with joint {other}'),
    cells=cells,
    cause_per='joints',
    driven_by_joint=True,
)
