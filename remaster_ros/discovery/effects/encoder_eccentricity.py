"""Encoder eccentricity: a code disc off its axis reads wrong once and twice a turn."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from remaster_ros.discovery.effects.base import Candidate, Effect
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.sizes import up_to
from remaster_ros.types import FloatArray

# Orders tried together: the disc off centre, the disc or its bearing oval, both.
ORDERS = ((1,), (2,), (1, 2))


def candidates(context: Context) -> Iterator[Candidate]:
    """Yield candidates of waves of order 1, 2, and both together, for each joint that turned.

    An order is a sine and a cosine of the measured angle, with a parameter each.
    """
    for orders in ORDERS:
        yield from EFFECT.at_joints(
            context,
            context.turning,
            partial(_waves, orders=orders),
            [f'{wave}{order}_{{joint}}' for order in orders for wave in ('sin', 'cos')],
            drawn_from=context.joints * len(ORDERS),
            variant='+'.join(map(str, orders)),
        )


def _waves(context: Context, joint: int, orders: tuple[int, ...]) -> list[FloatArray]:
    """Return sin(h q) and cos(h q) of a joint's measured angle for each order h, (n,) each.

    ``joint``: 1-based.
    """
    angle = context.measurements.q[:, joint - 1]
    return [wave(order * angle) for order in orders for wave in (np.sin, np.cos)]


EFFECT = Effect(
    name='encoder_eccentricity',
    place='joint_angle',
    driver='own_angle',
    form='sin/cos',
    equation='δq_j = Σ_{h=1,2} a_h sin(h q_j) + b_h cos(h q_j)',
    source='Sanders et al., encoder eccentricity; Lou et al. 2014, Rev. Sci. Instrum. 85',
    unit='rad',
    plausible=(1e-5, 5e-3),
    sentence='The angle reading of {subject} errs once or twice per turn (encoder off centre).',
    separate_by='poses that turn the joint through its whole range, at the same gravity torque',
    remedy='Correct the angle by the wave that was found; where the wave is large, have the '
    'disc of the encoder centred.',
    size=up_to('joint {joint} errs'),
    candidates=candidates,
    in_family=lambda candidate: candidate.variant == '1+2',
)
