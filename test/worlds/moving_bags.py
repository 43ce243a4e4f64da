# SPDX-License-Identifier: Apache-2.0
"""Recordings of a moving arm as sessions, and as bags of various message types."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from rosbags.typesys import Stores, get_typestore
from worlds.moving_world import (
    CubicSpline,
    Dynamics,
    Errors,
    MovingWorld,
    Recording,
    path_of,
)

from remaster_ros.importing.moving import MarkerStream, MovingOptions, moving_session
from remaster_ros.importing.standstills import Stream, joint_standstills
from remaster_ros.session.bags.bag_writer import BagWriter
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.types import Measurements, Session

STORE = get_typestore(Stores.ROS2_JAZZY)
CELL = read_cell('demo')
CHAIN = CELL.chain()
TOOL_SPEED = 0.25
# Paths that are drawn, of which the most informative one is taken.
DRAWN = 6


def recorded(
    seed: int,
    *,
    seconds: float = 30.0,
    tool_speed: float | None = TOOL_SPEED,
    dynamics: Dynamics | None = None,
    errors: Errors | None = None,
    markers: int = 4,
    stops: bool = False,
    **rates: float,
) -> tuple[MovingWorld, Recording]:
    """Return a world of the demo's arm, and a recording of about so many seconds in it."""
    rng = np.random.default_rng(seed)
    world = MovingWorld(CELL.urdf_text, rng, markers=markers)
    drawn = []
    for _ in range(1 if stops else DRAWN):
        path = path_of(
            CHAIN.lower,
            CHAIN.upper,
            CHAIN.velocity_limits,
            seconds,
            rng,
            tool_speed=tool_speed,
            reach_of=world.tool_points,
            stops=stops,
        )
        if path.x[-1] > seconds and not stops:
            end = max(4, int(np.searchsorted(path.x, seconds))) + 1
            path = CubicSpline(path.x[:end], path(path.x[:end]), bc_type='clamped')
        drawn.append((_uncertainty(path(np.linspace(0.0, path.x[-1], 200))), len(drawn), path))
    path = min(drawn)[2]
    return world, world.record(path, dynamics or Dynamics(), errors or Errors(), **rates)


def _uncertainty(q):
    """Return how badly points along a path determine the inner joints, of unit noise."""
    J = CHAIN.position_jacobian(q, np.array([0.1, 0.0, 0.0]))
    n = len(q)
    points = CHAIN.positions(q, np.array([0.1, 0.0, 0.0]))
    points = points - points.mean(axis=0)
    moved = np.zeros((n, 3, 6))
    moved[:, :, :3] = np.eye(3)
    for axis in range(3):
        moved[:, :, 3 + axis] = np.cross(np.eye(3)[axis], points)
    tool = CHAIN.forward(q)[:, :3, :3]
    columns = np.concatenate((J[:, :, 1:-1], moved, tool), axis=2).reshape(3 * n, -1)
    covariance = np.linalg.pinv(columns.T @ columns)
    return float(np.trace(covariance[: J.shape[2] - 2, : J.shape[2] - 2]))


def names_of(world: MovingWorld) -> list[str]:
    return [f'ball_{i}' for i in range(1, len(world.nominal) + 1)]


def imported(world: MovingWorld, recording: Recording, seed: int = 0, **options):
    """Return the session of a recording, and the sentences on it."""
    names = names_of(world)
    streams = [
        MarkerStream('bar', name, Stream.of(recording.frame_stamps, recording.points[:, i]))
        for i, name in enumerate(names)
    ]
    options = {'places': dict(zip(names, world.nominal, strict=True)), **options}
    return moving_session(
        'recording',
        Stream.of(recording.joint_stamps, recording.joints),
        streams,
        CHAIN,
        CELL.urdf_text,
        MovingOptions(**options),
        np.random.default_rng(seed),
    )


def standing(world: MovingWorld, recording: Recording) -> Session:
    """Return the session of the standstills of a recording, by the true offset of the clocks."""
    still = joint_standstills(Stream.of(recording.joint_stamps, recording.joints))
    stamps = recording.frame_stamps + recording.clock_s
    moving, _ = imported(world, recording)
    n, markers = len(still), len(world.nominal)
    position = np.array(
        [
            recording.points[(stamps > begin + 0.5) & (stamps < end)].mean(axis=0)
            for begin, end in zip(still.begin, still.end, strict=True)
        ]
    )
    number = np.repeat(np.arange(n), markers)
    nothing = Measurements.empty(len(CHAIN))
    rows = replace(
        nothing,
        observation=np.arange(n * markers),
        pose=number,
        configuration=number,
        is_validation=np.zeros(n * markers, bool),
        stamp_s=still.begin[number],
        sensor=np.zeros(n * markers, np.int64),
        marker=np.tile(np.arange(markers), n),
        q=still.mean[number],
        from_q=np.full((n * markers, len(CHAIN)), np.nan),
        position=position.reshape(-1, 3),
        std=np.full((n * markers, 3), np.nan),
        samples=np.full(n * markers, -1),
        temperature_c=np.full(n * markers, np.nan),
        frame=number,
    )
    return replace(moving, measurements=rows, clock_offset_s={})


def _ros(kind, **fields):
    return STORE.types[kind](**fields)


def _header(t):
    ns = round(t * 1e9)
    stamp = _ros('builtin_interfaces/msg/Time', sec=ns // 10**9, nanosec=ns % 10**9)
    return _ros('std_msgs/msg/Header', stamp=stamp, frame_id='')


def held_out_standing(world: MovingWorld, recording: Recording) -> Session:
    """Return the session of the standstills of a recording, none of them to fit."""
    still = standing(world, recording)
    held_out = np.ones(len(still.measurements), bool)
    return replace(still, measurements=replace(still.measurements, is_validation=held_out))


def write_bag(
    folder, world: MovingWorld, recording: Recording, kind: str = 'point', topics=None
) -> None:
    """Write a recording as a bag: points, each marker with a topic, or poses.

    ``topics``: by the marker, for points; ``/bar/NAME`` unless given.
    """
    topics = topics or {name: f'/bar/{name}' for name in names_of(world)}
    messages = []
    empty = np.zeros(0)
    for t, q in zip(recording.joint_stamps, recording.joints, strict=True):
        state = _ros(
            'sensor_msgs/msg/JointState', header=_header(t), name=list(CHAIN.joint_names),
            position=q, velocity=empty, effort=empty,
        )  # fmt: skip
        messages.append((t, '/joint_states', 'sensor_msgs/msg/JointState', state))
    for t, frame in zip(recording.frame_stamps, recording.points, strict=True):
        for name, place in zip(names_of(world), frame, strict=True):
            point = _ros('geometry_msgs/msg/Point', **dict(zip('xyz', place.tolist())))
            if kind == 'point':
                message = _ros('geometry_msgs/msg/PointStamped', header=_header(t), point=point)
                messages.append((t, topics[name], 'geometry_msgs/msg/PointStamped', message))
                continue
            turn = _ros('geometry_msgs/msg/Quaternion', x=0.0, y=0.0, z=0.0, w=1.0)
            pose = _ros('geometry_msgs/msg/Pose', position=point, orientation=turn)
            message = _ros('geometry_msgs/msg/PoseStamped', header=_header(t), pose=pose)
            messages.append((t, f'/bar/{name}/pose', 'geometry_msgs/msg/PoseStamped', message))
    with BagWriter(folder) as writer:
        for t, topic, msgtype, message in sorted(messages, key=lambda entry: entry[0]):
            data = bytes(STORE.serialize_cdr(message, msgtype))
            writer.write(topic, msgtype, data, round(1e9 * t))
