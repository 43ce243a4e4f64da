"""Joint coupling: one joint's angle depends on another's."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from remaster_ros.discovery.effects.base import Candidate, Design, Effect
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.drivers import driver_at
from remaster_ros.discovery.effects.sizes import up_to
from remaster_ros.types import FloatArray

# Of what is plausible the most.
LARGEST = 1e-2


def candidates(context: Context) -> Iterator[Candidate]:
    """Yield errors of each joint that depend on the position of each other joint that moved.

    For each pair one candidate in proportion, and one of sine and cosine if the other turns.
    """
    units, counts = context.chain.units, context.chain.per_radian
    count = 2 * context.joints * max(1, len(context.moving) - 1)
    for joint in range(1, context.joints + 1):
        for other in context.moving:
            if other == joint:
                continue
            pair = f'{joint}_by_{other}'
            joint_unit, of = units[joint - 1], units[other - 1]
            for form, unit, parameters, counted in (
                ('linear', f'{joint_unit}/{of}', [f'coupling_{pair}'], 1.0 / counts[other - 1]),
                ('sin/cos', joint_unit, [f'sin_{pair}', f'cos_{pair}'], 1.0),
            ):
                if form == 'sin/cos' and context.slides(other):
                    continue
                yield EFFECT.candidate(
                    partial(_followed, joint=joint, other=other, form=form),
                    parameters,
                    joints=(joint, other),
                    driver=driver_at(context, other, f'angle_of_joint_{other}'),
                    form=form,
                    unit=unit,
                    largest=LARGEST * counts[joint - 1] * counted,
                    slide=context.slides(joint) or context.slides(other),
                    drawn_from=count,
                )


def _followed(context: Context, joint: int, other: int, form: str) -> Design:
    """Return columns of a joint's error as a function of another joint's measured position.

    ``form``: 'linear' (1 column), else its sine and cosine (2 columns). Joints are 1-based.
    """
    angle = context.measurements.q[:, other - 1]
    features = [angle] if form == 'linear' else [np.sin(angle), np.cos(angle)]
    return Design(joint - 1, np.stack(features, axis=-1))


def _coupled(context: Context, candidate: Candidate, draws: FloatArray) -> str:
    """Phrase for the largest error: 'joint 3 turns with joint 2 by up to 1.1′ ± 0.3′'.

    ``draws``: of the candidate's parameters, (draws, 1 or 2).
    """
    verb = 'slides' if context.slides(candidate.joints[0]) else 'turns'
    return up_to(f'joint {{joint}} {verb} with joint {{other}}')(context, candidate, draws)


EFFECT = Effect(
    name='joint_coupling',
    place='joint_angle',
    driver='other_angle',
    form='linear or sin/cos',
    equation='δq_j = c q_l, or a sin q_l + b cos q_l, l ≠ j',
    source='Sciavicco & Siciliano 2000, Modelling and Control, sec. 5 (coupled transmissions)',
    unit='rad/rad',
    plausible=(1e-6, LARGEST),
    sentence='The angle of {subject} follows the angle of {other} (coupled drives).',
    separate_by='poses that move one of the two joints and hold the other',
    remedy='Check the coupling that is set in the controller for these joints; correct what '
    'is left by the angle of the other joint.',
    slide_sentence='The position of {subject} follows that of {other} (coupled drives).',
    slide_remedy='Check the coupling that is set in the controller for these joints; correct what '
    'is left by the position of the other joint.',
    size=_coupled,
    candidates=candidates,
    cause_per='joints',
    driven_by_joint=True,
)
