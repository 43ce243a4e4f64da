# SPDX-License-Identifier: Apache-2.0
"""Joining two tables, poses by equal goals, fair splits, and what is refused with its row."""

from pathlib import Path

import numpy as np
import pytest
from foreign.tables import measured, text, write
from rigs.command_line import remaster, run

from remaster_ros.errors import InputError
from remaster_ros.importing.rows import TableOptions, read_rows
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.session.records.reader import read_session

DATA = Path(__file__).parents[4] / 'shared' / 'data'


@pytest.fixture
def chain(session):
    return SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link)


def points(folder, names, xyz, **more):
    columns = [names, *np.transpose(xyz), *more.values()]
    return write(folder, 'points.csv', text(['name', 'X', 'Y', 'Z', *more], columns))


def joints(folder, names, q, **more):
    columns = [names, *np.transpose(q), *more.values()]
    return write(folder, 'joints.csv', text(['name', 'A1', 'A2', *more], columns))


XYZ = np.array([[1.0, 0.5, 0.2], [1.5, 0.1, 0.3], [0.2, 0.9, 0.1]])
Q = np.array([[0.1, 0.2], [0.3, -0.4], [-0.5, 0.6]])


def test_names_are_the_same_in_any_spelling_and_order(chain, tmp_path):
    paths = [points(tmp_path, ['P03', 'p1', 'P2 '], XYZ), joints(tmp_path, ['P1', 'P2', 'P4'], Q)]
    rows = read_rows(paths, chain, TableOptions(angles='rad', length='m'))
    np.testing.assert_allclose(rows.q, Q[:2])
    np.testing.assert_allclose(rows.position, XYZ[1:])
    assert any('P03: not in the other table' in warning for warning in rows.warnings)
    assert any('P4: not in the other table' in warning for warning in rows.warnings)
    # The tables in the other order are the same.
    again = read_rows(paths[::-1], chain, TableOptions(angles='rad', length='m'))
    np.testing.assert_array_equal(again.q, rows.q)


def test_a_name_given_twice_is_refused(chain, tmp_path):
    paths = [points(tmp_path, ['P1', 'P2', 'P1'], XYZ), joints(tmp_path, ['P1', 'P2', 'P3'], Q)]
    with pytest.raises(
        InputError, match=r"points.csv, line 4, column name: 'P1' is also on line 2"
    ):
        read_rows(paths, chain, TableOptions())


def test_rows_without_names_or_times_are_joined_by_order_only_where_told(chain, tmp_path):
    paths = [points(tmp_path, ['a', 'b', 'c'], XYZ), joints(tmp_path, ['1', '2', '3'], Q)]
    with pytest.raises(
        InputError, match='neither names nor times in common; both have 3 rows: if'
    ):
        read_rows(paths, chain, TableOptions())
    rows = read_rows(paths, chain, TableOptions(join='order', angles='rad', length='m'))
    np.testing.assert_allclose(rows.q, Q)


def test_a_stream_of_joints_is_joined_by_time_where_the_arm_stood_still(chain, tmp_path):
    time = np.arange(0.0, 30.0, 0.1)
    stop = (time // 10).astype(int)
    moving_markers = time % 10 > 8.0
    q = Q[stop] + np.where(moving_markers, 0.2 * (time % 10 - 8.0), 0.0)[:, None]
    q_file = joints(tmp_path, [f'r{i}' for i in range(300)], q, time=time)
    when = np.array([4.03, 19.03, 25.03])
    p_file = points(tmp_path, ['a', 'b', 'c'], XYZ, time=when)
    rows = read_rows([p_file, q_file], chain, TableOptions(angles='rad', length='m'))
    # The second point fell into a motion.
    np.testing.assert_allclose(rows.q, Q[[0, 2]], atol=1e-6)
    np.testing.assert_allclose(rows.stamp_s, when[[0, 2]])
    assert any('line 3: measured while the arm moved' in text for text in rows.warnings)
    late = points(tmp_path, ['a', 'b', 'c'], XYZ, time=when + 1000.0)
    with pytest.raises(InputError, match=r'its times \(1004.0 to 1025.0 s\) are not those of'):
        read_rows([late, q_file], chain, TableOptions(join='time'))
    with pytest.raises(InputError, match=r'several offsets of the clocks .* with --clock-offset'):
        read_rows([late, q_file], chain, TableOptions())
    chosen = TableOptions(angles='rad', length='m', clock_offset_s=-1000.0)
    np.testing.assert_allclose(read_rows([late, q_file], chain, chosen).stamp_s, when[[0, 2]])


def test_rows_stand_in_the_order_of_their_times(chain, tmp_path):
    header = ['A1', 'A2', 'X', 'Y', 'Z', 'time']
    path = write(tmp_path, 't.csv', text(header, [*Q.T, *XYZ.T, [3.0, 1.0, 2.0]]))
    rows = read_rows([path], chain, TableOptions(angles='rad', length='m')).in_order()
    np.testing.assert_allclose(rows.q, Q[[1, 2, 0]])
    assert rows.source[0] == f'{path}, line 3'
    assert rows.warnings == ('the rows were put in the order of their times',)


@pytest.fixture
def do(tmp_path):
    arm = measured(rows=48)
    urdf = tmp_path / 'robot.urdf'
    urdf.write_text(arm.urdf)

    def imported(header, columns, *args):
        path = write(tmp_path, 't.csv', text(header, columns))
        out = tmp_path / 'session'
        process = run('import', path, *args, '--urdf', urdf, '--out', out)
        if process.returncode:
            assert process.stderr.count('\n') == 1
            assert not out.exists()
        return read_session(out) if process.returncode == 0 else process.stderr

    return arm, imported


def columns(arm):
    return [*np.rad2deg(arm.q).T, *(1e3 * arm.points.T)]


def twice(arm):
    """Return the columns of the first 24 rows, each of them two times."""
    return [np.repeat(column[:24], 2) for column in columns(arm)]


HEADER = ['A1', 'A2', 'A3', 'A4', 'A5', 'A6', 'X', 'Y', 'Z']


def test_equal_goals_are_one_pose_and_every_run_of_poses_holds_one_out(do):
    arm, run = do
    # Every second row returns to a goal before it, a little off, as a controller reports it.
    q, points = arm.q.copy(), arm.points.copy()
    q[1::2] = q[0::2] + 1e-5
    points[1::2] = points[0::2]
    made = run(HEADER, [*np.rad2deg(q).T, *(1e3 * points.T)]).measurements
    assert made.pose.tolist() == [i // 2 for i in range(48)]
    assert made.configuration.tolist() == list(range(48))
    held_out = np.unique(made.pose[made.is_validation])
    assert len(held_out) == 6
    assert np.unique(held_out // 4).tolist() == [0, 1, 2, 3, 4, 5]
    assert np.all(made.is_validation[0::2] == made.is_validation[1::2])


def test_the_seed_decides_what_is_held_out(do, tmp_path):
    arm, run = do
    held_out = []
    for seed in (0, 0, 1):
        made = run(HEADER, columns(arm), '--seed', seed).measurements
        held_out.append(np.flatnonzero(made.is_validation).tolist())
        for path in (tmp_path / 'session').iterdir():
            path.unlink()
        (tmp_path / 'session').rmdir()
    assert held_out[0] == held_out[1] != held_out[2]
    assert len(held_out[0]) == 12


def test_poses_splits_sensors_and_markers_of_the_table_are_kept(do):
    arm, run = do
    header = ['pose', 'split', 'sensor', 'marker', *HEADER, 'temp', 'samples', 'Std X', 'Std Y']
    header += ['Std Z']
    pose = [f'goal {i // 4}' for i in range(48)]
    split = ['fit' if i // 4 % 3 else 'test' for i in range(48)]
    labels = [pose, split, ['lt'] * 48, ['a', 'b'] * 24]
    more = [[21.5] * 48, [10] * 48, *[[0.01] * 48] * 3]
    session = run(header, [*labels, *columns(arm), *more], '--visited-in-order')
    made = session.measurements
    assert made.pose.tolist() == [i // 4 for i in range(48)]
    assert made.is_validation.tolist() == [i // 4 % 3 == 0 for i in range(48)]
    assert (session.sensor_names, session.marker_names) == (('lt',), ('a', 'b'))
    assert np.all(made.temperature_c == 21.5)
    assert np.all(made.samples == 10)
    np.testing.assert_allclose(made.std, 1e-5)
    assert np.all(np.isnan(made.from_q[0]))
    np.testing.assert_array_equal(made.from_q[1:], made.q[:-1])


def test_an_unknown_split_is_named(do):
    arm, run = do
    error = run(['split', *HEADER], [['fit', 'maybe'] * 24, *columns(arm)])
    assert "t.csv, line 3, column split: 'maybe' is neither" in error


def test_two_markers_at_one_stop_are_one_configuration(do):
    arm, run = do
    made = run(['marker', *HEADER], [['a', 'b'] * 24, *twice(arm)]).measurements
    assert made.configuration.tolist() == [i // 2 for i in range(48)]
    assert made.frame is None


def test_two_markers_at_one_moment_are_one_frame(do):
    """Measured one after the other, as the last two are, they share no error."""
    arm, run = do
    time = np.repeat(10.0 * np.arange(24), 2)
    time[-1] += 2.0
    made = run(['marker', 'time', *HEADER], [['a', 'b'] * 24, time, *twice(arm)]).measurements
    assert made.frame.tolist() == [*np.repeat(np.arange(23), 2).tolist(), -1, -1]


def test_joints_outside_their_limits_name_the_row_and_the_remedies(do):
    arm, run = do
    q = np.rad2deg(arm.q)
    q[7, 4] = 170.0
    error = run(HEADER, [*q.T, *(1e3 * arm.points.T)])
    assert 't.csv, line 9, column A5: 170.000 degrees is outside the limits of joint_5' in error
    assert '1 of 48 rows' in error


@pytest.mark.parametrize(
    ('joint', 'share', 'said', 'option'),
    [
        (1, (1, 0, -90), '+90 degrees on A2', '--offset A2=90'),
        # As FANUC's pendants show joint 3.
        (2, (1, -1, 0), '+A2 added to A3 (it counts from the horizontal)', '--couple A3=A2'),
        (2, (-1, 0, 0), 'with A3 reversed the data fit to 0.', '--reverse A3'),
    ],
)
def test_what_a_pad_counts_otherwise_is_proposed_and_undone(do, joint, share, said, option):
    """``share``: of the joint itself, of that before it, and degrees, in what the table has."""
    arm, run = do
    q = np.rad2deg(arm.q)
    factor, before, added = share
    q[:, joint] = factor * q[:, joint] + before * q[:, joint - 1] + added
    table = [*q.T, *(1e3 * arm.points.T)]
    error = run(HEADER, table)
    assert said in error
    assert f'add {option};' in error
    made = run(HEADER, table, *option.split()).measurements
    np.testing.assert_allclose(made.q, arm.q, atol=1e-7)


@pytest.mark.parametrize(
    ('header', 'chosen', 'said', 'option'),
    [
        (HEADER, ('--length', 'in'), 'the points in mm', '--length mm'),
        (HEADER, ('--angles', 'rad'), '', '--angles deg'),
        (
            [*HEADER[:3], 'A5', 'A4', *HEADER[5:]],
            (),
            'with the joints in the order A1, A2, A3, A5, A4, A6 the data fit to 0.',
            '--joints A1,A2,A3,A5,A4,A6',
        ),
    ],
)
def test_units_and_columns_that_were_stated_wrongly_are_proposed(do, header, chosen, said, option):
    arm, run = do
    error = run(header, columns(arm), *chosen)
    assert said in error
    assert f'add {option};' in error


def test_another_robots_data_are_named_as_such(do, tmp_path):
    _, run = do
    other = measured('ur5e', rows=48)
    error = run(HEADER, columns(other), '--angles', 'deg')
    assert 'check that the URDF is that of this arm' in error or 'outside the limits' in error


@pytest.mark.parametrize('name', ['ur10_two_solutions', 'irb120_three_points'])
def test_real_sets_survive_the_way_through_a_foreign_table(name, tmp_path):
    if not (DATA / name).is_dir():
        pytest.skip(f'{DATA / name}: the measured sets are not part of this repository')
    session = read_session(DATA / name)
    m = session.measurements
    k = m.q.shape[1]
    header = ['Messung', 'Marker', *(f'A{i + 1} [deg]' for i in range(k)), 'X', 'Y', 'Z']
    table = text(
        header,
        [
            m.observation,
            [session.marker_names[i] for i in m.marker],
            *np.rad2deg(m.q).T,
            *(1e3 * m.position.T),
        ],
        ';',
        ',',
    )
    path = write(tmp_path, 't.csv', table, 'utf-16')
    out = tmp_path / 'session'
    urdf = DATA / name / 'robot.urdf'
    remaster('import', path, '--urdf', urdf, '--tip-link', 'tool', '--out', out)
    made = read_session(out).measurements
    np.testing.assert_allclose(made.q, m.q, atol=1e-7)
    np.testing.assert_allclose(made.position, m.position, atol=1e-8)
    # The goals of those who measured are not taken apart; those that they visited twice, under two
    # numbers, come together: the same place within their largest spread of 0.4 mm.
    pairs = {*zip(m.pose.tolist(), made.pose.tolist(), strict=True)}
    assert len(pairs) == len(np.unique(m.pose))
    chain = SerialChain.from_urdf(session.urdf, session.base_link, session.tip_link)
    places = chain.forward(m.q)[:, :3, 3]
    spread = [np.ptp(places[made.pose == pose], axis=0).max() for pose in np.unique(made.pose)]
    assert max(spread) < 0.5e-3
