# SPDX-License-Identifier: Apache-2.0
"""The same content as a bag, text, workbook and JSON is the same rows to the last digit."""

import json
from dataclasses import replace

import numpy as np
import pytest
from foreign.bag_messages import STORE
from foreign.tables import measured, text, write
from foreign.workbooks import workbook
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from remaster_ros.importing.bags import read_bag
from remaster_ros.importing.rows import TableOptions, read_rows
from remaster_ros.session.bags.bag_writer import BagWriter

JOINT_STATE, POINT = 'sensor_msgs/msg/JointState', 'geometry_msgs/msg/PointStamped'
CALIBRATION = 'robot_calibration_msgs/msg/CalibrationData'
DEFINITIONS = {
    CALIBRATION: (
        'sensor_msgs/JointState joint_states\nrobot_calibration_msgs/Observation[] observations'
    ),
    'robot_calibration_msgs/msg/Observation': (
        'string sensor_name\ngeometry_msgs/PointStamped[] features'
    ),
}
START_MS = 1_700_000_000_000
STEP_MS, STILL, MOVING = 50, 40, 12
# Of an arm that stands with fewer than so many points in a standstill the last one counts.
QUIET = TableOptions(length='m', angles='rad', clock_offset_s=0.0)


@pytest.fixture(scope='module')
def arm():
    made = measured()
    # Of a number that is a rounding error off a short one a workbook has the short one.
    return replace(made, q=made.q.round(9), points=made.points.round(9))


def header(store, ms):
    stamp = store.types['builtin_interfaces/msg/Time'](ms // 1000, ms % 1000 * 1_000_000)
    return store.types['std_msgs/msg/Header'](stamp=stamp, frame_id='')


def joint_state(store, ms, names, q):
    empty = np.zeros(0)
    return store.types[JOINT_STATE](header(store, ms), list(names), np.array(q), empty, empty)


def point_stamped(store, ms, xyz):
    return store.types[POINT](
        header(store, ms), store.types['geometry_msgs/msg/Point'](*map(float, xyz))
    )


def streams(arm):
    """Return times, ms, and values of joints and points of an arm that stands and goes on."""
    joints, points, ms = [], [], START_MS
    for i, (q, p) in enumerate(zip(arm.q, arm.points)):
        joints += [(ms + STEP_MS * k, q) for k in range(STILL)]
        points += [(ms + STEP_MS * k + 10, p) for k in range(STILL)]
        ms += STEP_MS * STILL
        after = arm.q[min(i + 1, len(arm.q) - 1)]
        for k in range(1, MOVING):
            joints.append((ms, q + (after - q) * (k / MOVING)))
            ms += STEP_MS
        ms += 100 * (i % 7)
    return joints, points


def stream_bag(folder, arm, joints, points):
    names = arm.chain.joint_names
    every = [(ms, '/joint_states', JOINT_STATE, q) for ms, q in joints]
    every += [(ms, '/camera/marker', POINT, p) for ms, p in points]
    with BagWriter(folder / 'bag') as writer:
        for ms, topic, kind, values in sorted(every, key=lambda item: item[0]):
            message = (
                joint_state(STORE, ms, names, values)
                if kind == JOINT_STATE
                else point_stamped(STORE, ms, values)
            )
            data = bytes(STORE.serialize_cdr(message, kind))
            writer.write(topic, kind, data, 1_000_000 * ms)
    return read_bag(folder / 'bag', arm.chain, clock_offset_s=0.0)


def as_written(rows):
    return [[f'{ms / 1000}', *(repr(float(value)) for value in row)] for ms, row in rows]


def as_text(folder, arm, joints, points):
    names = arm.chain.joint_names
    files = [
        write(folder, name, text(['time', *header], [*zip(*as_written(rows))]))
        for name, header, rows in (('j.csv', names, joints), ('p.csv', 'xyz', points))
    ]
    return read_rows(files, arm.chain, QUIET)


def as_workbook(folder, arm, joints, points):
    sheets = {
        name: [['time', *header], *([ms / 1000, *map(float, row)] for ms, row in rows)]
        for name, header, rows in (
            ('joints', arm.chain.joint_names, joints),
            ('points', 'xyz', points),
        )
    }
    path = folder / 't.xlsx'
    path.write_bytes(workbook(sheets))
    return read_rows([path], arm.chain, QUIET)


def as_json(folder, arm, joints, points):
    files = [
        write(
            folder,
            name,
            '\n'.join(
                json.dumps({'time': ms / 1000, **dict(zip(header, map(float, row)))})
                for ms, row in rows
            ),
        )
        for name, header, rows in (
            ('j.jsonl', arm.chain.joint_names, joints),
            ('p.jsonl', 'xyz', points),
        )
    ]
    return read_rows(files, arm.chain, QUIET)


@pytest.mark.parametrize('form', [as_text, as_workbook, as_json])
def test_streams_are_the_same_rows_as_those_of_a_bag(form, arm, tmp_path):
    """What stands still is what each message says, however many there are."""
    joints, points = streams(arm)
    of_bag = stream_bag(tmp_path, arm, joints, points)
    np.testing.assert_array_equal(of_bag.q, arm.q)
    np.testing.assert_array_equal(of_bag.position, arm.points)
    found = form(tmp_path, arm, joints, points)
    for key in ('q', 'position', 'std', 'stamp_s', 'samples'):
        np.testing.assert_array_equal(getattr(found, key), getattr(of_bag, key), key)


@pytest.mark.parametrize('plugin', [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_message_a_pose_is_the_same_rows_as_a_table(plugin, arm, tmp_path):
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, definition in DEFINITIONS.items():
        store.register(get_types_from_msg(definition, name))
    header_of = [*arm.chain.joint_names, 'x', 'y', 'z']
    columns = [[repr(float(v)) for v in column] for column in (*arm.q.T, *arm.points.T)]
    table = write(tmp_path, 't.csv', text(header_of, columns))
    right = read_rows([table], arm.chain, TableOptions(length='m', angles='rad'))
    folder = tmp_path / 'bag'
    with RosbagsWriter(folder, version=9, storage_plugin=plugin) as writer:
        connection = writer.add_connection('/calibration_data', CALIBRATION, typestore=store)
        for i, (q, p) in enumerate(zip(arm.q, arm.points)):
            ms = START_MS + 1000 * i
            seen = store.types['robot_calibration_msgs/msg/Observation'](
                'camera', [point_stamped(store, ms, p)]
            )
            message = store.types[CALIBRATION](
                joint_state(store, ms, arm.chain.joint_names, q), [seen]
            )
            writer.write(connection, 1_000_000 * ms, store.serialize_cdr(message, CALIBRATION))
    found = read_bag(folder, arm.chain)
    np.testing.assert_array_equal(found.q, right.q)
    np.testing.assert_array_equal(found.position, right.position)
