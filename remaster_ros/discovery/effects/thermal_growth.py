"""Thermal growth: the arm warms up and all of it becomes longer."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from remaster_ros.discovery.effects.base import Cell, Design, Effect, displaced
from remaster_ros.discovery.effects.context import Context
from remaster_ros.types import FloatArray

# Growth with time is rarer by so much where the temperature is recorded.
BESIDE_TEMPERATURE = 50


def cells(context: Context) -> Iterator[Cell]:
    """The whole arm, and each link, in proportion to warming and to time."""
    drivers = {}
    if context.has_temperature:
        drivers['temperature'] = '1/K'
    if context.has_time:
        drivers['time'] = '1/s'
    arm: tuple[int, ...] = ()
    parts = [arm, *((link,) for link in context.links() if _has_length(context, link))]
    for driver, unit in drivers.items():
        for joints in parts:

            def columns(
                context: Context, driver: str = driver, joints: tuple[int, ...] = joints
            ) -> Design:
                amount = context.warming if driver == 'temperature' else context.elapsed_s
                links = joints or tuple(range(context.joints + 1))
                return displaced(amount[:, None] * sum(link_vector(context, j) for j in links))

            yield Cell(
                name=EFFECT.name,
                joints=joints,
                place=EFFECT.place,
                driver=driver,
                form=EFFECT.form,
                parameters=(f'growth_{joints[0]}' if joints else 'growth',),
                unit=unit,
                columns=columns,
                # The whole arm first: that one link alone grows is rare. And where the
                # temperature is known, what time explains beyond it is hardly growth.
                drawn_from=(2 if not joints else 4 * len(parts))
                * (BESIDE_TEMPERATURE if driver == 'time' and len(drivers) > 1 else 1),
            )


def link_vector(context: Context, link: int) -> FloatArray:
    """Return a link's vector in R, from joint ``link`` to the next, m, (n, 3)."""
    shift = context.chain.T_fixed[link][:3, 3]
    if link == 0:
        return np.broadcast_to(shift, (len(context), 3))
    return context.link_rotation(link) @ shift


def _has_length(context: Context, link: int) -> bool:
    return bool(np.linalg.norm(context.chain.T_fixed[link][:3, 3]) > 1e-3)


def needs_warming(context: Context) -> str:
    """Say why growth cannot be tested; '' where it can."""
    if context.has_temperature or context.has_time:
        return ''
    return 'neither temperature nor time varies'


EFFECT = Effect(
    name='thermal_growth',
    place='link_translation',
    driver='temperature',
    form='linear',
    equation='δp = α ΔT Σ_j L_j(q), ΔT since the first row (or time, where that fits better)',
    source='ISO 230-3; aluminium 23e-6/K',
    unit='1/K',
    plausible=(1e-6, 1e-4),
    sentence='The arm grows with {driver} (it warms up while measuring).',
    separate_by='the same poses repeated cold and warm, with the temperature recorded',
    cells=cells,
    needs=needs_warming,
)
