# SPDX-License-Identifier: Apache-2.0
"""Bags as a recorder writes them, made without ROS: an arm that visits poses, and its sensors."""

from __future__ import annotations

from dataclasses import asdict

import msgspec
import numpy as np
from rosbags.typesys import Stores, get_typestore

from remaster_ros.collection import events
from remaster_ros.collection.message_fields import WANTED
from remaster_ros.kinematics.transforms import apply, inverse, transform
from remaster_ros.session.bags.bag_writer import BagWriter
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.session.session_recorder import Parameters

STORE = get_typestore(Stores.ROS2_JAZZY)
STATE, POINT = 'sensor_msgs/msg/JointState', 'geometry_msgs/msg/PointStamped'
TRAJECTORY, TEXT = 'trajectory_msgs/msg/JointTrajectory', 'std_msgs/msg/String'
CELL = read_cell('demo')
CHAIN = CELL.chain()
T_R_N = transform(np.diag([-1.0, -1.0, 1.0]), np.array([1.9, 0.1, 1.2]))


def ros(kind, **fields):
    return STORE.types[kind](**fields)


class RecordedArm:
    """Writes the bag of an arm of the demo's cell; times in s, joints in rad.

    Attributes
    ----------
    t
        Now.
    frames
        What the camera saw at each configuration after it had settled: (stamps, positions).
    change
        What the bridge's correction changes of what was wanted, rad, (k,); None without one.
    """

    def __init__(self, folder, seed):
        self.rng, self.t, self.poses = np.random.default_rng(seed), 100.0, 0
        self.writer, self.frames, self.shots = BagWriter(folder), [], []
        self.q, self.change = np.zeros(len(CHAIN)), None

    def header(self, t):
        ns = round(t * 1e9)
        stamp = ros('builtin_interfaces/msg/Time', sec=ns // 10**9, nanosec=ns % 10**9)
        return ros('std_msgs/msg/Header', stamp=stamp, frame_id='')

    def write(self, topic, kind, message):
        self.writer.write(
            topic, kind, bytes(STORE.serialize_cdr(message, kind)), round(self.t * 1e9)
        )

    def record(self, node, body):
        text = events.encode(events.EventRecord(node=node, body=body, started='1'))
        self.write('/remaster/events', TEXT, ros(TEXT, data=text))

    def began(self, **parameters):
        p = asdict(Parameters(cell='demo', **parameters))
        cell = msgspec.json.encode(CELL).decode()
        self.record('/recorder', events.RecorderBegan(parameters=p, cell=cell))

    def joints(self, topic='/joint_states'):
        empty, names, position = np.zeros(0), list(CHAIN.joint_names), self.q.copy()
        if topic == '/remaster/settled' and self.change is not None:
            names += [f'{WANTED}{name}' for name in names]
            position = np.concatenate((position, position - self.change))
        message = ros(
            STATE, header=self.header(self.t), name=names,
            position=position, velocity=empty, effort=empty,
        )  # fmt: skip
        self.write(topic, STATE, message)

    def point(self, topic, marker, noise_m):
        nominal = CHAIN.positions(self.q, np.array(CELL.markers[marker]))
        place = apply(inverse(T_R_N), nominal) + self.rng.normal(0.0, noise_m, 3)
        point = ros('geometry_msgs/msg/Point', **dict(zip('xyz', place.tolist())))
        self.write(topic, POINT, ros(POINT, header=self.header(self.t), point=point))
        return place

    def announce(self, split, solutions):
        self.poses += 1
        header = self.header(self.t)
        self.stamp = f'{header.stamp.sec}.{header.stamp.nanosec:09d}'
        ids = tuple(range(len(solutions)))
        pose = events.PoseAnnounced(
            stamp=self.stamp, pose=self.poses, split=split, ids=ids, plan='a'
        )
        self.record('/pose_planner', pose)
        zero = ros('builtin_interfaces/msg/Duration', sec=0, nanosec=0)
        empty = np.zeros(0)
        points = [
            ros('trajectory_msgs/msg/JointTrajectoryPoint', positions=q, velocities=empty,
                accelerations=empty, effort=empty, time_from_start=zero)
            for q in solutions
        ]  # fmt: skip
        names = list(CHAIN.joint_names)
        message = ros(TRAJECTORY, header=header, joint_names=names, points=points)
        self.write('/remaster/recorded/joint_solutions', TRAJECTORY, message)

    def stand(self, q, seconds, *, camera=True, shot_after=None):
        """Stand at a configuration from now on: what robot and sensors publish, frame by frame."""
        self.q = q if self.change is None else q + self.change
        self.joints('/remaster/settled')
        self.stand_on(seconds, camera=camera, shot_after=shot_after)

    def stand_on(self, seconds, *, camera=True, shot_after=None):
        """Stand for longer."""
        stamps, places = [], []
        for frame in range(round(seconds / 0.02)):
            self.t += 0.02
            self.joints()
            if camera:
                stamps.append(self.t)
                places.append(self.point('/optitrack/marker', 'sir', 5e-5))
            if shot_after is not None and frame == round(shot_after / 0.02):
                self.shots.append(self.point('/laser_tracker/marker', 'smr', 1e-5))
        self.frames.append((np.array(stamps), np.array(places)))

    def ended(self, solution, result, reason=''):
        end = events.ConfigurationEnded(
            stamp=self.stamp, solution=solution, result=result, reason=reason
        )
        self.record('/recorder', end)
        self.t += 1.0

    def visit(self, split='optimization'):
        """Visit a pose in two configurations, both sensors measuring."""
        solutions = self.rng.uniform(-1.0, 1.0, (2, len(CHAIN)))
        self.announce(split, solutions)
        for index, q in enumerate(solutions):
            self.stand(q, 0.8, shot_after=0.4)
            self.ended(index, 'recorded')
        return solutions

    def register(self):
        for _ in range(2):
            self.visit('registration')

    def planner(self, state):
        self.record('/pose_planner', events.PlannerState(state=state, run='r'))

    def close(self):
        self.writer.close()
