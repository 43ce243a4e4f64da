"""The effects: one line each."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from remaster_ros.discovery.effects.base import Effect
from remaster_ros.discovery.effects.context import Context

MODULES = (
    'joint_compliance',
    'encoder_eccentricity',
    'encoder_scale',
    'gear_periodic',
    'joint_error_curve',
    'backlash',
    'settling',
    'joint_coupling',
    'link_length',
    'joint_axis_tilt',
    'marker_offset',
    'thermal_growth',
    'base_compliance',
    'lateral_compliance',
    'base_tipping',
    'registration_drift',
    'sensor_scale',
    'sensor_distortion',
    'step',
    'sensor_field',
    'sensor_wander',
    'unnamed',
)
"""Modules of this package, each of which has an ``EFFECT``; in the order they are tried."""


OF_MOTION = (
    'clock_offset',
    'clock_drift',
    'joint_lag',
    'friction_windup',
    'inertial_deflection',
    'tool_mode',
)
"""Modules of effects that only an arm shows that moves; they are tried on no other session."""

OF_SLIDES = ('guide_straightness', 'guide_pitch')
"""Modules of effects of joints that slide; they are tried on no arm without."""


def _effect(module: str) -> Effect:
    """Return the `EFFECT` of a module of this package, given by name."""
    effect: Effect = import_module(f'{__package__}.{module}').EFFECT
    return effect


class _Effects(dict[str, Effect]):
    """Effects by name. Iteration has those tried on every session; lookup also has all others."""

    def __missing__(self, name: str) -> Effect:
        return MOTION[name] if name in MOTION else SLIDES[name]

    def get(self, name: str, default: Any = None) -> Any:
        """Return the effect of a name; ``default`` if there is none.

        Also of effects that are tried only on sessions in motion or with slides.
        """
        return super().get(name, MOTION.get(name, SLIDES.get(name, default)))


MOTION = {effect.name: effect for effect in map(_effect, OF_MOTION)}
SLIDES = {effect.name: effect for effect in map(_effect, OF_SLIDES)}
EFFECTS = _Effects((effect.name, effect) for effect in map(_effect, MODULES))


def effects_of(context: Context) -> dict[str, Effect]:
    """Return the effects that are tried on a session, by name.

    Those of motion only if the arm was measured in motion, those of slides if a joint slides.
    """
    found = {**EFFECTS, **(MOTION if context.has_motion else {})}
    return found | (SLIDES if context.chain.slides.any() else {})
