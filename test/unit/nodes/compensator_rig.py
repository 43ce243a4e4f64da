# SPDX-License-Identifier: Apache-2.0
"""The compensator between a planner and a controller, all on real DDS: both are fakes."""

import json
import time

import numpy as np
import pytest
from rigs.ros_rig import OWN_DOMAIN

pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint
from worlds.compensation_files import arm, save
from worlds.drawn_moves import drawn, line

from remaster_ros.collection.message_fields import seconds
from remaster_ros.compensation.arm_model import Geometry
from remaster_ros.compensation.compensator import Compensator
from remaster_ros.nodes.compensator import CompensatorNode
from remaster_ros.nodes.messages import duration_of
from remaster_ros.session.cells.workcell import read_cell

CELL = read_cell('demo')
CHAIN, URDF = CELL.chain(), CELL.urdf_text
NAMES = list(CHAIN.joint_names)
HOME = np.array([0.2, 0.4, -0.1, -1.2, 0.1, 0.9, 0.3])
TARGET = HOME + np.array([0.2, -0.1, 0.1, 0.15, -0.2, 0.1, 0.1])
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
CONTROLLER = '/joint_trajectory_controller'
PATIENCE_S = 60.0
"""A machine that is busy may take so long until a node has seen another."""


def erring(seed=1):
    print('seed', seed)
    rng = np.random.default_rng(seed)
    k = len(CHAIN)
    geometry = Geometry(
        3e-4 * rng.standard_normal((k + 1, 3)), 5e-4 * rng.standard_normal((k + 1, 3))
    )
    offsets = np.radians(0.3) * rng.standard_normal(k)
    return arm(URDF, CHAIN.base_link, CHAIN.tip_link, joint_offsets=offsets, geometry=geometry)


def message_of(t, q, v, names=NAMES):
    message = JointTrajectory(joint_names=list(names))
    for i, at in enumerate(t):
        point = JointTrajectoryPoint(positions=q[i].tolist(), time_from_start=duration_of(at))
        point.velocities = [] if v is None else v[i].tolist()
        message.points.append(point)
    return message


class Rig:
    """The node, and in a context of their own a planner, a controller and its arm."""

    def __init__(self, folder, model, description=URDF, name='compensator', **parameters):
        self.file = save(folder, model, URDF)
        self.compensator = Compensator(model)
        self.context, self.node = rclpy.Context(), None
        given = {'compensation': self.file, **parameters}
        args = ['--ros-args', '--log-level', 'fatal', '-r', f'__node:={name}']
        for parameter, value in given.items():
            args += ['-p', f'{parameter}:={value}']
        rclpy.init(args=args, domain_id=OWN_DOMAIN)
        rclpy.init(context=self.context, domain_id=OWN_DOMAIN)
        self.peer = rclpy.create_node('controller', context=self.context)
        self.executor, self.own = SingleThreadedExecutor(context=self.context), None
        self.executor.add_node(self.peer)
        self.q, self.drive, self.due = HOME, None, 0.0
        # Reported in place of where the arm is, if given.
        self.frozen = None
        self.came, self.told, self.states = [], [], []
        self.joint_states = self.peer.create_publisher(JointState, 'joint_states', 10)
        self.description = self.peer.create_publisher(String, 'robot_description', LATCHED)
        self.planned = self.peer.create_publisher(
            JointTrajectory, 'compensator/joint_trajectory', 10
        )
        peer = self.peer
        peer.create_subscription(JointTrajectory, f'{CONTROLLER}/joint_trajectory', self.obey, 10)
        peer.create_subscription(JointState, 'compensator/joint_states', self.take, 10)
        peer.create_subscription(String, 'compensator/state', self.hear, LATCHED)
        self.node = CompensatorNode()
        self.own = SingleThreadedExecutor()
        self.own.add_node(self.node)
        if description:
            self.description.publish(String(data=description))

    def take(self, message):
        if set(message.name) == set(NAMES):
            self.told.append(np.array([message.position[message.name.index(n)] for n in NAMES]))

    def hear(self, message):
        self.states.append(json.loads(message.data))

    def obey(self, message):
        self.came.append(message)
        if message.points:
            assert message.joint_names == NAMES
            t = np.array([seconds(point.time_from_start) for point in message.points])
            q = np.array([point.positions for point in message.points])
            v = np.array([point.velocities for point in message.points])
            v = v if v.size else None
            if t[0] > 0.0:
                t, q = np.r_[0.0, t], np.vstack((self.q, q))
                v = None if v is None else np.vstack((np.zeros(7), v))
            self.drive = time.monotonic(), t, q, v

    def step(self):
        now = time.monotonic()
        if self.drive is not None:
            began, t, q, v = self.drive
            self.q = drawn(t, q, v, np.array([min(now - began, t[-1])]))[0]
        if now >= self.due:
            self.due = now + 0.02
            # In another order, as drivers do.
            message = JointState(name=NAMES[::-1], position=self.reported[::-1].tolist())
            message.header.stamp = self.peer.get_clock().now().to_msg()
            self.joint_states.publish(message)
        for executor in (self.executor, self.own):
            executor.spin_once(timeout_sec=0.002)

    @property
    def reported(self):
        return self.q if self.frozen is None else self.frozen

    def run(self, seconds, until=lambda: False):
        end = time.monotonic() + seconds
        while time.monotonic() < end and not until():
            self.step()
        return until()

    def ready(self):
        assert self.run(PATIENCE_S, lambda: self.told and self.node._on), self.node._trouble()
        # The planner, the controller: each sees the other side.
        assert self.run(PATIENCE_S, lambda: self.node._commands.get_subscription_count())
        assert self.run(PATIENCE_S, lambda: self.planned.get_subscription_count())
        return self

    def plan(self, start, target, **more):
        wanted = line(start, target, 2.0, CHAIN)
        t, q, v = wanted.times_s, wanted.positions, wanted.velocities
        return message_of(t, q, v, **more)

    def call(self, name):
        client = self.peer.create_client(Trigger, f'compensator/{name}')
        assert self.run(PATIENCE_S, client.service_is_ready)
        future = client.call_async(Trigger.Request())
        assert self.run(20.0, future.done)
        return future.result()

    def refused(self, message):
        """Send a trajectory; return why it was not passed on."""
        before = len(self.came)
        said = []
        self.node._say = said.append
        self.planned.publish(message)
        assert self.run(PATIENCE_S, lambda: said)
        self.run(0.1)
        assert len(self.came) == before
        assert '\n' not in said[0]
        return said[0]

    def close(self):
        if self.node is not None:
            self.node.close()
            self.node.destroy_node()
        rclpy.try_shutdown()
        if self.peer is not None:
            self.peer.destroy_node()
        self.context.try_shutdown()
        self.node = self.peer = None
