"""Sensor distortion: straight lines come out bent, more so far from the sensor's axis."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from remaster_ros.discovery.effects.base import Candidate, Design, Effect, displaced
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.moments import switched
from remaster_ros.discovery.effects.sizes import up_to
from remaster_ros.types import FloatArray

# No lens distorts lengths about the sensor's origin, and in most rooms it resembles a scale.
SPHERE_RARITY = 20
# Name, form, unit, and axes where it has a parameter for each. About another centre c a lens errs
# by k r² (p − c) − 2 k (c · p) p to first order in c (Brown's decentring): its x and y are −k c.
VARIANTS = (
    ('radial', 'radial', '1/m^2', ''),
    ('radial angle', 'radial', 'm/m', ''),
    ('radial sphere', 'radial', '1/m^2', ''),
    ('radial off centre', 'radial', '1/m^2', 'kxy'),
    ('quadratic', 'quadratic', '1/m', 'xyz'),
)


def candidates(context: Context) -> Iterator[Candidate]:
    """Yield a candidate for each sensor that may have lenses, and each of `VARIANTS`.

    That is every sensor but those of the kinds 'tracker' and 'controller'.
    """
    for index, name in context.sensors('tracker', 'controller'):
        for variant, form, unit, axes in VARIANTS:
            kind = variant.replace(' ', '_')
            rarity = SPHERE_RARITY if variant == 'radial sphere' else 1
            yield EFFECT.candidate(
                partial(_bent, sensor=index, variant=variant),
                [f'{kind}_{axis}_{name}' for axis in axes] or [f'{kind}_{name}'],
                form=form,
                unit=unit,
                drawn_from=len(VARIANTS) * len(context.sensor_names) * rarity,
                variant=variant,
                subject=name,
            )


def _bent(context: Context, sensor: int, variant: str) -> Design:
    """Return columns of a sensor's distortion of a variant of `VARIANTS`; 0 for other sensors."""
    mine = context.seen_by(sensor)[:, None]
    return displaced(
        *(
            np.einsum('nij,nj->ni', context.sensor_turn, shift * mine)
            for shift in distortions(context.in_sensor, variant)
        )
    )


def distortions(p: FloatArray, variant: str) -> list[FloatArray]:
    """Return displacements by a distortion, one for each of its parameters, m per unit, (n, 3).

    ``p``: points in the sensor's frame, m, (n, 3); ``variant``: a name of `VARIANTS`, all but
    the first four taken for 'quadratic'.
    """
    across = p * (1.0, 1.0, 0.0)
    square = np.sum(across**2, axis=1)[:, None]
    if variant == 'radial':
        return [square * across]
    if variant == 'radial angle':
        return [square / np.maximum(p[:, 2:] ** 2, 1e-2) * across]
    if variant == 'radial off centre':
        decentred = [
            square * axis + 2.0 * across[:, [i]] * across for i, axis in enumerate(np.eye(3)[:2])
        ]
        return [square * across, *decentred]
    if variant == 'radial sphere':
        return [np.sum(p**2, axis=1)[:, None] * p]
    return [square * axis for axis in np.eye(3)]


EFFECT = Effect(
    name='sensor_distortion',
    place='sensor_frame',
    driver='position',
    form='quadratic, radial',
    equation='δp = k r² p with r the distance from the sensor axis (or origin), or k r² e',
    source='Brown 1971, Photogrammetric Engineering 37',
    unit='1/m^2',
    plausible=(1e-5, 1e-1),
    sentence='{subject} distorts towards the edge of its view (lens calibration).',
    separate_by='poses towards the edges of the sensor view, or the sensor moved and turned',
    remedy='Calibrate the lenses of the sensor again, and measure in the middle of its view. '
    'If it has none (a laser tracker, points that the controller computed), state its kind in '
    'session.yaml and search again.',
    size=up_to('{subject} errs'),
    candidates=candidates,
    changes=switched,
)
