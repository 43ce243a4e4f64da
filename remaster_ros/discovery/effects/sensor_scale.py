"""Sensor scale: a sensor measures lengths too long or too short, in proportion."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from remaster_ros.discovery.effects.base import Cell, Design, Effect, displaced
from remaster_ros.discovery.effects.context import Context
from remaster_ros.types import FloatArray


def cells(context: Context) -> Iterator[Cell]:
    """Each sensor: one scale, one along its z axis (depth), or one per axis."""
    for index, name in enumerate(context.sensor_names):

        def stretch(context: Context, along: FloatArray, index: int = index) -> FloatArray:
            stretched = (context.in_sensor * along) * context.seen_by(index)[:, None]
            return np.einsum('nij,nj->ni', context.sensor_turn, stretched)

        def isotropic(context: Context, stretch=stretch) -> Design:  # type: ignore[no-untyped-def]
            return displaced(stretch(context, np.ones(3)))

        def depth(context: Context, stretch=stretch) -> Design:  # type: ignore[no-untyped-def]
            return displaced(stretch(context, np.eye(3)[2]))

        def by_axis(context: Context, stretch=stretch) -> Design:  # type: ignore[no-untyped-def]
            return displaced(*(stretch(context, axis) for axis in np.eye(3)))

        for variant, columns, parameters in (
            ('', isotropic, (f'scale_{name}',)),
            ('depth', depth, (f'scale_z_{name}',)),
            ('by axis', by_axis, tuple(f'scale_{axis}_{name}' for axis in 'xyz')),
        ):
            yield EFFECT.cell(
                joints=(),
                parameters=parameters,
                columns=columns,
                drawn_from=3 * len(context.sensor_names),
                variant=variant,
                subject=name,
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
    sentence='The sensor {subject} measures lengths in the wrong scale (calibrate it again).',
    separate_by='a calibrated length bar in several places of the volume',
    cells=cells,
)
