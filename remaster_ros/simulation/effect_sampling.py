# SPDX-License-Identifier: Apache-2.0
"""Random hidden effects of a given size: joint, direction and sign."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.simulation.hidden_effect import DrawContext, HiddenEffect
from remaster_ros.simulation.hidden_effects import KINDS, NAMED, OF_SLIDES, in_own_units
from remaster_ros.simulation.truth import SessionTruth
from remaster_ros.simulation.world_model import WorldModel

RANDOM = 'random'
# Range of a hidden effect's size if none is given, m.
USUAL_M = (0.2e-3, 0.6e-3)
TRIES = 30


@dataclass(frozen=True)
class EffectSpec:
    """Request for a hidden effect: its kind, and its joint and size if they are to be fixed."""

    kind: str  # Key of `KINDS`, or ``random`` for any kind with a name
    joint: int | None = None  # Number of the joint with the error, from 1; None for any joint
    size_m: float | None = None  # Size by `WorldModel.size_m`; None for a random size

    @classmethod
    def parse(cls, text: str) -> EffectSpec:
        """Read a request ``NAME[@JOINT][:SIZE_MM]``: ``backlash``, ``backlash@4:0.3``, ``random``.

        Joints count from 1. Raises InputError if the text has another form, the name is
        unknown, or joint or size is 0.
        """
        match = re.fullmatch(r'([a-z_]+)(?:@(\d+))?(?::(\d*\.?\d+))?', text)
        if match is None or match[1] not in (RANDOM, *KINDS):
            raise InputError(
                f'{text!r} is nothing to hide; write NAME[@JOINT][:SIZE_MM] with NAME one of '
                f'{RANDOM}, {", ".join(KINDS)}'
            )
        joint = int(match[2]) if match[2] else None
        size_m = 1e-3 * float(match[3]) if match[3] else None
        if joint == 0 or size_m == 0.0:
            raise InputError(f'{text!r}: joints count from 1, and a size is above 0 mm')
        return cls(match[1], joint, size_m)


def hide(
    stage: WorldModel, requests: Sequence[EffectSpec], rng: np.random.Generator
) -> tuple[HiddenEffect, ...]:
    """Draw a random effect for each request, in this order.

    ``stage``: arm, sensors and visits on which the sizes are measured. Sizes that are not
    requested are 0.2 to 0.6 mm, of a marker's offset 2 to 6 mm. Raises InputError if an effect
    cannot be seen with this arm on these visits, or is at a joint that the arm does not have.
    """
    effects = []
    for request in requests:
        kind = request.kind
        if kind == RANDOM:
            kind = str(rng.choice(tuple(NAMED)))
        joint, joints = request.joint, stage.arm.joints
        if joint is not None and joint > joints:
            raise InputError(f'{kind}@{joint}: the arm has {joints} joints; give 1 to {joints}')
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
    """Return a copy of the truth with effects for the requests, drawn by `hide`, and their sizes.

    They replace the truth's effects. Raises InputError as `hide`.
    """
    effects = hide(stage, requests, rng)
    sizes_m = tuple(stage.size_m(effect) for effect in effects)
    return replace(truth, effects=effects, effect_sizes_m=sizes_m)


def draw_effect(
    stage: WorldModel, kind: str, rng: np.random.Generator, size_m: float, joint: int | None = None
) -> HiddenEffect:
    """Draw a random effect of a kind, with the size `size_m` (see `WorldModel.size_m`).

    ``joint``: number of the joint, from 1; None for any. An effect that would have to be
    larger than plausible is drawn again, up to 30 times (with a given joint, 30 times the
    number of joints): a joint that hardly moves shows no eccentricity. If no draw is plausible
    and no joint is given, the most visible draw is used. Raises InputError if all draws leave
    nothing (under 1 µm), if none concerns the joint, if those of the joint would have to be
    larger than plausible, or if the effect or the joint does not fit: an effect of sliding
    joints on an arm without them, or one of turning joints only at a joint that slides.
    """
    drawn_from = DrawContext(
        rng, stage.arm.joints, stage.circumstances, stage.distance_m, tuple(stage.markers)
    )
    if kind in OF_SLIDES and not stage.arm.slides.any():
        raise InputError(f'{kind}: no joint of this arm slides')
    best, best_size = None, 0.0
    for _ in range(TRIES if joint is None else TRIES * stage.arm.joints):
        drawn = KINDS[kind].draw(kind, drawn_from)
        if joint is not None and drawn.joints != (joint,):
            continue
        effect = in_own_units(drawn, stage.circumstances.per_radian)
        if effect is None:
            continue
        if len(effect.joints) > 1:
            effect = _balanced(stage, effect)
        largest = stage.size_m(effect)
        if largest > best_size:
            best, best_size = effect, largest
        if largest >= size_m:
            break
    slides = stage.arm.slides
    if joint is not None and slides[joint - 1] and KINDS[kind].power is None:
        raise InputError(
            f'{kind} at joint {joint}: that joint slides, and has none; give one that turns'
        )
    if best is None or best_size < 1e-6:
        where = '' if joint is None else f' at joint {joint}'
        raise InputError(f'{kind}{where} cannot be seen on these visits, whatever its size')
    if joint is not None and best_size < size_m:
        raise InputError(
            f'{kind} at joint {joint}: one of a plausible size leaves {1e3 * best_size:.2g} mm on '
            'these visits once offsets, registration and marker are fitted; ask for less, or for '
            'another joint'
        )
    return stage.of_size(best, size_m)


def _balanced(stage: WorldModel, effect: HiddenEffect) -> HiddenEffect:
    """Return an effect whose joints' visible parts are in proportion to its drawn values.

    The visible part of a joint is the size (`WorldModel.size_m`) of its part of the effect;
    without this, one of two compliant joints could have no visible part. The largest value is
    that of the largest drawn value.
    """
    sizes = [
        stage.size_m(replace(effect, joints=(joint,), values=np.ones(1)))
        for joint in effect.joints
    ]
    values = effect.values / np.maximum(sizes, 1e-12)
    return replace(effect, values=values * np.max(effect.values) / np.max(values))
