"""Step: something slipped or was bumped at one moment and stayed there.

The search tries moments spread over the session, and then all of them near the best
(`Effect.between`), in the gaps of the rows worked on (`moments`).
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from remaster_ros.discovery.effects.base import (
    Candidate,
    Design,
    Effect,
    along_axes,
    displaced,
    needs_time,
)
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.moments import after, gaps, spread
from remaster_ros.discovery.effects.sizes import along_mean, angle, length, of_joint
from remaster_ros.types import FloatArray

MOMENTS = 40
# A belt or a coupling that slips by more is seen without a measurement.
LARGEST_RAD = 2e-2


def candidates(context: Context) -> Iterator[Candidate]:
    """Yield steps at up to `MOMENTS` gaps between configurations, evenly spread over all gaps.

    At each gap: of each joint's zero and each marker; of each sensor, and all sensors as the
    base, a shift, and a shift with a turn.
    """
    yield from _in(context, spread(gaps(context), MOMENTS))


def between(context: Context, low: float, high: float) -> Iterator[Candidate]:
    """Yield the steps of `candidates`, at every gap between configurations from `low` to `high`.

    In s since the first row; gaps count that overlap this interval.
    """
    yield from _in(context, gaps(context, low, high))


def _in(context: Context, chosen: FloatArray) -> Iterator[Candidate]:
    """Yield steps in some gaps, (m, 2), s: of zero-offsets, markers, sensors, and all sensors.

    All sensors together, as the base, only if there are several. None of the kind 'controller'.
    """
    sensors: list[tuple[int, ...]] = [(index,) for index, _ in context.sensors('controller')]
    if len(sensors) > 1:
        sensors.append(tuple(index for (index,) in sensors))
    places = context.joints + len(context.marker_names) + 2 * len(sensors)
    for gap in chosen:
        moment = float(gap.mean())
        at = partial(EFFECT.candidate, moment=moment, drawn_from=MOMENTS * places)
        for joint in range(1, context.joints + 1):
            yield at(
                partial(_slipped, joint=joint, gap=gap),
                [f'joint_{joint}_step'],
                joints=(joint,),
                unit=context.chain.units[joint - 1],
                largest=LARGEST_RAD * context.chain.per_radian[joint - 1],
                slide=context.slides(joint),
            )
        for index, name in enumerate(context.marker_names):
            yield at(
                partial(_marker_moved, marker=index, gap=gap),
                [f'marker_{name}_step_{axis}' for axis in 'xyz'],
                place='marker',
                subject=name,
            )
        for seen_by in sensors:
            is_base = len(seen_by) > 1
            subject = '' if is_base else context.sensor_names[seen_by[0]]
            stem = f'{subject or "base"}_step'
            shifts, turns = ([f'{stem}_{kind}{axis}' for axis in 'xyz'] for kind in ('', 'r'))
            for variant, parameters in (('shift', shifts), ('shift and turn', shifts + turns)):
                yield at(
                    partial(
                        _sensor_moved,
                        sensors=seen_by,
                        gap=gap,
                        turning=parameters != shifts,
                    ),
                    parameters,
                    place='base_rotation' if is_base else 'sensor_frame',
                    variant=variant,
                    subject=subject,
                )


def _slipped(context: Context, joint: int, gap: FloatArray) -> Design:
    """Return the column of a joint (1-based) whose zero steps in a gap, (2,), s."""
    return Design(joint - 1, after(context, gap))


def _marker_moved(context: Context, marker: int, gap: FloatArray) -> Design:
    """Return columns of a marker that steps along the tool's axes in a gap, (2,), s."""
    mine = after(context, gap) * (context.marker == marker)[:, None]
    return displaced(*along_axes(mine, context.tool[:, :3, :3]))


def _sensor_moved(
    context: Context, sensors: tuple[int, ...], gap: FloatArray, turning: bool
) -> Design:
    """Return columns of sensors that shift (and turn, if `turning`) together in a gap, (2,), s.

    ``sensors``: their indices. Along the axes of the sensor, or of the base frame if there are
    several; turns are about the centre of their points.
    """
    mine = after(context, gap) * np.isin(context.sensor, sensors)[:, None]
    # Along the axes of the sensor, or of the base where all of them are concerned.
    turn = context.sensor_turn if len(sensors) == 1 else np.eye(3)[None]
    shifts = along_axes(mine, turn)
    if turning:
        # A turn seen at one metre, which has the unit of the shifts.
        arms = context.points - np.mean(context.centers[list(sensors)], axis=0)
        shifts += [np.cross(shift, arms) for shift in shifts]
    return displaced(*shifts)


def _jump(context: Context, candidate: Candidate, draws: FloatArray) -> str:
    """Phrase for the size of a step of a joint, sensor, marker or the base, with its direction.

    ``draws``: rad or m of a joint, (draws, 1); else shifts, m, and turns, rad, (draws, 3 or 6).
    """
    if candidate.place == 'joint_angle':
        return (
            f'joint {candidate.joints[0]} by {of_joint(context, candidate.joints[0], draws[:, 0])}'
        )
    way = length(along_mean(draws[:, :3]))
    turn = f' and {angle(along_mean(draws[:, 3:]))}' if candidate.size > 3 else ''
    mean = draws[:, :3].mean(axis=0)
    parts = ', '.join(f'{part:+.2f}' for part in mean / max(float(np.linalg.norm(mean)), 1e-12))
    frame = (
        'the tool'
        if candidate.place == 'marker'
        else 'its own frame'
        if candidate.subject
        else 'R'
    )
    direction = f'along ({parts}) in {frame}'.replace('-', '−')
    return f'{candidate.subject or "the base"} by {way} {direction}{turn}'


EFFECT = Effect(
    name='step',
    reported_as='unnamed',
    place='joint_angle',
    driver='time',
    form='step',
    equation='δ = Δ for t > t₀, else 0',
    source='change point of one level: Hinkley 1970, Biometrika 57',
    unit='m',
    plausible=(1e-5, 2e-2),
    sentence='The {place} jumped {when} and stayed so (something slipped or was bumped).',
    separate_by='reference poses measured again and again during the session',
    remedy='Find what slipped or was bumped, fasten it, and measure again.',
    size=_jump,
    candidates=candidates,
    needs=needs_time,
    cause_per='variant',
    many=True,
    between=between,
)
