# SPDX-License-Identifier: Apache-2.0
"""Sessions of chosen configurations: every sensor measures all of its markers in one frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from worlds.measured_rows import predict_in_sensor

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.planning.expected_sensors import (
    ExpectedSensor,
    expected_measurements,
    nominal_model,
)
from remaster_ros.types import FloatArray, IntArray, Priors, Session

OFFSET_STD = np.radians(0.3)
MARKER_STD = 0.5e-3


def measured(
    chain: SerialChain,
    urdf: str,
    configurations: tuple[FloatArray, IntArray],
    sensors: Sequence[ExpectedSensor],
    rng: np.random.Generator,
) -> tuple[Session, FloatArray]:
    """Return a session of a drawn truth, and its offsets, rad, (k,).

    Parameters
    ----------
    chain, urdf
        The nominal arm.
    configurations
        rad, (n, k), and the pose of each, (n,).
    sensors
        What measures, with its noise; the true markers lie 0.5 mm (std per axis) off theirs.
    rng
        Source of randomness.
    """
    q, pose = configurations
    model, x = nominal_model(chain, q, sensors, Priors())
    rows = expected_measurements(model, q, pose, sensors)
    nominal = model.markers(x)
    offsets = OFFSET_STD * rng.standard_normal(len(chain))
    markers = nominal + MARKER_STD * rng.standard_normal(nominal.shape)
    points = predict_in_sensor(chain, rows, offsets, model.reference, markers)
    for index, sensor in enumerate(sensors):
        mine = np.flatnonzero(rows.sensor == index)
        of_pose = sensor.pose_sigma_m * rng.standard_normal((int(pose.max()) + 1, 3))
        points[mine] += of_pose[rows.pose[mine]]
        points[mine] += sensor.sigma_m * rng.standard_normal((len(mine), 3))
        if sensor.frame_sigma_m > 0.0:
            rows = replace(rows, frame=rows.configuration)
            of_frame = sensor.frame_sigma_m * rng.standard_normal((len(q), 3))
            points[mine] += of_frame[rows.configuration[mine]]
    session = Session(
        urdf=urdf,
        base_link=chain.base_link,
        tip_link=chain.tip_link,
        markers=dict(zip(model.marker_names, nominal)),
        sensors={sensor.name: next(iter(sensor.markers)) for sensor in sensors},
        measurements=replace(rows, position=points),
        marker_std_m=MARKER_STD,
    )
    return session, offsets
