"""Sensor field: errors that follow the place in a sensor's volume in any smooth way.

A Gaussian process over the position in the sensor frame, one for each axis, by a basis of kernels
at some places of the volume (subset of regressors); and a free form of the distance, along the
line of sight. It has no cause: it locates what no effect with a name explains, and the model that
is sampled contains it.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from functools import partial

import numpy as np
import scipy
from scipy.spatial.distance import cdist

from remaster_ros.discovery.effects.base import Candidate, Design, Effect, along_axes, displaced
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.sizes import up_to
from remaster_ros.discovery.effects.splines import basis, knot_vector, roughness
from remaster_ros.types import FloatArray

# Lengths of the kernel, of the RMS distance from the middle of the volume: about a quadratic and
# a quartic field.
LENGTHS = {'smooth': 1.5, 'fine': 0.7}
MOST_CENTERS = 30
RANGE_KNOTS = 8
POSES_PER_CENTER = 1.5
# A cause with a name that explains as much is the better answer.
RARITY = 20
JITTER = 1e-6


def candidates(context: Context) -> Iterator[Candidate]:
    """Yield three candidates for each sensor: a smooth field, a finer one, one of the distance.

    Fields are sums of Gaussian kernels over the sensor's volume; the third is a spline of the
    distance, along the line of sight. None for the kind 'controller' or with fewer than 6 poses.
    """
    for index, name in context.sensors('controller'):
        mine = context.seen_by(index)
        poses = len(np.unique(context.measurements.pose[mine]))
        count = min(MOST_CENTERS, int(poses / POSES_PER_CENTER))
        places = context.in_sensor[mine]
        spread = float(np.sqrt(np.mean(np.sum((places - places.mean(axis=0)) ** 2, axis=1))))
        if count < 4 or spread == 0.0:
            continue
        rarity = RARITY * (len(LENGTHS) + 1) * len(context.sensor_names)
        # A fixed seed: the centers are a property of the places.
        centers = _centers(places, count, np.random.default_rng(0))
        for variant, factor in LENGTHS.items():
            length = factor * spread
            kernel = _kernel(centers, centers, length) + JITTER * np.eye(len(centers))
            yield EFFECT.candidate(
                partial(_field, sensor=index, centers=centers, length=length),
                [
                    f'field_{axis}_{variant}_{name}_{i}'
                    for i in range(len(centers))
                    for axis in 'xyz'
                ],
                # The three axes of a center stand next to each other.
                penalty=np.kron(kernel, np.eye(3)),
                drawn_from=rarity,
                variant=variant,
                subject=name,
            )
        distance = context.range_m[mine]
        knots = knot_vector(distance.min(), distance.max(), np.ptp(distance) / RANGE_KNOTS)
        yield EFFECT.candidate(
            partial(_along_sight, sensor=index, knots=knots),
            [f'field_range_{name}_{i}' for i in range(len(knots) - 4)],
            # Its mean is free: bound to zero, what it lacked was a scale of the sensor.
            penalty=roughness(len(knots) - 4),
            drawn_from=rarity,
            variant='range',
            subject=name,
        )


def _centers(places: FloatArray, count: int, rng: np.random.Generator) -> FloatArray:
    """Return at most `count` k-means centres of positions (n, 3), m, (c, 3).

    Clusters without positions are left out, as if readings were repeated.
    """
    with warnings.catch_warnings():
        # Two centers that begin at readings of one place: one of them remains without any.
        warnings.filterwarnings('ignore', 'One of the clusters is empty')
        centers, nearest = scipy.cluster.vq.kmeans2(places, count, minit='++', rng=rng)
    occupied: FloatArray = centers[np.unique(nearest)]
    return occupied


def _kernel(places: FloatArray, centers: FloatArray, length: float) -> FloatArray:
    """Return the Gaussian kernel exp(-½ distance² / length²) of n places, c centres, (n, c)."""
    values: FloatArray = np.exp(-0.5 * cdist(places, centers, 'sqeuclidean') / length**2)
    return values


def _along_sight(context: Context, sensor: int, knots: FloatArray) -> Design:
    """Return columns of an error along a sensor's line of sight: one for each spline of the range.

    ``knots``: of the splines, m. 0 in rows of other sensors.
    """
    sight = context.in_sensor / np.maximum(context.range_m, 1e-3)[:, None]
    along = np.einsum('nij,nj->ni', context.sensor_turn, sight)
    along = along * context.seen_by(sensor)[:, None]
    return displaced(*(value[:, None] * along for value in basis(context.range_m, knots).T))


def _field(context: Context, sensor: int, centers: FloatArray, length: float) -> Design:
    """Return columns of a sensor's field: a shift along its three axes for each kernel.

    ``centers``: of the kernels, sensor frame, m, (c, 3); ``length``: of the kernel, m. 0 in rows
    of other sensors.
    """
    mine = context.seen_by(sensor)[:, None]
    features = _kernel(context.in_sensor, centers, length) * mine
    return displaced(*along_axes(features, context.sensor_turn))


EFFECT = Effect(
    name='sensor_field',
    reported_as='unnamed',
    place='sensor_frame',
    driver='position',
    form='free',
    equation='δp = f(p) in the sensor frame, f smooth: a Gaussian process',
    source='Kennedy & O’Hagan 2001, J. R. Stat. Soc. B 63; Quiñonero-Candela & Rasmussen 2005, '
    'J. Mach. Learn. Res. 6',
    unit='m',
    plausible=(1e-6, 5e-3),
    sentence='The errors follow the place in the view of {subject}.',
    separate_by='the same poses measured with the sensor moved and turned',
    remedy='Measure with the sensor somewhere else, and calibrate its lenses; the errors '
    'follow its volume.',
    size=up_to('{subject} errs'),
    candidates=candidates,
    is_cause=False,
)
