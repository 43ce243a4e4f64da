# SPDX-License-Identifier: Apache-2.0
"""Messages of ROS 2 that the tests write into bags."""

from __future__ import annotations

from functools import cache

import numpy as np
from rosbags.typesys import Stores, get_typestore

from remaster_ros.session.bags.bag_writer import BagWriter

STORE = get_typestore(Stores.ROS2_JAZZY)
START_NS = 1_700_000_000_000_000_000


def header(i):
    time = STORE.types['builtin_interfaces/msg/Time'](sec=i, nanosec=7)
    return STORE.types['std_msgs/msg/Header'](stamp=time, frame_id=f'frame_{i}')


def joint_state(i):
    rng = np.random.default_rng(i)
    message = STORE.types['sensor_msgs/msg/JointState'](
        header=header(i),
        name=['joint_1', 'joint_2'],
        position=rng.normal(size=2),
        velocity=np.zeros(0),
        effort=rng.normal(size=2),
    )
    return 'sensor_msgs/msg/JointState', message


def point(i):
    x, y, z = np.random.default_rng(i).normal(size=3)
    message = STORE.types['geometry_msgs/msg/PointStamped'](
        header=header(i), point=STORE.types['geometry_msgs/msg/Point'](x=x, y=y, z=z)
    )
    return 'geometry_msgs/msg/PointStamped', message


def diagnostics(i):
    status = STORE.types['diagnostic_msgs/msg/DiagnosticStatus'](
        level=1, name='recorder', message=f'{i}', hardware_id='', values=[]
    )
    array = STORE.types['diagnostic_msgs/msg/DiagnosticArray'](header=header(i), status=[status])
    return 'diagnostic_msgs/msg/DiagnosticArray', array


TOPICS = {
    '/joint_states': joint_state,
    '/optitrack/marker': point,
    '/remaster/status': diagnostics,
    '/remaster/joint_offsets': joint_state,
}


@cache
def message_of(i):
    topic = list(TOPICS)[i % len(TOPICS)]
    msgtype, message = TOPICS[topic](i)
    cdr = bytes(STORE.serialize_cdr(message, msgtype))
    return topic, msgtype, cdr, START_NS + i * 10_000_000


def messages():
    return map(message_of, range(40))


def part(writer, first, last):
    for message in list(messages())[first:last]:
        writer.write(*message)


def abandon(folder, first, last, **options):
    """Write as a process that is killed: nothing is closed."""
    writer = BagWriter(folder, **options)
    part(writer, first, last)
    writer._file.close()
