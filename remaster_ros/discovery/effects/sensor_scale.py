"""Sensor scale: a sensor measures lengths too long or too short, in proportion."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from remaster_ros.discovery.effects.base import Candidate, Design, Effect, displaced
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.moments import switched
from remaster_ros.discovery.effects.sizes import number
from remaster_ros.types import FloatArray


def candidates(context: Context) -> Iterator[Candidate]:
    """Yield candidates of a scale error for each sensor: in all directions, along z, or by axis.

    Trackers have the first only; sensors of the kind 'controller' have none.
    """
    x, y, z = np.eye(3)
    with_lens = context.sensors('tracker', 'controller')
    for index, name in context.sensors('controller'):
        for variant, directions, parameters in (
            ('', [x + y + z], [f'scale_{name}']),
            ('depth', [z], [f'scale_z_{name}']),
            ('by axis', [x, y, z], [f'scale_{axis}_{name}' for axis in 'xyz']),
        ):
            # Each direction of a tracker has the same measure: the wavelength of its laser.
            if variant and (index, name) not in with_lens:
                continue
            yield EFFECT.candidate(
                partial(_stretched, sensor=index, directions=directions),
                parameters,
                drawn_from=3 * len(context.sensor_names),
                variant=variant,
                subject=name,
            )


def _stretched(context: Context, sensor: int, directions: list[FloatArray]) -> Design:
    """Return columns of a sensor's scale error, m per unit, one for each of `directions`, (3,).

    A direction has the factor for each axis of the sensor's frame. 0 in rows of other sensors.
    """
    mine = context.seen_by(sensor)[:, None]
    return displaced(
        *(
            np.einsum('nij,nj->ni', context.sensor_turn, context.in_sensor * along * mine)
            for along in directions
        )
    )


def _long(context: Context, candidate: Candidate, draws: FloatArray) -> str:
    """Phrase for a sensor's scale error, mm per metre, for each axis if it has several.

    ``draws``: m/m, (draws, 1 or 3).
    """
    axes = [
        f' along {name.split("_")[1]}' if 'scale_' in name else '' for name in candidate.parameters
    ]
    if candidate.size == 1 and not candidate.variant:
        axes = ['']
    return ' and '.join(
        f'{candidate.subject} measures 1 m{axis} '
        f'{number(1e3 * abs(float(s.mean())), 1e3 * float(s.std()), " mm")} too '
        f'{"long" if s.mean() >= 0.0 else "short"}'
        for axis, s in zip(axes, draws.T, strict=True)
    )


EFFECT = Effect(
    name='sensor_scale',
    place='sensor_frame',
    driver='position',
    form='linear',
    equation='measured = (1 + s) p in the sensor frame, for all axes or one',
    source='camera calibration wands; ISO 10360-10',
    unit='m/m',
    plausible=(1e-6, 1e-2),
    sentence='{subject} measures lengths in the wrong scale (calibrate it again).',
    separate_by='a calibrated length bar in several places of the volume',
    remedy='Calibrate the sensor again, with a length standard of certified length.',
    size=_long,
    candidates=candidates,
    changes=switched,
)
