# SPDX-License-Identifier: Apache-2.0
"""What sensors are expected to measure at configurations of the nominal arm, as a fit takes it."""

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
"""Expected noise of a marker where nothing is stated, per axis, m."""
POSE_SIGMA_M = 0.2e-3
"""Expected error that all readings of a sensor at a pose share, per axis, m."""


@dataclass(frozen=True)
class ExpectedSensor:
    """A sensor, the markers that it measures in every frame, and its noise."""

    name: str  # Of the sensor
    position_R: FloatArray  # Its origin in R, m, (3,)
    markers: Mapping[str, FloatArray]  # Marker name -> position in the tool frame, m, (3,)
    sigma_m: float = SIGMA_M  # Noise of each marker, per axis, m
    # Error that all its readings at one pose share, per axis, m
    pose_sigma_m: float = POSE_SIGMA_M
    # Error that the markers of one frame share, per axis, m: the arm's repeatability belongs here
    frame_sigma_m: float = 0.0


@dataclass(frozen=True)
class ToolBox:
    """A box in R in which the tool is to be accurate: middle and edges, m, (3,) each."""

    center_m: FloatArray
    size_m: FloatArray

    def holds(self, points: FloatArray) -> BoolArray:
        """Tell which points (n, 3), m, lie in it."""
        return np.all(2.0 * np.abs(points - self.center_m) <= self.size_m, axis=-1)


def nominal_model(
    chain: SerialChain, q: FloatArray, sensors: Sequence[ExpectedSensor], priors: Priors
) -> tuple[Model, FloatArray]:
    """Return the model and its nominal parameters, (size,)."""
    markers: dict[str, FloatArray] = {}
    for sensor in sensors:
        markers |= sensor.markers
    reference = np.array([transform(np.eye(3), sensor.position_R) for sensor in sensors])
    for index, sensor in enumerate(sensors):
        # Which way a sensor looks changes nothing but what a prior on its registration tells.
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
    """Return the priors that a fit would have; those on offsets count by their widths alone."""
    markers = model.markers(x)
    known = [
        marker_prior(model, index, markers[index], priors.markers.get(name, (0, marker_std_m))[1])
        for index, name in enumerate(model.marker_names)
    ]
    known += [
        base_prior(model, model.sensor_names.index(name), prior)
        for name, prior in priors.base.items()
    ]
    known += [
        offset_prior(model, model.chain.joint_names.index(name), mean, std)
        for name, (mean, std) in priors.joint_offsets.items()
    ]
    return tuple(known)


def expected_measurements(
    model: Model, q: FloatArray, pose: IntArray, sensors: Sequence[ExpectedSensor]
) -> Measurements:
    """Return a row for every marker of every sensor at every configuration."""
    configuration, sensor, marker = (
        np.concatenate(parts)
        for parts in zip(
            *(
                (
                    np.repeat(np.arange(len(q)), len(one.markers)),
                    np.full(len(q) * len(one.markers), index),
                    np.tile([model.marker_names.index(name) for name in one.markers], len(q)),
                )
                for index, one in enumerate(sensors)
            ),
            strict=True,
        )
    )
    n = len(sensor)
    unknown = np.full((n, 3), np.nan)
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
        std=unknown,
        samples=np.full(n, -1),
        temperature_c=unknown[:, 0],
    )


def expected_rows(
    model: Model, x: FloatArray, measurements: Measurements, sensors: Sequence[ExpectedSensor]
) -> Rows:
    """Return the rows with targets that the noise moves away from the prediction, as readings."""
    rows = Rows.of(measurements, np.arange(len(measurements)), model.reference)
    target = model.predict(model.pinned(x), rows)
    for index, span in rows.spans:
        sensor = sensors[index]
        noise = np.linalg.norm((sensor.sigma_m, sensor.frame_sigma_m, sensor.pose_sigma_m))
        # The gauge needs the size of the errors, not their signs.
        target[span] += noise
    return replace(rows, target=target)
