# SPDX-License-Identifier: Apache-2.0
"""A bag of joint states and points becomes rows: one for each standstill and sensor."""

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from remaster_ros.errors import InputError
from remaster_ros.importing.bags import is_bag, read_bag
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.session.bags.bag_writer import BagWriter

STORE = get_typestore(Stores.ROS2_JAZZY)
JOINT_STATE, POINT = 'sensor_msgs/msg/JointState', 'geometry_msgs/msg/PointStamped'
POSE, TRANSFORM = 'geometry_msgs/msg/PoseStamped', 'geometry_msgs/msg/TransformStamped'
STOPS = np.array([[0.1, -0.4], [0.5, 0.2], [-0.7, 1.0]])
START_S = 1_700_000_000.0


def header(time_s):
    stamp = STORE.types['builtin_interfaces/msg/Time'](int(time_s), round(time_s % 1 * 1e9))
    return STORE.types['std_msgs/msg/Header'](stamp=stamp, frame_id='')


def joints(time_s, q):
    names = ['joint_2', 'gripper', 'joint_1']
    values = np.array([q[1], 0.3, q[0]])
    message = STORE.types[JOINT_STATE](header(time_s), names, values, np.zeros(0), np.zeros(0))
    return '/joint_states', JOINT_STATE, message, time_s


def point(time_s, topic, xyz):
    place = STORE.types['geometry_msgs/msg/Point'](*xyz)
    return topic, POINT, STORE.types[POINT](header(time_s), place), time_s


def messages(seed=0):
    """Give three stops of 3 s with a second of motion between; a stream and single shots."""
    print(f'bag seed {seed}')
    rng = np.random.default_rng(seed)
    for i, q in enumerate(STOPS):
        for step in range(200):
            time_s = START_S + 4.0 * i + 0.02 * step
            # Moving for the first second.
            moved = q + 0.3 * max(0.0, 1.0 - 0.02 * step) + rng.normal(0.0, 1e-6, 2)
            yield joints(time_s, moved)
            yield point(time_s, '/optitrack/marker', [i, 1.0, 2.0] + rng.normal(0.0, 1e-5, 3))
        yield point(START_S + 4.0 * i + 3.0, '/laser_tracker/marker', (10.0 + i, 1.0, 2.0))


@pytest.fixture
def chain(session):
    return SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link)


@pytest.fixture(params=['mcap', 'sqlite3', 'ours'])
def bag(request, tmp_path):
    folder = tmp_path / 'bag'
    if request.param == 'ours':
        with BagWriter(folder) as writer:
            for topic, kind, message, time_s in messages():
                data = bytes(STORE.serialize_cdr(message, kind))
                writer.write(topic, kind, data, int(1e9 * time_s))
        return folder
    plugin = StoragePlugin.MCAP if request.param == 'mcap' else StoragePlugin.SQLITE3
    with RosbagsWriter(folder, version=9, storage_plugin=plugin) as writer:
        connections = {}
        for topic, kind, message, time_s in messages():
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            data = STORE.serialize_cdr(message, kind)
            writer.write(connections[topic], int(1e9 * time_s), data)
    return folder


def test_one_row_for_each_standstill_and_sensor(bag, chain):
    assert is_bag(bag)
    rows = read_bag(bag, chain)
    assert rows.labels['sensor'] == ['laser_tracker', 'optitrack'] * 3
    np.testing.assert_allclose(rows.q, np.repeat(STOPS, 2, axis=0), atol=1e-5)
    np.testing.assert_allclose(rows.position[0::2, 0], [10.0, 11.0, 12.0])
    np.testing.assert_allclose(rows.position[1::2, 0], [0.0, 1.0, 2.0], atol=1e-5)
    assert rows.samples[0::2].tolist() == [1, 1, 1]
    # 3 s less the half in which it may swing, at 50 Hz.
    assert np.all(np.abs(rows.samples[1::2] - 125) < 5)
    assert np.all(np.isnan(rows.std[0::2]))
    assert np.all((rows.std[1::2] > 5e-6) & (rows.std[1::2] < 2e-5))


def test_one_topic_can_be_told(bag, chain):
    rows = read_bag(bag, chain, point_topics=('/laser_tracker/marker',))
    assert rows.labels['sensor'] == ['laser_tracker'] * 3


def test_what_is_missing_is_named(bag, session, chain, tmp_path):
    with pytest.raises(InputError, match=r'no link of the robot; it has /joint_states'):
        read_bag(bag, chain, point_topics=('/elsewhere',))
    urdf = session.urdf.replace('"joint_2"', '"elbow"')
    other = SerialChain.from_urdf(urdf, session.base_link, session.tip_link)
    with pytest.raises(InputError, match='no sensor_msgs/JointState with the joints joint_1, elb'):
        read_bag(bag, other)
    file = next(path for path in bag.iterdir() if path.suffix in ('.mcap', '.db3'))
    file.write_bytes(file.read_bytes()[:1000])
    with pytest.raises(InputError, match='bag'):
        read_bag(bag, chain)


def pose(time_s, topic, kind, xyz, xyzw):
    turn = STORE.types['geometry_msgs/msg/Quaternion'](*xyzw)
    if kind == POSE:
        place = STORE.types['geometry_msgs/msg/Point'](*xyz)
        message = STORE.types['geometry_msgs/msg/Pose'](place, turn)
        return topic, kind, STORE.types[kind](header(time_s), message), time_s
    place = STORE.types['geometry_msgs/msg/Vector3'](*xyz)
    message = STORE.types['geometry_msgs/msg/Transform'](place, turn)
    return topic, kind, STORE.types[kind](header(time_s), 'body', message), time_s


def poses(kind, topics=('/vrpn/tool',), points=False):
    """Give the joints, and poses in the place of the points: a quarter turn more at each stop."""
    rng = np.random.default_rng(1)
    for topic, other, message, time_s in messages():
        if topic != '/optitrack/marker' or points:
            yield topic, other, message, time_s
        if topic == '/optitrack/marker':
            stop, _ = divmod(time_s - START_S, 4.0)
            half = 0.25 * np.pi * stop + rng.normal(0.0, 1e-5)
            sign = rng.choice([-1.0, 1.0])
            xyzw = sign * np.array([0.0, 0.0, np.sin(half), np.cos(half)])
            for name in topics:
                yield pose(time_s, name, kind, [stop, 1.0, 2.0], xyzw)


def written(folder, content):
    with BagWriter(folder) as writer:
        for topic, kind, message, time_s in content:
            if topic != '/laser_tracker/marker':
                data = bytes(STORE.serialize_cdr(message, kind))
                writer.write(topic, kind, data, int(1e9 * time_s))
    return folder


@pytest.mark.parametrize('kind', [POSE, TRANSFORM])
def test_poses_have_the_mean_of_their_orientations(kind, chain, tmp_path):
    rows = read_bag(written(tmp_path / 'bag', poses(kind)), chain)
    np.testing.assert_allclose(rows.position[:, 0], [0.0, 1.0, 2.0], atol=1e-5)
    half = 0.25 * np.pi * np.arange(3)
    wanted = np.column_stack((0.0 * half, 0.0 * half, np.sin(half), np.cos(half)))
    np.testing.assert_allclose(np.abs(rows.orientation), np.abs(wanted), atol=1e-5)


def test_points_go_before_poses_and_one_of_several_is_asked_for(chain, tmp_path):
    both = written(tmp_path / 'both', poses(POSE, points=True))
    assert read_bag(both, chain).orientation is None
    several = written(tmp_path / 'several', poses(POSE, ('/tcp_pose', '/vrpn/tool')))
    with pytest.raises(InputError, match='poses on /tcp_pose, /vrpn/tool; name those of the se'):
        read_bag(several, chain)
    chosen = read_bag(several, chain, point_topics=('/vrpn/tool',))
    assert chosen.labels['sensor'] == ['vrpn'] * 3


def test_the_command_makes_a_session_of_it(bag, session, imported):
    # Three standstills are refused: any data would fit.
    (_, error), _ = imported(session.urdf, bag, status=1)
    assert '3 different configurations to fit are too few' in error
    assert 'it takes at least 4, ' in error
    _, made = imported(session.urdf, bag, '--unchecked')
    assert made.sensor_names == ('laser_tracker', 'optitrack')
    # Two sensors saw each configuration.
    assert made.measurements.configuration.tolist() == [0, 0, 1, 1, 2, 2]
    assert made.timed


def test_a_camera_with_a_clock_of_its_own_is_matched_by_standstills(chain, tmp_path):
    rng = np.random.default_rng(3)
    print('bag seed 3')
    stops = rng.uniform(-1.0, 1.0, (8, 2))
    place = chain.positions(stops, np.array([0.3, 0.2, 0.1]), np.zeros(2))
    with BagWriter(tmp_path / 'bag') as writer:
        start = START_S
        for i, length_s in enumerate(rng.uniform(2.0, 4.0, len(stops))):
            for step in range(int(50 * length_s)):
                time_s = start + 0.02 * step
                # Moving for a second, to where it stops.
                distance = max(0.0, 1.0 - 0.02 * step)
                before = max(i - 1, 0)
                q = stops[i] + distance * (stops[before] - stops[i])
                xyz = place[i] + distance * (place[before] - place[i]) + rng.normal(0.0, 1e-5, 3)
                camera = point(time_s - 1.6e9, '/camera/marker', xyz)
                for topic, kind, message, _ in (joints(time_s, q), camera):
                    data = bytes(STORE.serialize_cdr(message, kind))
                    writer.write(topic, kind, data, int(1e9 * time_s))
            start += length_s
    rows = read_bag(tmp_path / 'bag', chain)
    np.testing.assert_allclose(rows.q, stops, atol=1e-5)
    np.testing.assert_allclose(rows.position, place, atol=1e-4)
    assert '/camera/marker +1600000000.' in ' '.join(rows.description)


BODIES = 'mocap4r2_msgs/msg/RigidBodies'
DEFINITIONS = {
    BODIES: 'std_msgs/Header header\nuint32 frame_number\nmocap4r2_msgs/RigidBody[] rigidbodies',
    'mocap4r2_msgs/msg/RigidBody': (
        'string rigid_body_name\nmocap4r2_msgs/Marker[] markers\ngeometry_msgs/Pose pose'
    ),
    'mocap4r2_msgs/msg/Marker': (
        'int8 id_type\nint32 marker_index\nstring marker_name\ngeometry_msgs/Point translation'
    ),
}


def bodies(store, time_s, places):
    kinds = store.types
    turn = kinds['geometry_msgs/msg/Quaternion'](0.0, 0.0, 0.0, 1.0)
    found = []
    for name, xyz in places.items():
        pose = kinds['geometry_msgs/msg/Pose'](kinds['geometry_msgs/msg/Point'](*xyz), turn)
        found.append(kinds['mocap4r2_msgs/msg/RigidBody'](name, [], pose))
    return '/rigid_bodies', BODIES, kinds[BODIES](header(time_s), 0, found), time_s


def transforms(store, time_s, places):
    kinds = store.types
    turn = kinds['geometry_msgs/msg/Quaternion'](0.0, 0.0, 0.0, 1.0)
    found = []
    for name, xyz in places.items():
        moved = kinds['geometry_msgs/msg/Transform'](
            kinds['geometry_msgs/msg/Vector3'](*xyz), turn
        )
        found.append(kinds[TRANSFORM](header(time_s), name, moved))
    kind = 'tf2_msgs/msg/TFMessage'
    return '/tf', kind, kinds[kind](found), time_s


@pytest.mark.parametrize('plugin', [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
@pytest.mark.parametrize('made', [bodies, transforms])
def test_what_a_message_names_is_a_sensor(made, plugin, chain, tmp_path):
    """Links are where the robot believes them to be; what stands still is not on the arm."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, definition in DEFINITIONS.items():
        store.register(get_types_from_msg(definition, name))
    folder = tmp_path / 'bag'
    with RosbagsWriter(folder, version=9, storage_plugin=plugin) as writer:
        connections = {}
        for topic, kind, message, time_s in messages():
            if topic == '/joint_states':
                at = int((time_s - START_S) / 4.0)
                places = {'wall': (5.0, 5.0, 5.0), 'tag:7': (at, 1.0, 2.0), 'tool': (at, 0.0, 0.0)}
                both = (topic, kind, message, time_s), made(store, time_s, places)
                for channel, of, content, when in both:
                    if channel not in connections:
                        connections[channel] = writer.add_connection(channel, of, typestore=store)
                    data = store.serialize_cdr(content, of)
                    writer.write(connections[channel], int(1e9 * when), data)
    rows = read_bag(folder, chain, clock_offset_s=0.0, links=('tool', '/rigid_bodies/tool'))
    assert len({*rows.labels['sensor']}) == 1
    np.testing.assert_allclose(rows.position, [[i, 1.0, 2.0] for i in range(3)])
    assert rows.orientation is not None
    with pytest.raises(InputError, match='name those of the sensor with --points'):
        read_bag(folder, chain, clock_offset_s=0.0)
