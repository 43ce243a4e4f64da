"""Draws effects to hide: which joint, which way, which sign.

Signs are drawn too, but for what can only give way to a load or grow when it warms. Every draw is
of about the largest size that is plausible; `WorldModel.of_size` makes it smaller.
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
# What a hidden effect leaves where nobody says how much, m.
USUAL_M = (0.2e-3, 0.6e-3)
TRIES = 30

Draw = Callable[[np.random.Generator, int, Circumstances, tuple[str, ...]], HiddenEffect]
"""(rng, number of joints, circumstances, names of the sensors) -> an effect."""


def _sign(rng: np.random.Generator) -> float:
    return float(rng.choice((-1.0, 1.0)))


def _direction(rng: np.random.Generator, size: int) -> FloatArray:
    values = rng.standard_normal(size)
    return values / np.linalg.norm(values)


def _one_value(kind: str, largest: float, first_joint: int = 1) -> Draw:
    """Draw a joint and a sign."""

    def draw(
        rng: np.random.Generator, k: int, c: Circumstances, sensors: tuple[str, ...]
    ) -> HiddenEffect:
        joint = int(rng.integers(first_joint, k + 1))
        return HiddenEffect(kind, (joint,), np.array([largest * _sign(rng)]))

    return draw


def _of_sensor(kind: str, largest: float, size: int = 1, forms: tuple[str, ...] = ('',)) -> Draw:
    """Draw a sensor, a direction and a form."""

    def draw(
        rng: np.random.Generator, k: int, c: Circumstances, sensors: tuple[str, ...]
    ) -> HiddenEffect:
        detail = {'sensor': str(rng.choice(sensors)), 'form': str(rng.choice(forms))}
        return HiddenEffect(kind, (), largest * _direction(rng, size), detail)

    return draw


def _two_joints(kind: str, largest: float, forms: tuple[str, ...] = ('',)) -> Draw:
    """Draw the joint that errs and the one that it follows."""

    def draw(
        rng: np.random.Generator, k: int, c: Circumstances, sensors: tuple[str, ...]
    ) -> HiddenEffect:
        joint, by = (int(j) for j in 1 + rng.choice(k, 2, replace=False))
        form = str(rng.choice(forms))
        values = largest * _direction(rng, 2 if form == 'sin/cos' else 1)
        return HiddenEffect(kind, (joint,), values, {'by': by, 'form': form})

    return draw


def _draw_compliance(
    rng: np.random.Generator, k: int, c: Circumstances, sensors: tuple[str, ...]
) -> HiddenEffect:
    loaded = 1 + np.flatnonzero(np.ptp(c.torque, axis=0) > 0.5)
    count = min(int(rng.choice((1, 1, 2))), len(loaded))
    joints = np.sort(rng.choice(loaded, count, replace=False))
    values = 4e-4 * rng.uniform(0.5, 1.0, count)
    return HiddenEffect('joint_compliance', tuple(int(j) for j in joints), values)


def _draw_eccentricity(
    rng: np.random.Generator, k: int, c: Circumstances, sensors: tuple[str, ...]
) -> HiddenEffect:
    orders = ((1,), (2,), (1, 2))[rng.integers(3)]
    values = 20 * ARC_MINUTE * _direction(rng, 2 * len(orders))
    joint = int(rng.integers(1, k + 1))
    return HiddenEffect('encoder_eccentricity', (joint,), values, {'orders': orders})


def _draw_gear(
    rng: np.random.Generator, k: int, c: Circumstances, sensors: tuple[str, ...]
) -> HiddenEffect:
    # Twice the ratio of a strain wave gear of 50 to 160.
    order = int(2 * rng.integers(50, 161))
    values = 10 * ARC_MINUTE * _direction(rng, 2)
    joint = int(rng.integers(1, k + 1))
    return HiddenEffect('gear_periodic', (joint,), values, {'orders': (order,)})


def _draw_curve(
    rng: np.random.Generator, k: int, c: Circumstances, sensors: tuple[str, ...]
) -> HiddenEffect:
    orders = np.arange(4, 25)
    # Weights of a Gaussian bell: waves shorter than its width hardly occur.
    weight = np.exp(-0.5 * (orders * np.deg2rad(rng.uniform(4.0, 10.0))) ** 2)
    amplitudes = weight * np.abs(rng.standard_normal(len(orders)))
    amplitudes /= np.sqrt(0.5 * np.sum(amplitudes**2))
    phases = rng.uniform(0, 2 * np.pi, len(orders))
    detail = {'orders': orders, 'amplitudes': amplitudes, 'phases': phases}
    joint = int(rng.integers(1, k + 1))
    return HiddenEffect('joint_error_curve', (joint,), np.array([8 * ARC_MINUTE]), detail)


def _draw_link(
    rng: np.random.Generator, k: int, c: Circumstances, sensors: tuple[str, ...]
) -> HiddenEffect:
    joint = int(rng.integers(1, k))
    segment = c.segments[joint]
    length = np.linalg.norm(segment)
    axis = str(rng.choice(('x', 'y', 'z')))
    # Offsets of a link are as likely as a wrong length, where it has one.
    if length > 0.02 and (rng.random() < 0.5 or abs(segment['xyz'.index(axis)]) > 0.1 * length):
        axis = 'along'
    return HiddenEffect('link_length', (joint,), np.array([5e-3 * _sign(rng)]), {'axis': axis})


def _draw_tilt(
    rng: np.random.Generator, k: int, c: Circumstances, sensors: tuple[str, ...]
) -> HiddenEffect:
    joint = int(rng.integers(2, k + 1))
    axis = c.axes[joint - 1]
    across = np.cross(axis, rng.standard_normal(3))
    return HiddenEffect('joint_axis_tilt', (joint,), 0.01 * across / np.linalg.norm(across))


def _draw_marker(
    rng: np.random.Generator, k: int, c: Circumstances, sensors: tuple[str, ...]
) -> HiddenEffect:
    return HiddenEffect('marker_offset', (), 10e-3 * _direction(rng, 3))


def _no_joint(kind: str, largest: float) -> Draw:
    """Nothing to draw: one value, whose sign physics gives."""

    def draw(
        rng: np.random.Generator, k: int, c: Circumstances, sensors: tuple[str, ...]
    ) -> HiddenEffect:
        return HiddenEffect(kind, (), np.array([largest]))

    return draw


def _at_some_time(draw: Draw) -> Draw:
    def timed(
        rng: np.random.Generator, k: int, c: Circumstances, sensors: tuple[str, ...]
    ) -> HiddenEffect:
        effect = draw(rng, k, c, sensors)
        moment = float(rng.uniform(0.15, 0.4) * c.time_s[-1])
        return replace(effect, detail={**effect.detail, 'moment_s': moment})

    return timed


DRAWS: dict[str, Draw] = {
    'joint_compliance': _draw_compliance,
    'encoder_eccentricity': _draw_eccentricity,
    'encoder_scale': _one_value('encoder_scale', 5e-3),
    'gear_periodic': _draw_gear,
    'joint_error_curve': _draw_curve,
    'backlash': _one_value('backlash', 15 * ARC_MINUTE),
    'settling': _one_value('settling', 3e-3),
    'joint_coupling': _two_joints('joint_coupling', 5e-3, ('linear', 'sin/cos')),
    'link_length': _draw_link,
    'joint_axis_tilt': _draw_tilt,
    'marker_offset': _draw_marker,
    'thermal_growth': _no_joint('thermal_growth', 2e-4),
    'base_compliance': _no_joint('base_compliance', 1e-4),
    'registration_drift': _of_sensor('registration_drift', 1e-6, 3),
    'sensor_scale': _of_sensor('sensor_scale', 1e-2, 1, ('all', 'depth')),
    'sensor_distortion': _of_sensor('sensor_distortion', 0.2),
    'foreign_torque': _two_joints('foreign_torque', 4e-4),
    'creeping_joint': _one_value('creeping_joint', 1e-6, 2),
    'slipped_joint': _at_some_time(_one_value('slipped_joint', 15 * ARC_MINUTE, 2)),
    'warm_joint': _one_value('warm_joint', 5e-4, 2),
    'bent_coupling': _two_joints('bent_coupling', 3e-3),
    'sagging_tool': _no_joint('sagging_tool', 3e-3),
    'bumped_sensor': _at_some_time(_of_sensor('bumped_sensor', 3e-3, 3)),
}


@dataclass(frozen=True)
class EffectSpec:
    """What somebody wants hidden.

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
    """Draw what was asked for.

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
            # A marker is known to half a millimetre: less than that would be nothing new.
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
    best, best_size = None, 0.0
    for _ in range(TRIES if joint is None else TRIES * stage.arm.joints):
        effect = DRAWS[kind](rng, stage.arm.joints, stage.circumstances, tuple(stage.sensors))
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
    """Let every joint that shares in an effect leave as much as the drawn values are large.

    Else one of two joints that give way could be there in name only.
    """
    alone = [
        stage.size_m(replace(effect, joints=(joint,), values=np.ones(1)))
        for joint in effect.joints
    ]
    values = effect.values / np.maximum(alone, 1e-12)
    return replace(effect, values=values * np.max(effect.values) / np.max(values))
