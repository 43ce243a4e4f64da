"""The effects: one line each."""

from __future__ import annotations

from importlib import import_module

from remaster_ros.discovery.effects.base import Effect

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


def _effect(module: str) -> Effect:
    effect: Effect = import_module(f'{__package__}.{module}').EFFECT
    return effect


EFFECTS = {effect.name: effect for effect in map(_effect, MODULES)}
