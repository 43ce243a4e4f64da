"""What a hidden world can hide: every effect written from its equation, on its own.

Nothing here is shared with the code that estimates (`discovery.effects`). An effect is linear in
its values: `HiddenEffect.values` times what its rule adds to a `Deviation`. A rule reads the
`Circumstances` of every configuration. `NAMED` are the effects with a name, `UNNAMED` are cells
without one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from remaster_ros.types import FloatArray

ARC_MINUTE = np.deg2rad(1.0 / 60.0)
# A joint that moved less than this, rad, keeps the flank of its gears that it had.
SLACK_RAD = 2e-4


@dataclass(frozen=True, eq=False)
class Circumstances:
    """What effects may depend on at n configurations of k joints.

    Attributes
    ----------
    q, move
        Reported joint angles, and how far each joint came by its last move, rad, (n, k).
    approach
        Direction of each joint's last move that was a move at all, -1, 0 or 1, (n, k).
    time_s, warming_k
        Since the first measurement, (n,); the arm's temperature above its first, K, (n,).
    torque, base_moment
        Gravity's torque about each joint, (n, k), and about the base, N m, (n, 3).
    segments
        From each joint to the next, in the frame between, m, (k + 1, 3).
    axes
        Axis of each joint in its own frame, (k, 3).
    tool
        Rotation of the tool, (n, 3, 3).
    """

    q: FloatArray
    move: FloatArray
    approach: FloatArray
    time_s: FloatArray
    warming_k: FloatArray
    torque: FloatArray
    base_moment: FloatArray
    segments: FloatArray
    axes: FloatArray
    tool: FloatArray


@dataclass(eq=False)
class Deviation:
    """How the true arm and sensors differ from their drawings at n configurations.

    Attributes
    ----------
    sensors
        Names of the sensors.
    angle
        Added to the true joint angles, rad, (n, k).
    shift
        Added to each segment, in the frame after its joint (0: the base), m, (n, k + 1, 3).
    tilt
        Turns each joint's frame before its own turn, rad, (n, k, 3).
    base
        Turns the base about its origin, axes of R, rad, (n, 3).
    marker
        Added to the marker in the tool frame, m, (n, 3).
    beside, scale, radial
        What each sensor (s of them) adds to a point p that it measures, in its frame N: beside,
        m, (n, s, 3), scale p, (n, s, 3), and radial r² (x, y, 0), 1/m², (n, s, 1).
    """

    sensors: tuple[str, ...]
    angle: FloatArray
    shift: FloatArray
    tilt: FloatArray
    base: FloatArray
    marker: FloatArray
    beside: FloatArray
    scale: FloatArray
    radial: FloatArray

    @classmethod
    def none(cls, n: int, k: int, sensors: tuple[str, ...] = ()) -> Deviation:
        """Return an arm and sensors as drawn."""
        shapes = ((k,), (k + 1, 3), (k, 3), (3,), (3,))
        per_sensor = ((len(sensors), 3), (len(sensors), 3), (len(sensors), 1))
        return cls(sensors, *(np.zeros((n, *shape)) for shape in (*shapes, *per_sensor)))

    def map(self, change: Callable[..., FloatArray], *others: Deviation) -> Deviation:
        """Apply a function to every array of this and other deviations."""
        names = [spec.name for spec in fields(self) if spec.name != 'sensors']
        changed: dict[str, Any] = {
            name: change(getattr(self, name), *(getattr(other, name) for other in others))
            for name in names
        }
        return replace(self, **changed)

    def measured(self, sensor: str, points: FloatArray) -> FloatArray:
        """Return what a sensor makes of points p in its frame N, m, (n, 3)."""
        s = self.sensors.index(sensor)
        across = points * (1.0, 1.0, 0.0)
        square = np.sum(across**2, axis=1, keepdims=True)
        added = self.scale[:, s] * points + self.radial[:, s] * square * across
        return points + self.beside[:, s] + added


@dataclass(frozen=True, eq=False)
class HiddenEffect:
    """One effect of a certain size.

    Attributes
    ----------
    kind
        Key of `NAMED` or `UNNAMED`.
    joints
        Numbers from 1: the joints whose angle, link or axis is wrong.
    values
        Its parameters in SI units, (m,); their meaning is in the rule's text.
    detail
        What else the rule needs: an order, a direction, another joint, a sensor.
    """

    kind: str
    joints: tuple[int, ...]
    values: FloatArray
    detail: Mapping[str, Any] = field(default_factory=dict)

    def scaled(self, factor: float) -> HiddenEffect:
        """Return the same effect, so many times as large."""
        return replace(self, values=factor * self.values)

    def add_to(self, deviation: Deviation, c: Circumstances) -> None:
        """Add what the rule of this effect makes of the circumstances."""
        (NAMED | UNNAMED)[self.kind].rule(self, deviation, c)

    def __str__(self) -> str:
        shown = {key: value for key, value in self.detail.items() if np.ndim(value) < 1}
        detail = ''.join(f', {key} {value}' for key, value in shown.items())
        values = ' '.join(f'{value:.3g}' for value in self.values)
        return f'{self.kind} {list(self.joints)} = [{values}]{detail}'


# Rules: true = drawn + what stands here


def _compliance(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """δq_j = values_j τ_j for each of the joints, rad/(N m)."""
    for value, j in zip(e.values, e.joints, strict=True):
        d.angle[:, j - 1] += value * c.torque[:, j - 1]


def _eccentricity(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """Per order o in detail: δq = a sin(o q) + b cos(o q), rad."""
    q = c.q[:, e.joints[0] - 1]
    for order, (a, b) in zip(e.detail['orders'], e.values.reshape(-1, 2), strict=True):
        d.angle[:, e.joints[0] - 1] += a * np.sin(order * q) + b * np.cos(order * q)


def _scale(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """δq = s q."""
    d.angle[:, e.joints[0] - 1] += e.values[0] * c.q[:, e.joints[0] - 1]


def _curve(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """A sum of waves of many orders, none of them slow enough for an eccentricity."""
    q = c.q[:, e.joints[0] - 1]
    waves = sum(
        a * np.cos(order * q + phase)
        for order, a, phase in zip(
            e.detail['orders'], e.detail['amplitudes'], e.detail['phases'], strict=True
        )
    )
    d.angle[:, e.joints[0] - 1] += e.values[0] * waves


def _backlash(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """δq = ½ B sign(the last move of that joint)."""
    d.angle[:, e.joints[0] - 1] += 0.5 * e.values[0] * c.approach[:, e.joints[0] - 1]


def _settling(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """δq = −s (q − q before the move): the arm has not come all the way yet."""
    d.angle[:, e.joints[0] - 1] -= e.values[0] * c.move[:, e.joints[0] - 1]


def _coupling(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """δq_j = s q_i, or a sin q_i + b cos q_i."""
    other = c.q[:, e.detail['by'] - 1]
    if e.detail['form'] == 'linear':
        d.angle[:, e.joints[0] - 1] += e.values[0] * other
    else:
        d.angle[:, e.joints[0] - 1] += e.values[0] * np.sin(other) + e.values[1] * np.cos(other)


def _link_length(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """The next joint lies further along the link after joint j, or along an axis of it, m."""
    j = e.joints[0]
    axis = e.detail.get('axis', 'along')
    along = c.segments[j] if axis == 'along' else np.eye(3)['xyz'.index(axis)]
    d.shift[:, j] += e.values[0] * along / np.linalg.norm(along)


def _tilt(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """Joint j's frame is turned about its x, y, z before its own turn, rad."""
    d.tilt[:, e.joints[0] - 1] += e.values


def _marker(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """The marker is not where the drawing has it, m along x, y, z of the tool."""
    d.marker += e.values


def _thermal(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """Every segment grows by α ΔT of its length, 1/K."""
    d.shift += e.values[0] * c.warming_k[:, None, None] * c.segments


def _base(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """The base turns by so much per moment of weight about x and y, rad/(N m)."""
    d.base[:, :2] += e.values[0] * c.base_moment[:, :2]


def _drift(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """What the sensor measures wanders with this velocity, m/s, in its own frame."""
    d.beside[:, d.sensors.index(e.detail['sensor'])] += c.time_s[:, None] * e.values


def _sensor_scale(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """δp = s p, or only in depth (z of N)."""
    along = np.array([0.0, 0.0, 1.0]) if e.detail['form'] == 'depth' else np.ones(3)
    d.scale[:, d.sensors.index(e.detail['sensor'])] += e.values[0] * along


def _distortion(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """δp = k r² (x, y, 0), r the distance from the optical axis z, 1/m²."""
    d.radial[:, d.sensors.index(e.detail['sensor'])] += e.values[0]


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
    d.marker += e.values[0] * down * (1.0, 1.0, 0.0)


def _bumped_sensor(e: HiddenEffect, d: Deviation, c: Circumstances) -> None:
    """From some moment on the sensor measures everything beside where it did, m."""
    d.beside[:, d.sensors.index(e.detail['sensor'])] += _after(e, c)[:, None] * e.values


def _after(e: HiddenEffect, c: Circumstances) -> FloatArray:
    return (c.time_s > e.detail['moment_s']).astype(float)


@dataclass(frozen=True)
class HiddenKind:
    """Where an effect enters, what drives it, its form, and its rule."""

    place: str
    driver: str
    form: str
    rule: Callable[[HiddenEffect, Deviation, Circumstances], None]


NAMED = {
    'joint_compliance': HiddenKind('joint_angle', 'gravity_torque', 'linear', _compliance),
    'encoder_eccentricity': HiddenKind('joint_angle', 'joint_angle', 'sin/cos', _eccentricity),
    'encoder_scale': HiddenKind('joint_angle', 'joint_angle', 'linear', _scale),
    'gear_periodic': HiddenKind('joint_angle', 'joint_angle', 'sin/cos', _eccentricity),
    'joint_error_curve': HiddenKind('joint_angle', 'joint_angle', 'free', _curve),
    'backlash': HiddenKind('joint_angle', 'approach', 'step', _backlash),
    'settling': HiddenKind('joint_angle', 'last_move', 'linear', _settling),
    'joint_coupling': HiddenKind('joint_angle', 'other_joint', 'linear or sin/cos', _coupling),
    'link_length': HiddenKind('link_translation', 'constant', 'constant', _link_length),
    'joint_axis_tilt': HiddenKind('link_rotation', 'constant', 'constant', _tilt),
    'marker_offset': HiddenKind('marker', 'constant', 'constant', _marker),
    'thermal_growth': HiddenKind('link_translation', 'temperature', 'linear', _thermal),
    'base_compliance': HiddenKind('base_rotation', 'gravity_moment', 'linear', _base),
    'registration_drift': HiddenKind('sensor_frame', 'time', 'linear', _drift),
    'sensor_scale': HiddenKind('sensor_frame', 'position', 'linear', _sensor_scale),
    'sensor_distortion': HiddenKind('sensor_frame', 'position', 'quadratic, radial', _distortion),
}
UNNAMED = {
    'foreign_torque': HiddenKind('joint_angle', 'gravity_torque', 'linear', _foreign_torque),
    'creeping_joint': HiddenKind('joint_angle', 'time', 'linear', _creep),
    'slipped_joint': HiddenKind('joint_angle', 'time', 'step', _slip),
    'warm_joint': HiddenKind('joint_angle', 'temperature', 'linear', _warm_joint),
    'bent_coupling': HiddenKind('joint_angle', 'angle', 'quadratic', _bent_coupling),
    'sagging_tool': HiddenKind('marker', 'gravity', 'linear', _sagging_tool),
    'bumped_sensor': HiddenKind('sensor_frame', 'time', 'step', _bumped_sensor),
}
