"""Clock drift: a sensor's clock runs fast or slow beside that of the joint states."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from remaster_ros.discovery.effects.base import Candidate, Design, Effect, displaced, needs_motion
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.sizes import number
from remaster_ros.types import FloatArray


def candidates(context: Context) -> Iterator[Candidate]:
    """Yield one candidate for each sensor, of a clock drift d, s/s: δp = J q̇ d (t - t̄).

    t̄: mean time of the sensor's rows to fit, s. A sensor without rows has one too, of zeros.
    """
    for index, name in enumerate(context.sensor_names):
        mine = context.seen_by(index) & context.to_fit
        middle = float(context.elapsed_s[mine].mean()) if mine.any() else 0.0
        yield EFFECT.candidate(
            partial(_moved_on, sensor=index, middle=middle),
            [f'clock_drift_{name}'],
            drawn_from=len(context.sensor_names),
            subject=name,
        )


def _moved_on(context: Context, sensor: int, middle: float) -> Design:
    """Return columns of a sensor's clock drift: marker velocity by time since `middle`, m per s/s.

    ``middle``: s since the first row. Rows of other sensors are 0.
    """
    seconds = (context.elapsed_s - middle) * context.seen_by(sensor)
    return displaced(context.marker_velocity * seconds[:, None])


def _fast(context: Context, candidate: Candidate, draws: FloatArray) -> str:
    """Phrase for how slow or fast a sensor's clock is, by draws of its drift, s/s, (draws, 1).

    In parts in a million: "mocap's clock is 12 ± 2 parts in a million slow".
    """
    parts = 1e6 * draws[:, 0]
    mean = float(parts.mean())
    what = 'slow' if mean >= 0.0 else 'fast'
    shown = number(abs(mean), float(parts.std()), '')
    return f"{candidate.subject}'s clock is {shown} parts in a million {what}"


EFFECT = Effect(
    name='clock_drift',
    place='sensor_frame',
    driver='velocity',
    form='linear',
    equation='δp = Σ_j J_j q̇_j d (t − t̄)',
    source='IEEE 1588: quartz clocks differ by up to 100 parts in a million',
    unit='s/s',
    plausible=(1e-7, 1e-4),
    sentence='The clock of {subject} runs at another rate than that of the joint states.',
    separate_by='a longer recording, which moves throughout',
    remedy='Synchronise the clocks of sensor and controller (PTP).',
    size=_fast,
    candidates=candidates,
    needs=needs_motion,
)
