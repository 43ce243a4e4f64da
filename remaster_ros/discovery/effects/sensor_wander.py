"""Sensor wander: errors that remember, from one reading to the next or over the whole session.

A shift of the sensor frame that is an Ornstein-Uhlenbeck process over the readings in their
order, by linear interpolation between knots, less its mean: the registration is that of the whole
session. It has no cause: a mount that creeps back and forth,
air that warms up, a tracker that filters; where it is fast, noise with memory.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
import scipy

from remaster_ros.discovery.effects.base import (
    Candidate,
    Design,
    Effect,
    along_axes,
    displaced,
    needs_time,
)
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.sizes import up_to
from remaster_ros.types import FloatArray

# Correlation lengths, as a share of the session.
LENGTHS = {'slow': 0.3, 'middling': 0.1, 'fast': 0.033}
KNOTS_PER_LENGTH = 2.0
FEWEST_READINGS = 20
RARITY = 3


def candidates(context: Context) -> Iterator[Candidate]:
    """Yield a slow, a middling and a fast random drift for each sensor with enough readings.

    Correlation lengths are `LENGTHS`, shares of the session's rows in the order of time
    (`Context.progress`), not of its duration. None for sensors of the kind 'controller' or with
    fewer than `FEWEST_READINGS` readings.
    """
    for index, name in context.sensors('controller'):
        mine = context.seen_by(index)
        if np.sum(mine) < FEWEST_READINGS:
            continue
        for variant, length in LENGTHS.items():
            knots = np.linspace(0.0, 1.0, 1 + int(np.ceil(KNOTS_PER_LENGTH / length)))
            correlation = np.exp(-np.abs(knots[:, None] - knots) / length)
            mean = _between(context, knots)[mine & context.to_fit].mean(axis=0)
            yield EFFECT.candidate(
                partial(_wandered, sensor=index, knots=knots, mean=mean),
                [
                    f'wander_{axis}_{variant}_{name}_{i}'
                    for i in range(len(knots))
                    for axis in 'xyz'
                ],
                # The three axes of a knot stand next to each other.
                penalty=np.kron(np.linalg.inv(correlation), np.eye(3)),
                drawn_from=RARITY * len(LENGTHS) * len(context.sensor_names),
                variant=variant,
                subject=name,
            )


def _between(context: Context, knots: FloatArray) -> FloatArray:
    """Weights (n, knots) of values at knots: linear interpolation at each row's `progress`."""
    # Linear: the splines' own knots stand once more at both ends.
    padded = np.concatenate((knots[:1], knots, knots[-1:]))
    matrix = scipy.interpolate.BSpline.design_matrix(context.progress, padded, 1)
    return np.asarray(matrix.toarray())


def _wandered(context: Context, sensor: int, knots: FloatArray, mean: FloatArray) -> Design:
    """Return columns of a sensor's shift along its three axes by the value at each knot.

    Linear between ``knots`` (shares of the session), less ``mean``, (knots,): mean of the weights
    over the sensor's rows to fit. 0 in rows of other sensors.
    """
    features = (_between(context, knots) - mean) * context.seen_by(sensor)[:, None]
    return displaced(*along_axes(features, context.sensor_turn))


EFFECT = Effect(
    name='sensor_wander',
    reported_as='unnamed',
    place='sensor_frame',
    driver='time',
    form='free',
    equation='δp = w(t) in the sensor frame, w an Ornstein-Uhlenbeck process over the readings',
    source='Uhlenbeck & Ornstein 1930, Phys. Rev. 36',
    unit='m',
    plausible=(1e-6, 5e-3),
    sentence='The errors of {subject} follow each other: a reading errs as the ones '
    'before it (serial correlation).',
    separate_by='fixed reference markers measured again and again, and poses repeated in time',
    remedy='Fix the mount of the sensor, let it warm up, and watch references while measuring.',
    size=up_to('{subject} wanders'),
    candidates=candidates,
    needs=needs_time,
    is_cause=False,
)
