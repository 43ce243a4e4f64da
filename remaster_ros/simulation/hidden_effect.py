# SPDX-License-Identifier: Apache-2.0
"""Hidden effect: what it may depend on, what it changes, how it is drawn."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from remaster_ros.types import FloatArray

ARC_MINUTE = np.deg2rad(1.0 / 60.0)
# Smallest move of a joint, rad, that changes the flank of its gears.
SLACK_RAD = 2e-4
# Distance, m, at which an error of an angle is as large as that of a slide.
SLIDE_M = 0.25


@dataclass(frozen=True, eq=False)
class Circumstances:
    """Quantities on which hidden effects may depend, at n configurations of k joints."""

    # Reported joint angles, and the last move of each joint, rad or m, (n, k)
    q: FloatArray
    move: FloatArray
    # Direction of each joint's last move above `SLACK_RAD`, -1, 0 or 1, (n, k)
    approach: FloatArray
    # Time since the first measurement, s, (n,); the arm's temperature above its first, K, (n,)
    time_s: FloatArray
    warming_k: FloatArray
    # Gravity's torque about each joint, or force along it, (n, k), and moment about the base, N m,
    # (n, 3)
    torque: FloatArray
    base_moment: FloatArray
    # Gravity's moment on the part that each joint carries, about the joint's origin, in the frame
    # before the joint's rotation, N m, (n, k, 3)
    carried_moment: FloatArray
    segments: FloatArray  # Vector from each joint to the next, in the frame between, m, (k + 1, 3)
    axes: FloatArray  # Axis of each joint in its own frame, (k, 3)
    tool: FloatArray  # Rotation of the tool, (n, 3, 3)
    per_radian: FloatArray  # Equivalent of a radian in each joint's unit, (k,)


@dataclass(eq=False)
class Deviation:
    """Deviation of the true arm and sensors from their drawings at n configurations."""

    sensors: tuple[str, ...]
    markers: tuple[str, ...]
    angle: FloatArray  # Added to the true joint angles, rad or m, (n, k)
    # Added to each segment, in the frame after its joint (0: the base), m, (n, k + 1, 3)
    shift: FloatArray
    tilt: FloatArray  # Rotation of each joint's frame before the joint's own, rad, (n, k, 3)
    base: FloatArray  # Rotation of the base about its origin, axes of R, rad, (n, 3)
    marker: FloatArray  # Added to each marker (c of them) in the tool frame, m, (n, c, 3)
    # Error of each of s sensors at a point p = (x, y, z) in its frame N: sensor_shift, m,
    # (n, s, 3); turn × p, rad, (n, s, 3); scale p, (n, s, 3); radial (x² + y²) (x, y, 0) about a
    # center, 1/m², (n, s, 1), and m, (n, s, 2); along the line of sight a + b |p|² + c |p|³, in m,
    # 1/m, 1/m², (n, s, 3); and z u² half where u = (x, y)/z along half is positive, (n, s, 2):
    # bent rays in one half of the view
    sensor_shift: FloatArray
    turn: FloatArray
    scale: FloatArray
    radial: FloatArray
    center: FloatArray
    along: FloatArray
    half: FloatArray

    @classmethod
    def none(
        cls, n: int, k: int, sensors: tuple[str, ...] = (), markers: tuple[str, ...] = ()
    ) -> Deviation:
        """Zero deviation at n configurations of k joints: arm and sensors as drawn."""
        s = len(sensors)
        shapes = ((k,), (k + 1, 3), (k, 3), (3,), (len(markers), 3))
        per_sensor = ((s, 3), (s, 3), (s, 3), (s, 1), (s, 2), (s, 3), (s, 2))
        return cls(sensors, markers, *(np.zeros((n, *shape)) for shape in (*shapes, *per_sensor)))

    def map(self, change: Callable[..., FloatArray], *operands: Deviation) -> Deviation:
        """Return a deviation whose arrays are a function of this one's and the operands' arrays.

        ``change``: called for each array with this one's array first; operands in their order.
        """
        names = [s.name for s in fields(self) if s.name not in ('sensors', 'markers')]
        changed: dict[str, Any] = {
            name: change(getattr(self, name), *(getattr(other, name) for other in operands))
            for name in names
        }
        return replace(self, **changed)

    def measured(self, sensor: str, points: FloatArray) -> FloatArray:
        """Readings of a sensor, with its errors, for true points in its frame N, m, (n, 3).

        ``sensor``: its name; ``points``: m, (n, 3), not changed. Raises ValueError for an
        unknown sensor.
        """
        s = self.sensors.index(sensor)
        across = points * (1.0, 1.0, 0.0)
        across[:, :2] -= self.center[:, s]
        square = np.sum(across**2, axis=1, keepdims=True)
        distance = np.linalg.norm(points, axis=1, keepdims=True)
        powers = distance ** np.array([0.0, 2.0, 3.0])
        along = np.sum(self.along[:, s] * powers, axis=1, keepdims=True)
        added = self.scale[:, s] * points + self.radial[:, s] * square * across
        added += np.cross(self.turn[:, s], points) + along * points / distance
        half = self.half[:, s]
        length = np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-30)
        towards = np.sum(half * points[:, :2], axis=1, keepdims=True) / length
        bent = np.maximum(towards, 0.0) ** 2 / points[:, 2:]
        added[:, :2] += bent * half
        return points + self.sensor_shift[:, s] + added


@dataclass(frozen=True, eq=False)
class HiddenEffect:
    """Hidden error of the arm or a sensor: kind, joints, and parameter values."""

    kind: str  # Name, a key of `NAMED` or `UNNAMED`
    joints: tuple[int, ...]  # Numbers, from 1, of the joints whose angle, link or axis is wrong
    values: FloatArray  # Parameters in SI units, (m,), with the meaning in the rule's docstring
    # Further arguments of the rule: an order, a direction, another joint, a sensor
    detail: Mapping[str, Any] = field(default_factory=dict)

    def scaled(self, factor: float) -> HiddenEffect:
        """Return the same effect with all values multiplied by a factor."""
        return replace(self, values=factor * self.values)

    def __str__(self) -> str:
        """Kind, joints, values in SI units and details, but for arrays, in one line."""
        shown = {key: value for key, value in self.detail.items() if np.ndim(value) < 1}
        detail = ''.join(f', {key} {value}' for key, value in shown.items())
        values = ' '.join(f'{value:.3g}' for value in self.values)
        return f'{self.kind} {list(self.joints)} = [{values}]{detail}'


@dataclass(frozen=True, eq=False)
class DrawContext:
    """Random generator, arm, visits and sensors from which a random effect is drawn."""

    rng: np.random.Generator
    joints: int
    circumstances: Circumstances  # Circumstances of the visits
    distance_m: Mapping[str, float]  # Sensor -> mean distance of its markers, m
    markers: tuple[str, ...]

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the sensors."""
        return tuple(self.distance_m)

    def joint(self, first: int = 1) -> tuple[int]:
        """Random joint number, from `first` to that of the last joint, as a tuple of one."""
        return (int(self.rng.integers(first, self.joints + 1)),)

    def sign(self) -> float:
        """Random sign, -1 or 1."""
        return float(self.rng.choice((-1.0, 1.0)))

    def direction(self, size: int) -> FloatArray:
        """Random unit vector, uniform over directions, (size,)."""
        values = self.rng.standard_normal(size)
        return values / np.linalg.norm(values)


Draw = Callable[[str, DrawContext], HiddenEffect]
"""Function of a kind and a context to a random effect."""


def one_value(largest: float, first_joint: int = 1, positive: bool = False) -> Draw:
    """Return a function that draws an effect of a random joint with one value, ±`largest`.

    The joint is one from ``first_joint``, counted from 1, to the last; the sign is random.
    ``positive``: always +`largest`, if physics has only the positive sign.
    """
    return lambda kind, context: HiddenEffect(
        kind,
        context.joint(first_joint),
        np.array([largest * (1.0 if positive else context.sign())]),
    )


def no_joint(largest: float) -> Draw:
    """Return a function that draws an effect of no joint with the one value `largest`.

    Nothing in it is random.
    """
    return lambda kind, context: HiddenEffect(kind, (), np.array([largest]))


def of_sensor(largest: float, size: int = 1, forms: tuple[str, ...] = ('',)) -> Draw:
    """Return a function that draws an effect of a random sensor with ``size`` values.

    The values are `largest` times a random unit vector. The effect's detail has the sensor's
    name, ``sensor``, and ``form``, a random one of ``forms``.
    """

    def draw(kind: str, context: DrawContext) -> HiddenEffect:
        detail = {
            'sensor': str(context.rng.choice(context.sensors)),
            'form': str(context.rng.choice(forms)),
        }
        return HiddenEffect(kind, (), largest * context.direction(size), detail)

    return draw


def two_joints(largest: float, forms: tuple[str, ...] = ('',)) -> Draw:
    """Return a function that draws an effect of two random joints.

    One joint has the error, the other drives it: its number, from 1, is ``by`` in the effect's
    detail, and a random one of ``forms`` is ``form`` there. Values: two for 'sin/cos', else
    one; `largest` times a random unit vector.
    """

    def draw(kind: str, context: DrawContext) -> HiddenEffect:
        joint, by = (int(j) for j in 1 + context.rng.choice(context.joints, 2, replace=False))
        form = str(context.rng.choice(forms))
        values = largest * context.direction(2 if form == 'sin/cos' else 1)
        return HiddenEffect(kind, (joint,), values, {'by': by, 'form': form})

    return draw


def at_some_time(draw: Draw) -> Draw:
    """Return a function that draws as ``draw``, with a random time at which the effect begins.

    That time is ``moment_s`` in the effect's detail, s from the first visit; uniform over 15
    to 85 % of the visits' time.
    """

    def timed(kind: str, context: DrawContext) -> HiddenEffect:
        effect = draw(kind, context)
        moment = float(context.rng.uniform(0.15, 0.85) * context.circumstances.time_s[-1])
        return replace(effect, detail={**effect.detail, 'moment_s': moment})

    return timed


Rule = Callable[[HiddenEffect, Deviation, Circumstances], None]
"""Function that adds the contribution of an effect, in its circumstances, to a deviation."""


@dataclass(frozen=True)
class Part:
    """Parameter of a hidden effect under the name that a discovery gives it."""

    # Name with ``{j}`` for the joint, ``{by}`` for the driving joint, ``{order}`` for the order of
    # a wave, ``{sensor}`` for the sensor
    name: str
    # Values of the effect with this parameter at 1 and all others at 0
    values: tuple[float, ...] = (1.0,)
    # Entries that the effect's detail has to have
    detail: Mapping[str, str] = field(default_factory=dict)

    def of(self, effect: HiddenEffect) -> dict[str, float]:
        """Name and true value, SI units, of the parameter in an effect of one joint and one order.

        {} if the effect does not have it: an entry of its detail differs from the ``detail``
        that the parameter requires, or the value is 0 to rounding.
        """
        if any(effect.detail.get(key) != value for key, value in self.detail.items()):
            return {}
        values = np.array(self.values)
        value = float(values @ effect.values / (values @ values))
        if abs(value) < 1e-9 * np.linalg.norm(effect.values):
            return {}
        words = {'j': effect.joints[0] if effect.joints else 0, **effect.detail}
        if 'orders' in words:
            (words['order'],) = words['orders']
        return {self.name.format(**words): value}


@dataclass(frozen=True)
class HiddenKind:
    """Kind of hidden effect: place, driver, equation, random draw and expected parameters."""

    # Place of the error in the arm, and quantity that drives it
    place: str
    driver: str
    rule: Rule  # Equation of the effect
    # Draw of about the largest plausible size; `WorldModel.of_size` makes it smaller
    draw: Draw
    # Parameters that discovery should find; empty if they cannot be compared one by one
    parts: tuple[Part, ...] = ()
    # Power of the driver's unit in the denominator of the values' unit: for a driving joint that
    # slides the values are drawn smaller. None if a joint that slides cannot have the effect
    power: int | None = 0
    accepted: tuple[str, ...] = ()  # Further names in discovery.json that are correct
