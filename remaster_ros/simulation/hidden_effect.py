"""A hidden effect: what it may depend on, what it changes, how it is drawn.

Nothing here is shared with the code that estimates (`discovery.effects`).
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
    """What effects may depend on at n configurations of k joints."""

    # Reported joint angles, and how far each joint came by its last move, rad, (n, k)
    q: FloatArray
    move: FloatArray
    # Direction of each joint's last move that was a move at all, -1, 0 or 1, (n, k)
    approach: FloatArray
    # Since the first measurement, (n,); the arm's temperature above its first, K, (n,)
    time_s: FloatArray
    warming_k: FloatArray
    # Gravity's torque about each joint, (n, k), and about the base, N m, (n, 3)
    torque: FloatArray
    base_moment: FloatArray
    segments: FloatArray  # From each joint to the next, in the frame between, m, (k + 1, 3)
    axes: FloatArray  # Axis of each joint in its own frame, (k, 3)
    tool: FloatArray  # Rotation of the tool, (n, 3, 3)


@dataclass(eq=False)
class Deviation:
    """How the true arm and sensors differ from their drawings at n configurations."""

    sensors: tuple[str, ...]
    markers: tuple[str, ...]
    angle: FloatArray  # Added to the true joint angles, rad, (n, k)
    # Added to each segment, in the frame after its joint (0: the base), m, (n, k + 1, 3)
    shift: FloatArray
    tilt: FloatArray  # Turns each joint's frame before its own turn, rad, (n, k, 3)
    base: FloatArray  # Turns the base about its origin, axes of R, rad, (n, 3)
    marker: FloatArray  # Added to each marker (c of them) in the tool frame, m, (n, c, 3)
    # What each sensor (s of them) adds to a point p = (x, y, z) that it measures, in its frame N:
    # beside, m, (n, s, 3); turn × p, rad, (n, s, 3); scale p, (n, s, 3); radial (x² + y²) (x, y,
    # 0), 1/m², (n, s, 1); along the line of sight a + b |p|² + c |p|³, in m, 1/m, 1/m², (n, s, 3);
    # and z u² half where u = (x, y)/z along half is positive, (n, s, 2): the rays of one half of
    # its view bend
    beside: FloatArray
    turn: FloatArray
    scale: FloatArray
    radial: FloatArray
    along: FloatArray
    half: FloatArray

    @classmethod
    def none(
        cls, n: int, k: int, sensors: tuple[str, ...] = (), markers: tuple[str, ...] = ()
    ) -> Deviation:
        """Return an arm and sensors as drawn."""
        s = len(sensors)
        shapes = ((k,), (k + 1, 3), (k, 3), (3,), (len(markers), 3))
        per_sensor = ((s, 3), (s, 3), (s, 3), (s, 1), (s, 3), (s, 2))
        return cls(sensors, markers, *(np.zeros((n, *shape)) for shape in (*shapes, *per_sensor)))

    def map(self, change: Callable[..., FloatArray], *others: Deviation) -> Deviation:
        """Apply a function to every array of this and other deviations."""
        names = [s.name for s in fields(self) if s.name not in ('sensors', 'markers')]
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
        return points + self.beside[:, s] + added


@dataclass(frozen=True, eq=False)
class HiddenEffect:
    """One effect of a certain size."""

    kind: str  # Its name, a key of `hidden_effects.NAMED` or `UNNAMED`
    joints: tuple[int, ...]  # Numbers from 1: the joints whose angle, link or axis is wrong
    values: FloatArray  # Its parameters in SI units, (m,); their meaning is in the rule's text
    # What else the rule needs: an order, a direction, another joint, a sensor
    detail: Mapping[str, Any] = field(default_factory=dict)

    def scaled(self, factor: float) -> HiddenEffect:
        """Return the same effect, so many times as large."""
        return replace(self, values=factor * self.values)

    def __str__(self) -> str:
        shown = {key: value for key, value in self.detail.items() if np.ndim(value) < 1}
        detail = ''.join(f', {key} {value}' for key, value in shown.items())
        values = ' '.join(f'{value:.3g}' for value in self.values)
        return f'{self.kind} {list(self.joints)} = [{values}]{detail}'


@dataclass(frozen=True, eq=False)
class DrawContext:
    """What an effect is drawn from."""

    rng: np.random.Generator
    joints: int
    circumstances: Circumstances  # Of the visits
    distance_m: Mapping[str, float]  # Sensor -> mean distance of what it measures, m
    markers: tuple[str, ...]

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the sensors."""
        return tuple(self.distance_m)

    def joint(self, first: int = 1) -> tuple[int]:
        """Draw a joint, 1-based."""
        return (int(self.rng.integers(first, self.joints + 1)),)

    def sign(self) -> float:
        """Draw -1 or 1."""
        return float(self.rng.choice((-1.0, 1.0)))

    def direction(self, size: int) -> FloatArray:
        """Draw a unit vector."""
        values = self.rng.standard_normal(size)
        return values / np.linalg.norm(values)


Draw = Callable[[str, DrawContext], HiddenEffect]
"""(kind, what to draw from) -> an effect."""


def one_value(largest: float, first_joint: int = 1, positive: bool = False) -> Draw:
    """Draw a joint and, unless physics has only the positive one, a sign."""
    return lambda kind, context: HiddenEffect(
        kind,
        context.joint(first_joint),
        np.array([largest * (1.0 if positive else context.sign())]),
    )


def no_joint(largest: float) -> Draw:
    """One value, whose sign is that of physics: nothing is left to draw."""
    return lambda kind, context: HiddenEffect(kind, (), np.array([largest]))


def of_sensor(largest: float, size: int = 1, forms: tuple[str, ...] = ('',)) -> Draw:
    """Draw a sensor, a form and a direction."""

    def draw(kind: str, context: DrawContext) -> HiddenEffect:
        detail = {
            'sensor': str(context.rng.choice(context.sensors)),
            'form': str(context.rng.choice(forms)),
        }
        return HiddenEffect(kind, (), largest * context.direction(size), detail)

    return draw


def two_joints(largest: float, forms: tuple[str, ...] = ('',)) -> Draw:
    """Draw the joint that errs and the one that it follows."""

    def draw(kind: str, context: DrawContext) -> HiddenEffect:
        joint, by = (int(j) for j in 1 + context.rng.choice(context.joints, 2, replace=False))
        form = str(context.rng.choice(forms))
        values = largest * context.direction(2 if form == 'sin/cos' else 1)
        return HiddenEffect(kind, (joint,), values, {'by': by, 'form': form})

    return draw


def at_some_time(draw: Draw) -> Draw:
    """Draw also the moment from which on the effect is there."""

    def timed(kind: str, context: DrawContext) -> HiddenEffect:
        effect = draw(kind, context)
        moment = float(context.rng.uniform(0.15, 0.85) * context.circumstances.time_s[-1])
        return replace(effect, detail={**effect.detail, 'moment_s': moment})

    return timed


Rule = Callable[[HiddenEffect, Deviation, Circumstances], None]
"""Adds what an effect makes of the circumstances to a deviation."""


@dataclass(frozen=True)
class Part:
    """A parameter under the name that discovery gives it."""

    # With ``{j}`` for the joint, ``{by}`` for the one that drives it, ``{order}`` for the order of
    # a wave, ``{sensor}`` for the sensor
    name: str
    # The effect's values where this parameter is 1 and all others are 0
    values: tuple[float, ...] = (1.0,)
    # What the effect has to have in its detail
    detail: Mapping[str, str] = field(default_factory=dict)

    def of(self, effect: HiddenEffect) -> dict[str, float]:
        """Return name and true value, SI units, of an effect of one joint and one order."""
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
    """A kind of effect."""

    # Where it enters, what drives it, and its form
    place: str
    driver: str
    form: str
    rule: Rule  # Its equation
    # Draws one of about the largest size that is plausible; `WorldModel.of_size` makes it smaller
    draw: Draw
    # What discovery should find; none where it has no parameters that could be compared one by one
    parts: tuple[Part, ...] = ()
    answers: tuple[str, ...] = ()  # Names of discovery.json that name it too, beside its own
