"""Gear periodic error: the teeth of a gearbox, many times per turn of the joint."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from remaster_ros.discovery.effects.base import Candidate, Effect
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.sizes import angle
from remaster_ros.types import FloatArray

# Lower orders are the encoder's. Twice the ratio of a 200:1 harmonic drive is the highest known.
LOWEST_ORDER = 3
HIGHEST_ORDER = 400


def candidates(context: Context) -> Iterator[Candidate]:
    """Yield candidates of a wave, sine and cosine, for each joint that turned and each order.

    Orders are whole numbers of waves a turn, from `LOWEST_ORDER` to the lesser of `HIGHEST_ORDER`
    and four times the number of rows.
    """
    highest = int(min(HIGHEST_ORDER, 4 * len(context)))
    orders = range(LOWEST_ORDER, highest + 1)
    for order in orders:
        yield from EFFECT.at_joints(
            context,
            context.turning,
            partial(_waves, order=order),
            [f'sin{order}_{{joint}}', f'cos{order}_{{joint}}'],
            drawn_from=context.joints * len(orders),
            variant=str(order),
        )


def _waves(context: Context, joint: int, order: int) -> list[FloatArray]:
    """Return sine and cosine of `order` times a joint's (1-based) measured angle, (n,) each."""
    phase = order * context.measurements.q[:, joint - 1]
    return [np.sin(phase), np.cos(phase)]


def _wave(context: Context, candidate: Candidate, draws: FloatArray) -> str:
    """Text on the amplitude of a joint's wave, by draws of sine and cosine, rad, (draws, 2)."""
    amplitude = np.hypot(draws[:, 0], draws[:, 1])
    (joint,) = candidate.joints
    return f'joint {joint} errs by ±{angle(amplitude)}, {candidate.variant} times a turn'


EFFECT = Effect(
    name='gear_periodic',
    place='joint_angle',
    driver='own_angle',
    form='sin/cos',
    equation='δq_j = a sin(N q_j) + b cos(N q_j), N whole, 3 to 400',
    source='Tuttle & Seering 1996, IEEE Trans. Robot. Autom. 12 (harmonic drives)',
    unit='rad',
    plausible=(1e-5, 1e-3),
    sentence='The error of {subject} repeats a whole number of times a turn (teeth of a gear, or '
    'the turns or poles of the motor).',
    separate_by='poses that step the joint finely through one period, all else held',
    remedy='Compare the number with the ratio of the gear, and twice it: one that fits shows '
    'which part runs unevenly, and where it grows from session to session that part wears. One '
    'that fits nothing in this joint is a wave to correct, whatever its cause.',
    size=_wave,
    candidates=candidates,
    cause_per='joints',
    costly=True,
    many=True,
)
