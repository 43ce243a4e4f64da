# SPDX-License-Identifier: Apache-2.0
"""Truth of a simulated session: one description for the fakes and the offline simulation.

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
from remaster_ros.simulation.hidden_effect import HiddenEffect
from remaster_ros.types import FloatArray

ROLL_RAD = 0.2
"""Largest roll of a sensor about its optical axis, and tilt of a body against the tool's axes."""


@dataclass(frozen=True)
class Warming:
    """Warming of an arm by ``kelvin`` from ``start_s`` on, with time constant ``time_s``."""

    kelvin: float = 0.0
    time_s: float = 1.0
    start_s: float = 0.0

    def at(self, t: FloatArray) -> FloatArray:
        """Temperature above that at ``start_s``, K, at times t, s; 0 before it."""
        since = np.maximum(np.asarray(t, float) - self.start_s, 0.0)
        return self.kelvin * (1.0 - np.exp(-since / self.time_s))


@dataclass(frozen=True, eq=False)
class SimulatedSensor:
    """True pose, markers and noise of a simulated sensor."""

    marker: str  # Name of the measured marker
    T_R_N: FloatArray  # True frame of the sensor in the robot base, (4, 4)
    # Error of every point, error common to all points at one pose, and error common to the markers
    # of one frame, m per axis. They apply to the offline simulation; a fake device has the errors
    # of its own data sheet.
    sigma_m: float = 0.1e-3
    pose_sigma_m: float = 0.2e-3
    # Largest angle between the tool's z axis and the line to the sensor at which a fake device
    # sees the marker (a retroreflector takes about 30 degrees, a sphere more)
    acceptance_rad: float = np.pi
    # Further measured markers, with their numbers in the rigid body
    further: Mapping[str, int] = field(default_factory=dict)
    frame_sigma_m: float = 0.0
    # Whether the markers are measured one after another, in separate frames
    single_shot: bool = False
    # For the offline simulation only. Noise along the line of sight at 1 m, m, which grows with
    # the square of the distance. Noise of the orientation of the body at `marker`, as `sigma_m`
    # and `pose_sigma_m`, rad per axis; None if only positions are measured. Whether the sensor is
    # on the tool with its origin at `marker`, and its target in the frame N
    depth_sigma_m: float = 0.0
    turn_sigma_rad: float | None = None
    pose_turn_sigma_rad: float = 0.0
    on_tool: bool = False

    @property
    def markers(self) -> tuple[str, ...]:
        """Names of the measured markers, `marker` first."""
        return (self.marker, *self.further)

    def in_sensor(self, points_R: FloatArray) -> FloatArray:
        """Convert points (..., 3) from the robot base frame R to the sensor's frame N, m."""
        return (points_R - self.T_R_N[:3, 3]) @ self.T_R_N[:3, :3]


@dataclass(frozen=True, eq=False)
class SessionTruth:
    """True values behind a session: offsets, markers, sensors, effects and outliers."""

    joint_offsets: FloatArray  # True joint angle minus reported one, rad (m: slides), (k,)
    markers: Mapping[str, FloatArray]  # True positions in the tool frame, m, name -> (3,)
    sensors: Mapping[str, SimulatedSensor]
    warming: Warming = Warming()  # Warming of the arm and the air around it
    effects: tuple[HiddenEffect, ...] = ()  # Effects of the arm or the sensors
    # Size of each effect: RMS of the 3-D error over all rows after offsets, registration and
    # marker are fitted
    effect_sizes_m: tuple[float, ...] = ()
    outliers: tuple[int, ...] = ()  # ``observation`` of every gross error
    # Orientation on the tool of the body at each marker, if measured, R_T_B, name -> (3, 3)
    bodies: Mapping[str, FloatArray] = field(default_factory=dict)

    def without_noise(
        self, chain: SerialChain, sensor: str, q: FloatArray, marker: str = ''
    ) -> FloatArray:
        """Positions of a marker in a sensor's frame N without noise and effects, m, (..., 3).

        True offsets, marker and sensor pose count. ``sensor``: name of the sensor; ``q``:
        reported joint angles, rad, (..., k); ``marker``: name, '' for the first marker of the
        sensor.
        """
        true_sensor = self.sensors[sensor]
        points_R = chain.positions(
            q, self.markers[marker or true_sensor.marker], self.joint_offsets
        )
        return true_sensor.in_sensor(points_R)


def place_sensor(
    place: ArrayLike, look_at: ArrayLike, std_m: float, rng: np.random.Generator
) -> FloatArray:
    """Random pose T_R_N (4, 4) of a sensor near a place, whose z axis points at ``look_at``.

    ``place, look_at``: in the robot base frame R, m, (3,); ``std_m``: standard deviation of
    the place per axis. The roll about z is uniform within ±0.2 rad.
    """
    position = np.asarray(place, float) + rng.normal(0.0, std_m, 3)
    turn = looking_at(position, look_at, rng.uniform(-ROLL_RAD, ROLL_RAD))
    return transform(turn, position)


def mount_body(rng: np.random.Generator) -> FloatArray:
    """Random rotation R_T_B (3, 3) of a camera, board or probe on the tool.

    Roll and pitch, about the tool's x and y, are within ±0.2 rad; any yaw, about its z.
    """
    tilt = rng.uniform(-ROLL_RAD, ROLL_RAD, 2)
    return matrix_from_rpy((*tilt, rng.uniform(-np.pi, np.pi)))


def truth_to_dict(truth: SessionTruth, chain: SerialChain, seed: int) -> dict[str, Any]:
    """Content of truth.json (``remaster-truth/1``), plain data in the units of fit.json.

    Offsets in degrees, or mm for a joint that slides; lengths in m; sizes of effects in mm.
    """
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
    """Noise of a sensor, with that of depth or of orientations if it has such noise."""
    noise = {'sigma_m': sensor.sigma_m, 'pose_sigma_m': sensor.pose_sigma_m}
    if sensor.depth_sigma_m:
        noise['depth_sigma_m'] = sensor.depth_sigma_m
    if sensor.turn_sigma_rad is not None:
        noise['orientation_sigma_deg'] = float(np.rad2deg(sensor.turn_sigma_rad))
        noise['pose_orientation_sigma_deg'] = float(np.rad2deg(sensor.pose_turn_sigma_rad))
    return noise
