"""The keys that choose poses and name markers: one clear line for each that is wrong."""

import pytest

from remaster_ros.errors import InputError
from remaster_ros.session.workcell import config_path, parse_cell, read_cell


def cell_file(folder, poses='', sensor=''):
    text = config_path('cells/demo.yaml').read_text(encoding='utf-8')
    robots = config_path('robots')
    if 'design:' in poses:
        text = text.replace('  design: latin_hypercube\n', '')
    text = text.replace('../robots', str(robots)).replace('poses:\n', f'poses:\n{poses}', 1)
    text = text.replace('    max_angle_deg: 60.0', f'{sensor}    max_angle_deg: 60.0', 1)
    path = folder / 'cell.yaml'
    path.write_text(text, encoding='utf-8')
    return path


@pytest.mark.parametrize(
    ('poses', 'message'),
    [
        ('  design: best\n', "poses.design is 'best'; write optimal or latin_hypercube"),
        ('  order: fast\n', "poses.order is 'fast'; write nearest or fastest"),
        ('  solutions: one\n', "poses.solutions is 'one'; write all or chosen"),
        ('  solutions: chosen\n', 'poses.solutions: chosen has no effect with design: latin_hyp'),
        ('  tool_share: 0.5\n', 'poses.tool_share has no effect with design: latin_hypercube'),
        (
            '  tool_box: {center_m: [0.4, 0, 0.5], size_m: [0.2, 0.3, 0.2]}\n',
            'poses.tool_box has no effect without tool_std_m',
        ),
        ('  design: optimal\n  tool_share: 2\n', 'poses.tool_share is 2; it must be from 0 to 1'),
        ('  design: optimal\n  joint_std_deg: 0\n', 'poses.joint_std_deg is 0; it must be above'),
        ('  design: optimal\n  tool_std_m: 0.0001\n', 'poses.tool_std_m has no effect with tool'),
        (
            '  design: optimal\n  tool_share: 1.0\n  joint_std_deg: 0.003\n',
            'poses.joint_std_deg has no effect with tool_share: 1',
        ),
        (
            '  design: optimal\n  tool_box: {center_m: [0.4, 0, 0.5], size_m: [0.2, 0, 0.2]}\n',
            'poses.tool_box.size_m is 0; it must be above 0',
        ),
        ('  design: optimal\n  tool_std_m: 0.3\n', 'if millimetres were meant, write 0.0003'),
    ],
)
def test_wrong_keys_are_one_line(tmp_path, poses, message):
    with pytest.raises(InputError) as caught:
        read_cell(cell_file(tmp_path, poses))
    assert message in str(caught.value)
    assert 'cell.yaml' in str(caught.value)
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize('noise', ['noise_m: 0', 'noise_m: 0.1', 'pose_noise_m: -1'])
def test_noise_that_cannot_be_is_one_line(tmp_path, noise):
    with pytest.raises(InputError, match=r'sensors\.mocap.*noise_m is'):
        read_cell(cell_file(tmp_path, sensor=f'    {noise}\n'))


def test_keys_reach_the_design(tmp_path):
    poses = (
        '  design: optimal\n  order: fastest\n  tool_share: 0.25\n  joint_std_deg: 0.003\n'
        '  tool_box: {center_m: [0.4, 0, 0.5], size_m: [0.2, 0.3, 0.2]}\n'
    )
    noise = '    noise_m: 0.0003\n    pose_noise_m: 0.003\n'
    settings = read_cell(cell_file(tmp_path, poses, noise)).design_settings()
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


def test_a_plan_depends_on_the_keys_and_defaults_are_as_before(tmp_path):
    plain = read_cell(cell_file(tmp_path)).fingerprint()
    stated = cell_file(tmp_path, '  design: latin_hypercube\n', '    noise_m: 1.0e-4\n')
    assert read_cell(stated).fingerprint() == plain
    assert read_cell(cell_file(tmp_path, '  order: fastest\n')).fingerprint() != plain
    noisy = cell_file(tmp_path, sensor='    noise_m: 2.0e-4\n')
    assert read_cell(noisy).fingerprint() != plain


@pytest.mark.parametrize(
    ('poses', 'joint', 'tool'),
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
def test_what_ends_a_collection_is_what_counts_and_is_stated(tmp_path, poses, joint, tool):
    goal = read_cell(cell_file(tmp_path, poses)).poses.stopping_goal()
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


def cell_with(change, markers):
    """Return the demo cell with the marker line of its bar changed."""
    path = config_path('cells/demo.yaml')
    text = path.read_text()
    text = text.replace('markers:\n', f'markers:\n{markers}', 1)
    return parse_cell(text.replace('    marker: sir\n', change, 1).encode(), path)


BODY = '  b: [0.05, 0.05, 0.0]\n  c: [0.0, -0.05, 0.03]\n'


def test_a_cell_with_several_markers():
    made = cell_with('    marker: sir\n    further_markers: {b: 2, c: 3}\n', BODY)
    bar = made.sensors['mocap']
    assert bar.markers == ('sir', 'b', 'c')
    assert bar.topics == {
        'sir': 'optitrack/marker',
        'b': 'optitrack/marker/b',
        'c': 'optitrack/marker/c',
    }
    (expected, _) = made.design_settings().sensors
    assert list(expected.markers) == ['sir', 'b', 'c']


@pytest.mark.parametrize(
    ('markers', 'words'),
    [
        ('{b: 2, z: 3}', "has 'z'; markers has b, c, sir, smr"),
        ('{sir: 2}', "has 'sir', which is its marker already"),
        ('{b: 2, c: 2}', 'two markers have the number 2'),
        ('{b: 0}', 'markers of a body have the numbers 1 to 65535'),
        ('{b: two}', 'Expected `int`'),
        ('{near: 2}', 'sir and near are 10 mm apart'),
        ('{b-b: 2}', 'name the marker with letters, digits and underscores'),
    ],
)
def test_markers_that_cannot_be_are_refused(markers, words):
    further = f'    marker: sir\n    further_markers: {markers}\n'
    extra = BODY
    if 'near' in markers:
        extra += '  near: [0.11, 0.0, 0.0]\n'
    if 'b-b' in markers:
        extra += '  b-b: [0.0, 0.11, 0.0]\n'
    with pytest.raises(InputError, match='demo') as refused:
        cell_with(further, extra)
    assert words in str(refused.value)
    assert '\n' not in str(refused.value)
