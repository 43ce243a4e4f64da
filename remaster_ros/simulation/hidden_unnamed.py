"""What a hidden world can hide that has no name of its own in `hidden_effects.NAMED`.

Each is written from its equation, as there. A search should still find where it lies, what drives
it, or report that structure is left there.
"""

from __future__ import annotations

import numpy as np

from remaster_ros.simulation.hidden_effect import (
    ARC_MINUTE,
    Circumstances,
    Deviation,
    Draw,
    DrawContext,
    HiddenEffect,
    HiddenKind,
    Part,
    at_some_time,
    no_joint,
    of_sensor,
    one_value,
    two_joints,
)
from remaster_ros.types import FloatArray


def _foreign_torque(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """δq_j = s τ_i: joint j gives way to another joint's torque."""
    d.angle[:, e.joints[0] - 1] += e.values[0] * c.torque[:, e.detail['by'] - 1]


def _creep(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """δq_j = s t."""
    d.angle[:, e.joints[0] - 1] += e.values[0] * c.time_s


def _slip(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """δq_j = s from some moment on."""
    d.angle[:, e.joints[0] - 1] += e.values[0] * _after(e, c)


def _warm_joint(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """δq_j = s ΔT."""
    d.angle[:, e.joints[0] - 1] += e.values[0] * c.warming_k


def _bent_coupling(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """δq_j = s q_i²: neither a line nor a wave of the other joint."""
    d.angle[:, e.joints[0] - 1] += e.values[0] * c.q[:, e.detail['by'] - 1] ** 2


def _sagging_tool(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """The marker's stem bends: δ = s (gravity's direction across the tool's z axis)."""
    down = np.swapaxes(c.tool, -1, -2) @ np.array([0.0, 0.0, -1.0])
    d.marker += e.values[0] * (down * (1.0, 1.0, 0.0))[:, None]


def _bumped_sensor(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """From some moment on the sensor stands elsewhere: δp = v + w × p, values (v m, w rad)."""
    s, after = d.sensors.index(e.detail['sensor']), _after(e, c)[:, None]
    d.beside[:, s] += after * e.values[:3]
    d.turn[:, s] += after * e.values[3:]


def _slipped_marker(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """From some moment on one marker sits elsewhere on the tool, m along its x, y, z."""
    d.marker[:, d.markers.index(e.detail['marker'])] += _after(e, c)[:, None] * e.values


def _range_distortion(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """Along the line of sight k (|p|/D − 1)²: nothing near the mean distance D, as no scale is."""
    s, k, mean = d.sensors.index(e.detail['sensor']), e.values[0], e.detail['distance_m']
    d.along[:, s, 0] += k
    d.scale[:, s] -= 2.0 * k / mean
    d.along[:, s, 1] += k / mean**2


def _spherical_distortion(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """δp = k ((|p|/D)² − 1) p: lengths are right at the mean distance D, and nowhere else."""
    s = d.sensors.index(e.detail['sensor'])
    d.along[:, s, 2] += e.values[0] / e.detail['distance_m'] ** 2
    d.scale[:, s] -= e.values[0]


def _one_sided_lens(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """δp = z u² k, u = (x, y)/z along k = values where that is positive, else nothing."""
    d.half[:, d.sensors.index(e.detail['sensor'])] += e.values


def _after(e: HiddenEffect, c: Circumstances) -> FloatArray:
    return (c.time_s > e.detail['moment_s']).astype(float)


def _draw_bump(kind: str, context: DrawContext) -> HiddenEffect:
    # A turn about the sensor moves a marker two metres away about as far as the shift does.
    values = np.concatenate((3e-3 * context.direction(3), 1.5e-3 * context.direction(3)))
    return HiddenEffect(kind, (), values, {'sensor': str(context.rng.choice(context.sensors))})


def _draw_marker_slip(kind: str, context: DrawContext) -> HiddenEffect:
    marker = str(context.rng.choice(context.markers))
    return HiddenEffect(kind, (), 3e-3 * context.direction(3), {'marker': marker})


def _about_mean_distance(largest: float) -> Draw:
    """Draw a sensor and a sign."""

    def draw(kind: str, context: DrawContext) -> HiddenEffect:
        sensor = str(context.rng.choice(context.sensors))
        detail = {'sensor': sensor, 'distance_m': context.distance_m[sensor]}
        return HiddenEffect(kind, (), np.array([largest * context.sign()]), detail)

    return draw


UNNAMED = {
    'foreign_torque': HiddenKind(
        'joint_angle',
        'gravity_torque',
        'linear',
        _foreign_torque,
        two_joints(4e-4),
        (Part('joint_{j}_by_gravity_torque_of_joint_{by}'),),
    ),
    'creeping_joint': HiddenKind(
        'joint_angle', 'time', 'linear', _creep, one_value(1e-6, 2), (Part('joint_{j}_by_time'),)
    ),
    'slipped_joint': HiddenKind(
        'joint_angle',
        'time',
        'step',
        _slip,
        at_some_time(one_value(15 * ARC_MINUTE, 2)),
        (Part('joint_{j}_step'),),
    ),
    'warm_joint': HiddenKind(
        'joint_angle',
        'temperature',
        'linear',
        _warm_joint,
        one_value(5e-4, 2),
        (Part('joint_{j}_by_temperature'),),
    ),
    'bent_coupling': HiddenKind(
        'joint_angle', 'angle', 'quadratic', _bent_coupling, two_joints(3e-3)
    ),
    'sagging_tool': HiddenKind('marker', 'gravity', 'linear', _sagging_tool, no_joint(3e-3)),
    'bumped_sensor': HiddenKind(
        'sensor_frame', 'time', 'step', _bumped_sensor, at_some_time(_draw_bump)
    ),
    'slipped_marker': HiddenKind(
        'marker', 'time', 'step', _slipped_marker, at_some_time(_draw_marker_slip)
    ),
    'range_distortion': HiddenKind(
        'sensor_frame',
        'position',
        'quadratic, along the line of sight',
        _range_distortion,
        _about_mean_distance(0.05),
        answers=('sensor_distortion',),
    ),
    'spherical_distortion': HiddenKind(
        'sensor_frame',
        'position',
        'radial',
        _spherical_distortion,
        _about_mean_distance(0.02),
        # It is the sum of the two.
        answers=('sensor_distortion', 'sensor_scale'),
    ),
    'one_sided_lens': HiddenKind(
        'sensor_frame',
        'position',
        'one-sided',
        _one_sided_lens,
        of_sensor(0.05, 2),
        answers=('sensor_distortion',),
    ),
}
