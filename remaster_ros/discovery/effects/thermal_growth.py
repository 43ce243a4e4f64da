"""Thermal growth: the arm warms up and all of it becomes longer."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from remaster_ros.discovery.effects.base import NO_TIMES, Candidate, Design, Effect, displaced
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.drivers import TEMPERATURE, Driver, driver_named, slow_drivers
from remaster_ros.discovery.effects.sizes import along_mean, length
from remaster_ros.types import FloatArray

# What grows by 1e-4 per K grows by this per s in a warm-up of 10 K in a quarter of an hour.
LARGEST_PER_S = 1e-6
# Growth with time is rarer by so much where the temperature is recorded.
BESIDE_TEMPERATURE = 50
# Time constants with which the arm may follow a thermometer that warms up before it, s: of a small
# joint housing to those of a large casting.
LAGS_S = (600.0, 1800.0, 5400.0)


def candidates(context: Context) -> Iterator[Candidate]:
    """Yield growth of the whole arm, and of each link, in proportion to temperature and to time.

    Each driver only if it varies. With temperature and times also growth of the whole arm by a
    temperature that lags, one for each of `LAGS_S`.
    """
    arm: tuple[int, ...] = ()
    parts = [arm, *((link,) for link in context.links() if _has_length(context, link))]
    for driver in slow_drivers(context):
        for joints in parts:
            # The whole arm first: that one link alone grows is rare. And where the temperature
            # is known, what time explains beyond it is hardly growth.
            is_extra = driver.name == 'time' and context.has_temperature
            yield EFFECT.candidate(
                partial(_grown, driver=driver, joints=joints),
                [f'growth_{joints[0]}' if joints else 'growth'],
                joints=joints,
                driver=driver.name,
                # An arm cools after work: with time it may shrink.
                **({'largest': LARGEST_PER_S} if driver.name == 'time' else {'sign': 1}),
                unit=f'1/{driver.unit}',
                drawn_from=(4 * len(parts) if joints else 2)
                * (BESIDE_TEMPERATURE if is_extra else 1),
            )

    if context.has_temperature and context.has_time:
        for lag in LAGS_S:
            yield EFFECT.candidate(
                partial(_grown, driver=lagging(lag), joints=arm),
                [f'growth_lag_{lag:.0f}'],
                driver='temperature',
                form='lagging',
                sign=1,
                variant=f'lag of {lag / 60.0:.0f} min',
                drawn_from=2 * len(LAGS_S),
            )


def lagging(lag_s: float) -> Driver:
    """Return a temperature driver that follows the thermometer with a time constant, s."""
    return replace(TEMPERATURE, value=lambda context: context.lagging_warming(lag_s))


def _grown(context: Context, driver: Driver, joints: tuple[int, ...]) -> Design:
    """Return the column of links that grow in proportion to a driver.

    ``joints``: numbers of the links, 0 for the base; () for all links and the base.
    """
    links = joints or range(context.joints + 1)
    return displaced(driver.value(context)[:, None] * sum(link_vector(context, j) for j in links))


def link_vector(context: Context, link: int) -> FloatArray:
    """Vector in R from joint ``link`` (0: the base) to the next joint, m, (n, 3)."""
    shift = context.chain.T_fixed[link][:3, 3]
    if link == 0:
        return np.broadcast_to(shift, (len(context), 3))
    return context.link_rotation(link) @ shift


def _has_length(context: Context, link: int) -> bool:
    """Whether the origins of a link's two joints are more than 1 mm apart."""
    return bool(np.linalg.norm(context.chain.T_fixed[link][:3, 3]) > 1e-3)


def needs_warming(context: Context) -> str:
    """Return the reason why growth cannot be tested; '' if temperature or time varies."""
    if context.has_temperature or context.has_time:
        return ''
    return 'neither temperature nor time varies' if context.timed else NO_TIMES


def _grown_by(context: Context, candidate: Candidate, draws: FloatArray) -> str:
    """Phrase for the growth of 1 m of a link (or the arm) over the range of the driver.

    ``draws``: relative growth per unit of the driver, (draws, 1).
    """
    part = f'of link {candidate.joints[0]}' if candidate.joints else 'of the arm'
    driver = driver_named(context, candidate.driver, 0)
    assert driver is not None
    span = float(np.ptp(driver.value(context)))
    grows = 'grows' if draws.mean() >= 0.0 else 'shrinks'
    amount = f'{span / driver.per_shown:.1f} {driver.shown_unit}'
    return f'1 m {part} {grows} by {length(along_mean(draws[:, :1]) * span)} over {amount}'


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
    remedy='Let the arm warm up before it must be exact, or correct its lengths by the '
    'temperature.',
    size=_grown_by,
    candidates=candidates,
    needs=needs_warming,
)
