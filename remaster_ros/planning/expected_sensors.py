# SPDX-License-Identifier: Apache-2.0
"""Measurements that sensors are expected to make of the nominal arm, as input of a fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.model import Model
from remaster_ros.calibration.priors import Prior, base_prior, marker_prior, offset_prior
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import matrix_from_quaternion_xyzw, transform
from remaster_ros.types import BoolArray, FloatArray, IntArray, Measurements, Priors

SIGMA_M = 0.1e-3
"""Default of the expected noise of a marker, per axis, m."""
POSE_SIGMA_M = 0.2e-3
"""Default of the expected error common to all readings of a sensor at a pose, per axis, m."""


@dataclass(frozen=True)
class ExpectedSensor:
    """A sensor, the markers in each of its frames, and its noise."""

    name: str
    position_R: FloatArray  # In R, m, (3,)
    markers: Mapping[str, FloatArray]  # Marker name -> position in the tool frame, m, (3,)
    sigma_m: float = SIGMA_M  # Noise of each marker, per axis, m
    # Error common to all readings at one pose, per axis, m
    pose_sigma_m: float = POSE_SIGMA_M
    # Error common to the markers of one frame, per axis, m, with the arm's repeatability
    frame_sigma_m: float = 0.0
    on_request: bool = False  # It measures an arm that stands still only


@dataclass(frozen=True)
class ToolBox:
    """A box along the axes of the robot base frame R, in which the tool has to be accurate."""

    center_m: FloatArray  # In R, (3,)
    size_m: FloatArray  # Edge lengths, (3,)

    def holds(self, points: FloatArray) -> BoolArray:
        """Whether points (n, 3), m in R, lie in the box, its faces included, (n,)."""
        return np.all(2.0 * np.abs(points - self.center_m) <= self.size_m, axis=-1)


def nominal_model(
    chain: SerialChain, q: FloatArray, sensors: Sequence[ExpectedSensor], priors: Priors
) -> tuple[Model, FloatArray]:
    """Return the model of arm, sensors and markers, and its nominal parameters, (size,).

    ``q``: configurations, rad, (n, k); their mean tool position is the registrations' centre.
    """
    markers: dict[str, FloatArray] = {}
    for sensor in sensors:
        markers |= sensor.markers
    reference = np.array([transform(np.eye(3), sensor.position_R) for sensor in sensors])
    for index, sensor in enumerate(sensors):
        # A sensor's orientation matters only to a prior on its registration.
        if sensor.name in priors.base:
            turn = matrix_from_quaternion_xyzw(priors.base[sensor.name].rotation_xyzw)
            reference[index] = transform(turn, sensor.position_R)
    middle = chain.positions(q, np.zeros(3)).mean(axis=0)
    model = Model(
        chain,
        tuple(sensor.name for sensor in sensors),
        tuple(markers),
        reference,
        np.tile(middle, (len(sensors), 1)),
    )
    return model, model.vector(np.zeros(len(chain)), np.array(list(markers.values())))


def expected_priors(
    model: Model, x: FloatArray, marker_std_m: float, priors: Priors
) -> tuple[Prior, ...]:
    """Return the priors of a fit: on all markers, then on given registrations and offsets.

    ``x``: nominal parameters, (size,), about which the markers' priors are; ``marker_std_m``:
    prior standard deviation of a marker's position without a stated one, per axis, m;
    ``priors``: the stated ones. Raises ValueError if a name is not in the model.
    """
    markers = model.markers(x)
    prior_list = [
        marker_prior(model, index, markers[index], priors.markers.get(name, (0, marker_std_m))[1])
        for index, name in enumerate(model.marker_names)
    ]
    prior_list += [
        base_prior(model, model.sensor_names.index(name), prior)
        for name, prior in priors.base.items()
    ]
    prior_list += [
        offset_prior(model, model.chain.joint_names.index(name), mean, std)
        for name, (mean, std) in priors.joint_offsets.items()
    ]
    return tuple(prior_list)


def expected_measurements(
    model: Model, q: FloatArray, pose: IntArray, sensors: Sequence[ExpectedSensor]
) -> Measurements:
    """Return measurements with a row for every marker of every sensor at every configuration.

    Sensor by sensor, then by configuration. ``q``: rad, (n, k); ``pose``: number of the pose of
    each configuration, (n,). Positions are 0; previous configurations and temperatures NaN.
    """
    configuration, sensor, marker = (
        np.concatenate(parts)
        for parts in zip(
            *(
                (
                    np.repeat(np.arange(len(q)), len(each.markers)),
                    np.full(len(q) * len(each.markers), index),
                    np.tile([model.marker_names.index(name) for name in each.markers], len(q)),
                )
                for index, each in enumerate(sensors)
            ),
            strict=True,
        )
    )
    n = len(sensor)
    missing = np.full((n, 3), np.nan)
    return Measurements(
        observation=np.arange(n),
        pose=pose[configuration],
        configuration=configuration,
        is_validation=np.zeros(n, bool),
        stamp_s=np.arange(n, dtype=float),
        sensor=sensor,
        marker=marker,
        q=q[configuration],
        from_q=np.full((n, q.shape[1]), np.nan),
        position=np.zeros((n, 3)),
        std=missing,
        samples=np.full(n, -1),
        temperature_c=missing[:, 0],
    )


def expected_rows(
    model: Model, x: FloatArray, measurements: Measurements, sensors: Sequence[ExpectedSensor]
) -> Rows:
    """Return rows of a fit whose targets are the predictions at x, displaced by the noise.

    Each coordinate is larger by the root of the sum of squares of the sensor's three noises,
    m. ``x``: nominal parameters, (size,).
    """
    rows = Rows.of(measurements, np.arange(len(measurements)), model.reference)
    target = model.predict(model.pinned(x), rows)
    for index, span in rows.spans:
        sensor = sensors[index]
        noise = np.linalg.norm((sensor.sigma_m, sensor.frame_sigma_m, sensor.pose_sigma_m))
        # The gauge depends on the size of the errors, not on their signs.
        target[span] += noise
    return replace(rows, target=target)
