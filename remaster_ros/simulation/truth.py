# SPDX-License-Identifier: Apache-2.0
"""What a simulated session is made from: one description for the fakes and the offline simulation.

No module that estimates or moves an arm may import it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import (
    looking_at,
    matrix_from_rpy,
    quaternion_xyzw,
    transform,
)
from remaster_ros.session.yaml_records import to_plain
from remaster_ros.simulation.hidden_effects import HiddenEffect
from remaster_ros.types import FloatArray

ROLL_RAD = 0.2
"""Largest roll of a sensor about its optical axis, and tilt of a body against the tool's axes."""


@dataclass(frozen=True)
class Warming:
    """An arm warms up by ``kelvin`` from ``start_s`` on, with time constant ``time_s``."""

    kelvin: float = 0.0
    time_s: float = 1.0
    start_s: float = 0.0

    def at(self, t: FloatArray) -> FloatArray:
        """Temperature above that of the beginning, K."""
        since = np.maximum(np.asarray(t, float) - self.start_s, 0.0)
        return self.kelvin * (1.0 - np.exp(-since / self.time_s))


@dataclass(frozen=True, eq=False)
class SimulatedSensor:
    """A sensor as it truly stands and errs."""

    marker: str  # Name of the marker that it measures
    T_R_N: FloatArray  # Its true frame in the robot base, (4, 4)
    # Error of every point, error that all points at one pose share, and error that the markers of
    # one frame share, m per axis. They hold for the offline simulation; a fake device has the
    # errors of its own data sheet.
    sigma_m: float = 0.1e-3
    pose_sigma_m: float = 0.2e-3
    # Largest angle between the tool's z axis and the line to the sensor at which a fake device
    # sees the marker (a retroreflector takes about 30 degrees, a sphere more)
    acceptance_rad: float = np.pi
    # Further markers that it measures, with their numbers in the rigid body
    further: Mapping[str, int] = field(default_factory=dict)
    frame_sigma_m: float = 0.0
    # Whether it measures its markers one after another, in frames of their own
    single_shot: bool = False
    # What the offline simulation alone has. Noise along the line of sight at 1 m, which grows with
    # the square of the distance, m. Noise of how the body at `marker` stands, as `sigma_m` and
    # `pose_sigma_m`, rad per axis; None where positions alone are measured. Whether it is on the
    # tool, its origin at `marker`, and what it measures stands in the frame N
    depth_sigma_m: float = 0.0
    turn_sigma_rad: float | None = None
    pose_turn_sigma_rad: float = 0.0
    on_tool: bool = False

    @property
    def markers(self) -> tuple[str, ...]:
        """Every marker that it measures, `marker` first."""
        return (self.marker, *self.further)

    def in_sensor(self, points_R: FloatArray) -> FloatArray:
        """Map points (..., 3) of the robot base to the sensor's frame N, m."""
        return (points_R - self.T_R_N[:3, 3]) @ self.T_R_N[:3, :3]


@dataclass(frozen=True, eq=False)
class SessionTruth:
    """What a session was made from: everything that an estimate of it is to find."""

    joint_offsets: FloatArray  # True joint angle minus reported one, rad (m: slides), (k,)
    markers: Mapping[str, FloatArray]  # True positions in the tool frame, m, name -> (3,)
    sensors: Mapping[str, SimulatedSensor]
    warming: Warming = Warming()  # How the arm, and the air around it, warms up
    effects: tuple[HiddenEffect, ...] = ()  # What else is wrong with the arm or the sensors
    # What each effect leaves after offsets, registration and marker are fitted: RMS of the 3-D
    # error over all rows
    effect_sizes_m: tuple[float, ...] = ()
    outliers: tuple[int, ...] = ()  # ``observation`` of every gross error
    # How the body at a marker stands on the tool where it is measured, R_T_B, name -> (3, 3)
    bodies: Mapping[str, FloatArray] = field(default_factory=dict)

    def without_noise(
        self, chain: SerialChain, sensor: str, q: FloatArray, marker: str = ''
    ) -> FloatArray:
        """Where a sensor measures a marker without noise and effects, m, (..., 3).

        ``sensor``: name of the sensor, in whose frame N the positions are; ``q``: reported joint
        angles, rad, (..., k); ``marker``: one of its markers; '' for the first.
        """
        placed = self.sensors[sensor]
        points_R = chain.positions(q, self.markers[marker or placed.marker], self.joint_offsets)
        return placed.in_sensor(points_R)


def place_sensor(
    near: ArrayLike, look_at: ArrayLike, std_m: float, rng: np.random.Generator
) -> FloatArray:
    """Draw T_R_N of a sensor near a place (std per axis) that looks at a point of R, both in m."""
    position = np.asarray(near, float) + rng.normal(0.0, std_m, 3)
    turn = looking_at(position, look_at, rng.uniform(-ROLL_RAD, ROLL_RAD))
    return transform(turn, position)


def mount_body(rng: np.random.Generator) -> FloatArray:
    """Draw R_T_B (3, 3) of a camera, board or probe that looks along the tool's z axis, about."""
    tilt = rng.uniform(-ROLL_RAD, ROLL_RAD, 2)
    return matrix_from_rpy((*tilt, rng.uniform(-np.pi, np.pi)))


def truth_to_dict(truth: SessionTruth, chain: SerialChain, seed: int) -> dict[str, Any]:
    """Return the content of truth.json (``remaster-truth/1``), in the units of fit.json."""
    sensors = truth.sensors
    bodies = {
        name: {'rotation_xyzw': quaternion_xyzw(R_T_B).tolist()}
        for name, R_T_B in truth.bodies.items()
    }
    return {
        'format': 'remaster-truth/1',
        'seed': seed,
        'robot': chain.name,
        'joint_offsets': [
            {'joint': name, 'offset_deg': None, 'unit': 'mm', 'offset_mm': 1e3 * float(offset)}
            if slides
            else {'joint': name, 'offset_deg': float(np.rad2deg(offset))}
            for name, offset, slides in zip(chain.joint_names, truth.joint_offsets, chain.slides)
        ],
        'registration': {
            name: {
                'translation_m': sensor.T_R_N[:3, 3].tolist(),
                'rotation_xyzw': quaternion_xyzw(sensor.T_R_N[:3, :3]).tolist(),
            }
            for name, sensor in sensors.items()
        },
        'markers': {
            name: {'position_m': position.tolist()} for name, position in truth.markers.items()
        },
        **({'bodies': bodies} if bodies else {}),
        'noise': {name: _noise_to_dict(sensor) for name, sensor in sensors.items()},
        'outliers': list(truth.outliers),
        'effects': [
            {**to_plain(effect), 'size_mm': 1e3 * size}
            for effect, size in zip(truth.effects, truth.effect_sizes_m)
        ],
    }


def _noise_to_dict(sensor: SimulatedSensor) -> dict[str, float]:
    """Return a sensor's noise, that of a camera or of orientations where it has one."""
    noise = {'sigma_m': sensor.sigma_m, 'pose_sigma_m': sensor.pose_sigma_m}
    if sensor.depth_sigma_m:
        noise['depth_sigma_m'] = sensor.depth_sigma_m
    if sensor.turn_sigma_rad is not None:
        noise['orientation_sigma_deg'] = float(np.rad2deg(sensor.turn_sigma_rad))
        noise['pose_orientation_sigma_deg'] = float(np.rad2deg(sensor.pose_turn_sigma_rad))
    return noise
