# SPDX-License-Identifier: Apache-2.0
"""Keys of a cell file: what they come to, and one clear line for each that is wrong."""

import pytest
from worlds.simple_cells import DEMO, edited_cell

from remaster_ros.collection.stopping_rule import StoppingGoal
from remaster_ros.errors import InputError
from remaster_ros.session.cells.workcell import read_cell

HYPERCUBE = '  design: latin_hypercube\n'
TOPIC = '    topic: optitrack/marker'
BAR, ANGLE = '    marker: sir\n', '    max_angle_deg: 60.0'
BODY = '  b: [0.05, 0.05, 0.0]\n  c: [0.0, -0.05, 0.03]\n'
BOX = 'tool_box: {center_m: [0.4, 0, 0.5], size_m: [0.2, 0.3, 0.2]}\n'


def cell_file(folder, *changes):
    return edited_cell(folder / 'cell.yaml', *changes)


def poses(keys):
    return HYPERCUBE, keys if 'design:' in keys else HYPERCUBE + keys


def noise(keys):
    return ANGLE, f'    {keys}\n{ANGLE}'


def markers(further, more=''):
    further = f'{BAR}    further_markers: {further}\n'
    return (BAR, further), ('markers:\n', f'markers:\n{BODY}{more}')


def of_type(kind, name='mocap'):
    topic = TOPIC if name == 'mocap' else '    topic: laser_tracker/marker'
    return topic, f'    topic: /vrpn/tool\n    message_type: geometry_msgs/msg/{kind}'


def on_tool():
    old, new = of_type('PoseStamped')
    return old, f'{new}\n    mounted_on: tool'


def refused(folder, *changes, file='cell.yaml'):
    """Return the one line that refuses a cell."""
    path = cell_file(folder, *changes)
    with pytest.raises(InputError) as caught:
        read_cell(path)
    assert f'{file}: ' in str(caught.value)
    assert '\n' not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    ('keys', 'message'),
    [
        ('  design: best\n', "poses.design is 'best'; write optimal or latin_hypercube"),
        ('  order: fast\n', "poses.order is 'fast'; write nearest or fastest"),
        ('  solutions: one\n', "poses.solutions is 'one'; write all or chosen"),
        ('  solutions: chosen\n', 'poses.solutions: chosen has no effect with design: latin_hyp'),
        ('  tool_share: 0.5\n', 'poses.tool_share has no effect with design: latin_hypercube'),
        (f'  {BOX}', 'poses.tool_box has no effect without tool_std_m'),
        ('  design: optimal\n  tool_share: 2\n', 'poses.tool_share is 2; it must be from 0 to 1'),
        ('  design: optimal\n  joint_std_deg: 0\n', 'poses.joint_std_deg is 0; it must be above'),
        ('  design: optimal\n  tool_std_m: 0.0001\n', 'poses.tool_std_m has no effect with tool'),
        (
            '  design: optimal\n  tool_share: 1.0\n  joint_std_deg: 0.003\n',
            'poses.joint_std_deg has no effect with tool_share: 1',
        ),
        (
            f'  design: optimal\n  {BOX.replace("0.3", "0")}',
            'poses.tool_box.size_m is 0; it must be above 0',
        ),
        ('  design: optimal\n  tool_std_m: 0.3\n', 'if millimetres were meant, write 0.0003'),
    ],
)
def test_wrong_keys_of_poses_are_one_line(tmp_path, keys, message):
    assert message in refused(tmp_path, poses(keys))


@pytest.mark.parametrize(
    ('changes', 'message'),
    [
        ([noise('noise_m: 0')], 'sensors.mocap.noise_m is'),
        ([noise('noise_m: 0.1')], 'sensors.mocap.noise_m is'),
        ([noise('pose_noise_m: -1')], 'sensors.mocap.pose_noise_m is'),
        (
            [of_type('Pose')],
            "message_type is 'geometry_msgs/msg/Pose'; it can be geometry_msgs/msg/PointStamped",
        ),
        (
            [(TOPIC, '    topic: /t\n    source: /s')],
            'sensors.mocap.source is no key; write it as topic, and give its message_type',
        ),
        ([of_type('PointStamped', 'tracker')], 'sensors.tracker.single_shot is for instruments'),
        (
            [(TOPIC, f'    mounted_on: tool\n{TOPIC}')],
            'sensors.mocap.mounted_on: a sensor on the tool measures how what stands is turned',
        ),
        (
            [on_tool(), ('    marker: smr\n', '    marker: sir\n')],
            'sensors.mocap.marker: of a sensor on the tool it is its own origin there',
        ),
        (
            [on_tool(), (BAR, f'{BAR}    further_markers: {{smr: 2}}\n')],
            'and no further_markers',
        ),
        (markers('{b: 2, z: 3}'), "has 'z'; markers has b, c, sir, smr"),
        (markers('{sir: 2}'), "has 'sir', which is its marker already"),
        (markers('{b: 2, c: 2}'), 'two markers have the number 2'),
        (markers('{b: 0}'), 'markers of a body have the numbers 1 to 65535'),
        (markers('{b: two}'), 'Expected `int`'),
        (markers('{near: 2}', '  near: [0.11, 0.0, 0.0]\n'), 'sir and near are 10 mm apart'),
        (
            markers('{b-b: 2}', '  b-b: [0.0, 0.11, 0.0]\n'),
            'name the marker with letters, digits and underscores',
        ),
    ],
)
def test_wrong_keys_of_sensors_are_one_line(tmp_path, changes, message):
    assert message in refused(tmp_path, *changes)


@pytest.mark.parametrize(
    ('old', 'new', 'words'),
    [
        ('markers:', 'markerz:', "unknown key 'markerz'; did you mean 'markers'?"),
        (TOPIC, TOPIC.replace('topic', 'topc'), "unknown key 'topc'; did you mean 'topic'?"),
        ('floor_z_m:', 'q:', "unknown key 'q'; the keys here are robot, mar"),
        ('single_shot: false', 'single_shot: 3', 'sensors.mocap.single_shot: Expected'),
        ('[-0.1, 0.0, 0.0]', '[-0.1]', 'markers.smr: Expected `array` of len'),
        ('marker_std_m: 0.5e-3', 'marker_std_m: 5', 'marker_std_m is 5; it must be'),
        ('_deg: 25.0', '_deg: 1', 'sensors.tracker.max_angle_deg is'),
        ('aim_at: tracker', 'aim_at: traker', "aim_at 'traker' is none of the sensors "),
        ('held_joint: joint_3', 'held_joint: joint3', "held_joint 'joint3' is none of "),
    ],
)
def test_a_wrong_cell_names_line_key_and_what_was_meant(tmp_path, old, new, words):
    message = refused(tmp_path, (old, new))
    assert f'line {DEMO[: DEMO.index(old)].count(chr(10)) + 1}: {words}' in message
    named = ('markerz', 'topc', 'traker', 'joint3')
    assert ('did you mean' in message) == any(name in new for name in named)


@pytest.mark.parametrize(
    ('name', 'wrong', 'words', 'file'),
    [
        ('marker: smr', 'r', "tracker.marker is 'smrr'; markers has sir, smr", 'cell.yaml'),
        ('tip_link: tool', 's', "no link 'tools'; it has base_link", 'lwr4plus.urdf'),
    ],
)
def test_a_name_that_is_nearly_one_is_asked_for(tmp_path, name, wrong, words, file):
    message = refused(tmp_path, (name, name + wrong), file=file)
    assert words in message
    assert 'did you mean' in message


def test_keys_reach_the_design(tmp_path):
    keys = '  order: fastest\n  tool_share: 0.25\n  joint_std_deg: 0.003\n'
    path = cell_file(
        tmp_path,
        poses(f'  design: optimal\n{keys}  {BOX}'),
        noise('noise_m: 0.0003\n    pose_noise_m: 0.003'),
    )
    settings = read_cell(path).design_settings()
    assert settings.optimal
    assert settings.whole_poses
    assert settings.fastest
    assert settings.tool_share == 0.25
    assert settings.joint_std_rad == pytest.approx(5.236e-5, rel=1e-3)
    assert settings.box is not None
    assert settings.box.size_m.tolist() == [0.2, 0.3, 0.2]
    bar, tracker = settings.sensors
    assert (bar.sigma_m, bar.pose_sigma_m) == (3e-4, 3e-3)
    assert (tracker.sigma_m, tracker.pose_sigma_m) == (1e-4, 2e-4)


def test_a_plan_depends_on_the_keys_and_not_on_where_the_file_lies(tmp_path):
    """Nor on a default that is written out."""
    (tmp_path / 'elsewhere').mkdir()
    plain = read_cell(cell_file(tmp_path)).fingerprint()
    stated = cell_file(tmp_path / 'elsewhere', noise('noise_m: 1.0e-4'))
    assert read_cell(stated).fingerprint() == plain
    box = 'obstacles: {box: {center_m: [1, 0, 0], size_m: [1, 1, 1]}}'
    orders, noisier = poses('  order: fastest\n'), noise('noise_m: 2.0e-4')
    for change in (orders, noisier, ('obstacles: {}', box)):
        assert read_cell(cell_file(tmp_path, change)).fingerprint() != plain


@pytest.mark.parametrize(
    ('keys', 'joint', 'tool'),
    [
        ('', None, None),
        ('  joint_std_deg: 0.003\n', 5.236e-5, None),
        ('  tool_std_m: 0.0001\n', None, 1e-4),
        ('  design: optimal\n  joint_std_deg: 0.003\n', 5.236e-5, None),
        # The design is also made for a tool error that no one has stated.
        ('  design: optimal\n  tool_share: 0.5\n  joint_std_deg: 0.003\n', None, None),
        (
            '  design: optimal\n  tool_share: 0.5\n  joint_std_deg: 0.003\n  tool_std_m: 0.0001\n',
            5.236e-5,
            1e-4,
        ),
    ],
)
def test_what_ends_a_collection_is_what_counts_and_is_stated(tmp_path, keys, joint, tool):
    goal = StoppingGoal.of(read_cell(cell_file(tmp_path, poses(keys))).poses)
    assert goal.joint_std_rad == (joint if joint is None else pytest.approx(joint, rel=1e-3))
    assert goal.tool_std_m == tool
    assert goal.stated == (joint is not None or tool is not None)


def test_a_folder_of_the_name_of_a_shipped_cell_hides_it_not(tmp_path, monkeypatch):
    """`remaster demo --out demo` makes one where its nodes look for the cell."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'demo').mkdir()
    assert read_cell('demo').poses.design == 'latin_hypercube'
    for folder in (tmp_path / 'demo', tmp_path):
        with pytest.raises(InputError, match='not a regular file'):
            read_cell(folder)


def test_a_cell_with_several_markers(tmp_path):
    made = read_cell(cell_file(tmp_path, *markers('{b: 2, c: 3}')))
    bar = made.sensors['mocap']
    assert bar.markers == ('sir', 'b', 'c')
    topic = 'optitrack/marker'
    assert bar.topics == {'sir': topic, 'b': f'{topic}/b', 'c': f'{topic}/c'}
    (expected, _) = made.design_settings().sensors
    assert list(expected.markers) == ['sir', 'b', 'c']


def test_readings_of_another_package_are_published_beside_those_of_other_sensors(tmp_path):
    cell = read_cell(cell_file(tmp_path, of_type('PoseStamped')))
    bar, tracker = cell.sensors['mocap'], cell.sensors['tracker']
    assert (bar.source, bar.topic) == ('/vrpn/tool', 'mocap/marker')
    assert (tracker.source, tracker.topic) == ('', 'laser_tracker/marker')
    assert cell.fingerprint() != read_cell('demo').fingerprint()
