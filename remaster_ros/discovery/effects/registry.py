"""The effects that have a name: one line each."""

from __future__ import annotations

from remaster_ros.discovery.effects import (
    backlash,
    base_compliance,
    encoder_eccentricity,
    encoder_scale,
    gear_periodic,
    joint_axis_tilt,
    joint_compliance,
    joint_coupling,
    joint_error_curve,
    link_length,
    marker_offset,
    registration_drift,
    sensor_distortion,
    sensor_scale,
    settling,
    thermal_growth,
    unnamed,
)
from remaster_ros.discovery.effects.base import Effect

EFFECTS: dict[str, Effect] = {
    effect.name: effect
    for effect in (
        joint_compliance.EFFECT,
        encoder_eccentricity.EFFECT,
        encoder_scale.EFFECT,
        gear_periodic.EFFECT,
        joint_error_curve.EFFECT,
        backlash.EFFECT,
        settling.EFFECT,
        joint_coupling.EFFECT,
        link_length.EFFECT,
        joint_axis_tilt.EFFECT,
        marker_offset.EFFECT,
        thermal_growth.EFFECT,
        base_compliance.EFFECT,
        registration_drift.EFFECT,
        sensor_scale.EFFECT,
        sensor_distortion.EFFECT,
        unnamed.EFFECT,
    )
}
