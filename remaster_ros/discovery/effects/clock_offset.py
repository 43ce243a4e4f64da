"""Clock offset: a sensor's stamps are late or early beside those of the joint states."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from remaster_ros.discovery.effects.base import Candidate, Design, Effect, displaced, needs_motion
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.sizes import number
from remaster_ros.types import FloatArray


def candidates(context: Context) -> Iterator[Candidate]:
    """Yield one candidate for each sensor: δp = J q̇ c.

    c: what has to be added to its stamps, s.
    """
    for index, name in enumerate(context.sensor_names):
        yield EFFECT.candidate(
            partial(_moved_on, sensor=index),
            [f'clock_offset_{name}'],
            drawn_from=len(context.sensor_names),
            subject=name,
        )


def _moved_on(context: Context, sensor: int) -> Design:
    """Return columns of a sensor's clock offset: marker velocity, m/s; 0 for other sensors."""
    return displaced(context.marker_velocity * context.seen_by(sensor)[:, None])


def _late(context: Context, candidate: Candidate, draws: FloatArray) -> str:
    """Phrase for how much later or earlier a sensor's stamps are than import assumed, ms.

    ``draws``: of the parameter of `candidates`, s, (draws, 1): stamps are earlier if positive.
    """
    late = -1e3 * draws[:, 0]
    mean = float(late.mean())
    what = 'later' if mean >= 0.0 else 'earlier'
    shown = number(abs(mean), float(late.std()), ' ms')
    return f"{candidate.subject}'s stamps are {shown} {what} than import took them to be"


EFFECT = Effect(
    name='clock_offset',
    place='sensor_frame',
    driver='velocity',
    form='linear',
    equation='δp = Σ_j J_j q̇_j c: the marker at a stamp is where the arm is c later',
    source='Furgale, Rehder & Siegwart 2013, IROS, doi:10.1109/IROS.2013.6696514',
    unit='s',
    plausible=(1e-5, 5e-3),
    sentence='The stamps of {subject} and of the joint states are of different times.',
    separate_by='the same path at several speeds',
    remedy='Synchronise the clocks of sensor and controller (PTP), or state the offset to what '
    'joins their data (import --clock-offset).',
    size=_late,
    candidates=candidates,
    needs=needs_motion,
)
