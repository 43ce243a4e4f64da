"""Draws effects to hide: which joint, which direction, which sign.

Compliance and thermal growth have the sign of physics. Every draw has about the largest size that
is plausible; `WorldModel.of_size` makes it smaller.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.simulation.hidden_effects import ARC_MINUTE, NAMED, Circumstances, HiddenEffect
from remaster_ros.simulation.truth import SessionTruth
from remaster_ros.simulation.world_model import WorldModel
from remaster_ros.types import FloatArray

RANDOM = 'random'
# What a hidden effect leaves where no size is given, m.
USUAL_M = (0.2e-3, 0.6e-3)
TRIES = 30


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


def _one_value(largest: float, first_joint: int = 1) -> Draw:
    """Draw a joint and a sign."""
    return lambda kind, context: HiddenEffect(
        kind, context.joint(first_joint), np.array([largest * context.sign()])
    )


def _no_joint(largest: float) -> Draw:
    """One value, whose sign is that of physics: nothing is left to draw."""
    return lambda kind, context: HiddenEffect(kind, (), np.array([largest]))


def _of_sensor(largest: float, size: int = 1, forms: tuple[str, ...] = ('',)) -> Draw:
    """Draw a sensor, a form and a direction."""

    def draw(kind: str, context: DrawContext) -> HiddenEffect:
        detail = {
            'sensor': str(context.rng.choice(context.sensors)),
            'form': str(context.rng.choice(forms)),
        }
        return HiddenEffect(kind, (), largest * context.direction(size), detail)

    return draw


def _two_joints(largest: float, forms: tuple[str, ...] = ('',)) -> Draw:
    """Draw the joint that errs and the one that it follows."""

    def draw(kind: str, context: DrawContext) -> HiddenEffect:
        joint, by = (int(j) for j in 1 + context.rng.choice(context.joints, 2, replace=False))
        form = str(context.rng.choice(forms))
        values = largest * context.direction(2 if form == 'sin/cos' else 1)
        return HiddenEffect(kind, (joint,), values, {'by': by, 'form': form})

    return draw


def _compliance(kind: str, context: DrawContext) -> HiddenEffect:
    loaded = 1 + np.flatnonzero(np.ptp(context.circumstances.torque, axis=0) > 0.5)
    count = min(int(context.rng.choice((1, 1, 2))), len(loaded))
    joints = np.sort(context.rng.choice(loaded, count, replace=False))
    values = 4e-4 * context.rng.uniform(0.5, 1.0, count)
    return HiddenEffect(kind, tuple(int(j) for j in joints), values)


def _eccentricity(kind: str, context: DrawContext) -> HiddenEffect:
    orders = ((1,), (2,), (1, 2))[context.rng.integers(3)]
    values = 20 * ARC_MINUTE * context.direction(2 * len(orders))
    return HiddenEffect(kind, context.joint(), values, {'orders': orders})


def _gear(kind: str, context: DrawContext) -> HiddenEffect:
    # Twice the ratio of a strain wave gear of 50 to 160.
    order = int(2 * context.rng.integers(50, 161))
    values = 10 * ARC_MINUTE * context.direction(2)
    return HiddenEffect(kind, context.joint(), values, {'orders': (order,)})


def _curve(kind: str, context: DrawContext) -> HiddenEffect:
    orders = np.arange(4, 25)
    # Weights of a Gaussian bell: waves shorter than its width hardly occur.
    weight = np.exp(-0.5 * (orders * np.deg2rad(context.rng.uniform(4.0, 10.0))) ** 2)
    amplitudes = weight * np.abs(context.rng.standard_normal(len(orders)))
    amplitudes /= np.sqrt(0.5 * np.sum(amplitudes**2))
    phases = context.rng.uniform(0, 2 * np.pi, len(orders))
    detail = {'orders': orders, 'amplitudes': amplitudes, 'phases': phases}
    return HiddenEffect(kind, context.joint(), np.array([8 * ARC_MINUTE]), detail)


def _link(kind: str, context: DrawContext) -> HiddenEffect:
    joint = int(context.rng.integers(1, context.joints))
    segment = context.circumstances.segments[joint]
    length = np.linalg.norm(segment)
    axis = str(context.rng.choice(('x', 'y', 'z')))
    # Offsets of a link are as likely as a wrong length, where it has one.
    if length > 0.02 and (
        context.rng.random() < 0.5 or abs(segment['xyz'.index(axis)]) > 0.1 * length
    ):
        axis = 'along'
    return HiddenEffect(kind, (joint,), np.array([5e-3 * context.sign()]), {'axis': axis})


def _tilt(kind: str, context: DrawContext) -> HiddenEffect:
    (joint,) = context.joint(2)
    across = np.cross(context.circumstances.axes[joint - 1], context.rng.standard_normal(3))
    return HiddenEffect(kind, (joint,), 0.01 * across / np.linalg.norm(across))


def _marker(kind: str, context: DrawContext) -> HiddenEffect:
    return HiddenEffect(kind, (), 10e-3 * context.direction(3))


def _at_some_time(draw: Draw) -> Draw:
    """Draw also the moment from which on the effect is there."""

    def timed(kind: str, context: DrawContext) -> HiddenEffect:
        effect = draw(kind, context)
        moment = float(context.rng.uniform(0.15, 0.4) * context.circumstances.time_s[-1])
        return replace(effect, detail={**effect.detail, 'moment_s': moment})

    return timed


DRAWS: dict[str, Draw] = {
    'joint_compliance': _compliance,
    'encoder_eccentricity': _eccentricity,
    'encoder_scale': _one_value(5e-3),
    'gear_periodic': _gear,
    'joint_error_curve': _curve,
    'backlash': _one_value(15 * ARC_MINUTE),
    'settling': _one_value(3e-3),
    'joint_coupling': _two_joints(5e-3, ('linear', 'sin/cos')),
    'link_length': _link,
    'joint_axis_tilt': _tilt,
    'marker_offset': _marker,
    'thermal_growth': _no_joint(2e-4),
    'base_compliance': _no_joint(1e-4),
    'registration_drift': _of_sensor(1e-6, 3),
    'sensor_scale': _of_sensor(1e-2, 1, ('all', 'depth')),
    'sensor_distortion': _of_sensor(0.2),
    'foreign_torque': _two_joints(4e-4),
    'creeping_joint': _one_value(1e-6, 2),
    'slipped_joint': _at_some_time(_one_value(15 * ARC_MINUTE, 2)),
    'warm_joint': _one_value(5e-4, 2),
    'bent_coupling': _two_joints(3e-3),
    'sagging_tool': _no_joint(3e-3),
    'bumped_sensor': _at_some_time(_of_sensor(3e-3, 3)),
}
"""The largest sizes are in the units of the effects' rules, see `hidden_effects`."""


@dataclass(frozen=True)
class EffectSpec:
    """What is to be hidden.

    Attributes
    ----------
    kind
        Of `DRAWS`, or ``random`` for any of those that have a name.
    joint
        The joint that errs, 1-based; any where None.
    size_m
        What it leaves, see `WorldModel.size_m`; drawn where None.
    """

    kind: str
    joint: int | None = None
    size_m: float | None = None

    @classmethod
    def parse(cls, text: str) -> EffectSpec:
        """Read ``NAME[@JOINT][:SIZE_MM]``, such as ``backlash``, ``backlash@4:0.3``, ``random``.

        Raises
        ------
        InputError
            Text that is no request.
        """
        match = re.fullmatch(r'([a-z_]+)(?:@(\d+))?(?::(\d*\.?\d+))?', text)
        if match is None or match[1] not in (RANDOM, *DRAWS):
            raise InputError(
                f'{text!r} is nothing to hide; write NAME[@JOINT][:SIZE_MM] with NAME one of '
                f'{RANDOM}, {", ".join(DRAWS)}'
            )
        joint = int(match[2]) if match[2] else None
        size_m = 1e-3 * float(match[3]) if match[3] else None
        if joint == 0 or size_m == 0.0:
            raise InputError(f'{text!r}: joints count from 1, and a size is above 0 mm')
        return cls(match[1], joint, size_m)


def hide(
    stage: WorldModel, requests: Sequence[EffectSpec], rng: np.random.Generator
) -> tuple[HiddenEffect, ...]:
    """Draw the requested effects.

    Raises
    ------
    InputError
        Something that this arm cannot show on these visits.
    """
    effects = []
    for request in requests:
        kind = request.kind
        if kind == RANDOM:
            kind = str(rng.choice(tuple(NAMED)))
        size_m = request.size_m
        if size_m is None:
            # A marker is known to half a millimetre: a smaller offset would be lost in that.
            scale = 10.0 if kind == 'marker_offset' else 1.0
            size_m = scale * rng.uniform(*USUAL_M)
        effects.append(draw_effect(stage, kind, rng, size_m, request.joint))
    return tuple(effects)


def with_effects(
    truth: SessionTruth,
    stage: WorldModel,
    requests: Sequence[EffectSpec],
    rng: np.random.Generator,
) -> SessionTruth:
    """Return a truth in which so much more is wrong, as `hide` draws it."""
    effects = hide(stage, requests, rng)
    sizes_m = tuple(stage.size_m(effect) for effect in effects)
    return replace(truth, effects=effects, effect_sizes_m=sizes_m)


def draw_effect(
    stage: WorldModel, kind: str, rng: np.random.Generator, size_m: float, joint: int | None = None
) -> HiddenEffect:
    """Draw an effect of that kind of which so much is left (see `WorldModel.size_m`).

    Drawn again as long as it would have to be larger than is plausible: a joint that hardly moves
    shows no eccentricity. Where no draw gets there, the most visible of them is taken.

    Raises
    ------
    InputError
        Where all draws leave nothing, or none is about that joint.
    """
    context = DrawContext(rng, stage.arm.joints, stage.circumstances, tuple(stage.sensors))
    best, best_size = None, 0.0
    for _ in range(TRIES if joint is None else TRIES * stage.arm.joints):
        effect = DRAWS[kind](kind, context)
        if joint is not None and effect.joints != (joint,):
            continue
        if len(effect.joints) > 1:
            effect = _balanced(stage, effect)
        largest = stage.size_m(effect)
        if largest > best_size:
            best, best_size = effect, largest
        if largest >= size_m:
            break
    if best is None or best_size < 1e-6:
        where = '' if joint is None else f' at joint {joint}'
        raise InputError(f'{kind}{where} cannot be seen on these visits, whatever its size')
    return stage.of_size(best, size_m)


def _balanced(stage: WorldModel, effect: HiddenEffect) -> HiddenEffect:
    """Scale the joints that share in an effect so that each leaves as much as its drawn value.

    Otherwise one of two joints that give way could have no visible part in it.
    """
    alone = [
        stage.size_m(replace(effect, joints=(joint,), values=np.ones(1)))
        for joint in effect.joints
    ]
    values = effect.values / np.maximum(alone, 1e-12)
    return replace(effect, values=values * np.max(effect.values) / np.max(values))
