"""A hidden effect: what it may depend on, what it changes, how it is drawn.

Nothing here is shared with the code that estimates (`discovery.effects`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from remaster_ros.types import FloatArray

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
        Its name, a key of `hidden_effects.NAMED` or `UNNAMED`.
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

    def __str__(self) -> str:
        shown = {key: value for key, value in self.detail.items() if np.ndim(value) < 1}
        detail = ''.join(f', {key} {value}' for key, value in shown.items())
        values = ' '.join(f'{value:.3g}' for value in self.values)
        return f'{self.kind} {list(self.joints)} = [{values}]{detail}'


@dataclass(frozen=True, eq=False)
class DrawContext:
    """What an effect is drawn from.

    Attributes
    ----------
    rng
        Source of all randomness.
    joints
        Number of joints.
    circumstances
        Of the visits.
    sensors
        Their names.
    """

    rng: np.random.Generator
    joints: int
    circumstances: Circumstances
    sensors: tuple[str, ...]

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
        moment = float(context.rng.uniform(0.15, 0.4) * context.circumstances.time_s[-1])
        return replace(effect, detail={**effect.detail, 'moment_s': moment})

    return timed


Rule = Callable[[HiddenEffect, Deviation, Circumstances], None]
"""Adds what an effect makes of the circumstances to a deviation."""
Parameters = Callable[[HiddenEffect], dict[str, float]]
"""Returns the true parameters in SI units, under the names that discovery gives them."""


def named(*names: str, factor: float = 1.0) -> Parameters:
    """Name the values of an effect in order.

    Parameters
    ----------
    names
        With ``{j}`` for the joint, ``{by}`` for the driving joint, ``{sensor}`` for the sensor.
    factor
        What the parameters are in units of the values.
    """

    def parameters(effect: HiddenEffect) -> dict[str, float]:
        words = {'j': effect.joints[0] if effect.joints else 0, **effect.detail}
        return {
            name.format(**words): factor * float(value)
            for name, value in zip(names, effect.values, strict=True)
        }

    return parameters


def not_compared(effect: HiddenEffect) -> dict[str, float]:
    """Return no parameters: discovery has none that could be compared one by one."""
    return {}


@dataclass(frozen=True)
class HiddenKind:
    """A kind of effect.

    Attributes
    ----------
    place, driver, form
        Where it enters, what drives it, and its form.
    rule
        Its equation.
    draw
        Draws one of about the largest size that is plausible; `WorldModel.of_size` makes it
        smaller.
    parameters
        What discovery should find.
    """

    place: str
    driver: str
    form: str
    rule: Rule
    draw: Draw
    parameters: Parameters = not_compared
