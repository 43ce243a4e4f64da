"""Registration drift: the sensor's frame creeps against the robot's base."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from remaster_ros.discovery.effects.base import Candidate, Design, Effect, displaced, needs_time
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.sizes import along_mean, length
from remaster_ros.types import FloatArray


def candidates(context: Context) -> Iterator[Candidate]:
    """Yield two candidates for each sensor: a steady shift of its frame; a shift and a turn.

    None for sensors of the kind 'controller'.
    """
    for index, name in context.sensors('controller'):
        mine = context.seen_by(index) & context.to_fit
        # The registration is that of the middle of the readings.
        middle = float(context.elapsed_s[mine].mean()) if mine.any() else 0.0
        shifts = [f'drift_{axis}_{name}' for axis in 'xyz']
        turns = [f'drift_r{axis}_{name}' for axis in 'xyz']
        for variant, parameters in (('shift', shifts), ('shift and turn', shifts + turns)):
            yield EFFECT.candidate(
                partial(_crept, sensor=index, middle=middle, turning=parameters != shifts),
                parameters,
                drawn_from=2 * len(context.sensor_names),
                variant=variant,
                subject=name,
            )


def _crept(context: Context, sensor: int, middle: float, turning: bool) -> Design:
    """Return columns of a sensor's steady shift (and turn, if `turning`), zero at `middle`, s."""
    return _columns(context, sensor, context.elapsed_s - middle, turning)


def _columns(context: Context, sensor: int, passed_s: FloatArray, turning: bool) -> Design:
    """Return columns of a sensor's shift in proportion to a time, and of its turn if `turning`.

    ``passed_s``: the time in each row, s, (n,). Along and about the axes of the sensor's frame;
    turns are about the centre of its points, rad/s. 0 in rows of other sensors.
    """
    amount = (passed_s * context.seen_by(sensor))[:, None]
    axes = [context.sensor_turn[:, :, axis] for axis in range(3)]
    shifts = [amount * axis for axis in axes]
    if turning:
        # A turn seen at one metre, which has the unit of the shifts.
        arms = context.points - context.centers[sensor]
        shifts += [amount * np.cross(axis, arms) for axis in axes]
    return displaced(*shifts)


def _began(context: Context, candidate: Candidate, gap: FloatArray, ends: bool) -> Design:
    """Return columns of a sensor's drift, in proportion to the time since the middle of a gap.

    0 before that moment, so that a drift begins or becomes faster there; with ``ends`` 0 after
    it, so that the drift ends. ``gap``: start and end, s since the first row, (2,).
    """
    since_s = context.elapsed_s - gap.mean()
    since_s = np.minimum(since_s, 0.0) if ends else np.maximum(since_s, 0.0)
    sensor = context.sensor_names.index(candidate.subject)
    return _columns(context, sensor, since_s, candidate.size > 3)


def _moved_by(context: Context, candidate: Candidate, draws: FloatArray) -> str:
    """Phrase for how far a sensor moves in the whole session.

    ``draws``: of its speeds, (draws, 3 or 6); the first three are m/s along its axes.
    """
    hours = float(np.ptp(context.elapsed_s)) / 3600.0
    way = along_mean(draws[:, :3]) * hours * 3600.0
    return f'{candidate.subject} moves by {length(way)} in {hours:.1f} h'


EFFECT = Effect(
    name='registration_drift',
    place='sensor_frame',
    driver='time',
    form='linear',
    equation='δp = v (t − t̄) (+ ω (t − t̄) × (p − centroid)), in the sensor frame N',
    source='tripod and mount creep; ISO 10360-10 drift checks',
    unit='m/s',
    plausible=(1e-10, 2e-6),
    sentence='{subject} creeps against the robot base while measuring.',
    separate_by='fixed reference markers measured again and again, and poses repeated in time',
    remedy='Fix the mount of the sensor, let the sensor warm up, and watch references while '
    'measuring.',
    size=_moved_by,
    candidates=candidates,
    changes=_began,
    needs=needs_time,
)
