# SPDX-License-Identifier: Apache-2.0
"""Bags of robot_calibration: a message for each pose, with joint states and points of sensors."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.importing.raw_rows import RawRows, moving_markers
from remaster_ros.importing.units import LENGTHS
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.types import FARTHEST_M, FloatArray

CALIBRATION_DATA = 'robot_calibration_msgs/msg/CalibrationData'


def rows_of(
    path: Path,
    messages: Sequence[tuple[float, Any]],
    chain: SerialChain,
    sensors: Sequence[str] = (),
    length: str = '',
) -> RawRows:
    """Rows of messages of robot_calibration, given as pairs of time of recording, s, and message.

    One for each marker that a sensor measured in a message. The i-th point in a sensor's list
    is always the same marker, such as a corner of a board. Markers that hardly move over all
    messages (extent up to 2 % of the largest) come from the arm's own model and are left out,
    as are points that are not finite. `sensors`: names of the sensors to use, () for all;
    `length`: unit of the points, '' for m.

    Raises
    ------
    InputError
        A message without the robot's joints, an unknown sensor, no sensor with points that move,
        or points beyond 200 m.
    """
    joints, stamps = [], []
    places: dict[tuple[str, int], dict[int, tuple[float, float, float]]] = defaultdict(dict)
    for i, (log_s, message) in enumerate(messages):
        state = message.joint_states
        reported = dict(zip(state.name, state.position))
        absent = [name for name in chain.joint_names if name not in reported]
        if absent:
            raise InputError(
                f'{path}, message {i + 1}: no joint {absent[0]}; it has '
                f'{", ".join(reported) or "none"}; is the URDF that of this arm?'
            )
        joints.append([reported[name] for name in chain.joint_names])
        stamps.append(state.header.stamp.sec + 1e-9 * state.header.stamp.nanosec or log_s)
        for observation in message.observations:
            for at, feature in enumerate(observation.features):
                point = feature.point
                if np.isfinite([point.x, point.y, point.z]).all():
                    places[observation.sensor_name, at][i] = point.x, point.y, point.z
    known = {sensor for sensor, _ in places}
    for name in sensors:
        if name not in known:
            raise InputError(
                f'--points: there is no sensor {name!r}; {path} has {", ".join(sorted(known))}'
            )
    chosen = sorted(key for key in places if not sensors or key[0] in sensors)
    raw = np.full((len(chosen), len(messages), 3), np.nan)
    for at, key in enumerate(chosen):
        for i, place in places[key].items():
            raw[at, i] = place
    moved = moving_markers(raw) if len(chosen) else np.zeros(0, bool)
    used = [key for key, is_moved in zip(chosen, moved) if is_moved]
    if not used:
        raise InputError(
            f'{path}: no observation with points that move; it has sensors '
            f'{", ".join(sorted(known)) or "without points"}'
        )
    still_sensors = sorted(known - {sensor for sensor, _ in used})
    points = raw[moved]
    row, marker = np.nonzero(np.isfinite(points[:, :, 0]).T)
    position = points[marker, row] * LENGTHS[length or 'm']
    if np.abs(position).max() > FARTHEST_M:
        raise InputError(
            f'{path}: points further than {FARTHEST_M:g} m away, beyond any sensor; say their '
            'unit with --length'
        )
    names = sorted({sensor for sensor, _ in used})
    q: FloatArray = np.array(joints, float)
    labels = {'sensor': [used[i][0] for i in marker]}
    if max(Counter(sensor for sensor, _ in used).values()) > 1:
        labels['marker'] = [f'{used[i][0]}_{used[i][1]}' for i in marker]
    n = len(row)
    return RawRows(
        source=tuple(f'{path}, message {i + 1}' for i in row),
        joint_columns=chain.joint_names,
        q=q[row],
        from_q=np.full((n, len(chain)), np.nan),
        position=position,
        std=np.full((n, 3), np.nan),
        stamp_s=np.array(stamps)[row],
        labels=labels,
        temperature_c=np.full(n, np.nan),
        samples=np.full(n, -1.0),
        columns={
            'joint_states': f'joint angles ({", ".join(chain.joint_names)}), rad',
            **{f'features of {name}': f'points, {length or "m"}' for name in names},
        },
        description=(f'{path}: {len(messages)} messages of robot_calibration, a pose each',),
        warnings=tuple(
            f'{path}: {name} left out: its points stand still' for name in still_sensors
        ),
        length_unit=length or 'm',
        reading=row if len(used) > len(names) else None,
    )
