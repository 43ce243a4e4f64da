# SPDX-License-Identifier: Apache-2.0
"""A take and a log of joints with two clocks become rows: one for each stop that both have."""

import itertools
import re

import numpy as np
import pytest
from foreign.streams import arm_of, capture_of, log_of, run_of, seen, take_of
from foreign.tables import text, write

from remaster_ros.errors import InputError
from remaster_ros.importing.columns import ColumnChoice
from remaster_ros.importing.rows import TableOptions, read_rows

UNIX_S = 1_772_715_731.344


@pytest.fixture(scope='module')
def arm():
    return arm_of()


@pytest.fixture(scope='module')
def run(arm):
    return run_of(arm)


def rows_of(folder, arm, take, log, **options):
    paths = [write(folder, 'take.csv', take), write(folder, 'log.csv', log)]
    return read_rows(paths, arm.chain, TableOptions(**options))


def assert_stops(rows, arm, which=slice(None), tolerance_m=2e-4):
    """The rows are these stops, and the points those that were measured there."""
    np.testing.assert_allclose(rows.q, arm.q[which], atol=2e-6)
    assert np.linalg.norm(rows.position - arm.points[which], axis=1).max() < tolerance_m


@pytest.mark.parametrize(
    ('version', 'unit', 'separator', 'decimal'),
    [('1.23', 'Millimeters', ',', '.'), ('1.25', 'Meters', ';', ',')],
)
def test_a_take_and_a_log_of_another_clock(
    version, unit, separator, decimal, arm, run, tmp_path, imported
):
    # The take begins in the third stop, and ends in the last but one.
    begins, ends = run.begin[2] + 0.4, run.end[-2] - 0.1
    take = take_of(run, version, unit, separator, begins, ends)
    log = log_of(run, UNIX_S, decimal=decimal)
    rows = rows_of(tmp_path, arm, take, log)
    assert_stops(rows, arm, slice(2, -1))
    assert set(rows.labels['marker']) == {'tool'}
    offset = float(re.search(r'take.csv \+([0-9.]+) s', ' '.join(rows.description))[1])
    assert offset == pytest.approx(UNIX_S + begins, abs=0.05)
    assert 'agree within 0.0' in ' '.join(rows.description)
    assert rows.samples.min() > 20
    assert 0.5e-4 < np.median(rows.std) < 2e-4
    # The command says so, and writes the session.
    (out, _), session = imported(arm.urdf, tmp_path / 'take.csv', tmp_path / 'log.csv')
    assert '21 of 21 standstills of take.csv match 21 of 24' in out
    assert len(session.measurements) == 21
    assert [*session.markers] == ['tool']
    assert session.measurements.orientation is not None


def test_a_point_of_a_take_is_taken_by_its_name(arm, run, tmp_path):
    take, log = take_of(run), log_of(run, 5.0)
    rows = rows_of(tmp_path, arm, take, log)
    named = rows_of(tmp_path, arm, take, log, chosen=ColumnChoice(points=('tool:Marker1',)))
    np.testing.assert_allclose(named.position - rows.position, 1e-3, atol=1e-6)


@pytest.mark.parametrize('objects', [True, False])
def test_a_capture_of_vicon(objects, arm, run, tmp_path):
    rows = rows_of(tmp_path, arm, capture_of(run, objects=objects), log_of(run, UNIX_S))
    assert_stops(rows, arm)
    assert {*rows.labels['marker']} == {'tool' if objects else 'arm:tool'}
    assert (rows.orientation is not None) == objects
    remark = 'sections left out' if not objects else 'base stays in its place'
    assert remark in ' '.join(rows.warnings)


@pytest.mark.parametrize(
    ('old', 'new', 'words'),
    [
        ('\n60\n', '\n\n', "line 2: '', where the number of frames per second"),
        ('Objects', 'Forces', 'line 1: .*a section Objects'),
        ('mm,mm,mm\n', 'mm,mm,\n', 'line 5: .*the unit of each column'),
        ('\n7,0', '\n5,0', 'line 12: .*a frame after 5'),
        ('\n7,0,', '\n7,0;', 'line 12: .*a frame, a sub frame and 14 more cells'),
    ],
)
def test_a_damaged_capture_names_its_line(old, new, words, arm, run, tmp_path):
    capture = capture_of(run)
    assert old in capture
    with pytest.raises(InputError, match=words):
        rows_of(tmp_path, arm, capture.replace(old, new, 1), log_of(run))


def pieces_of(run, markers, pieces, overlap, seed=2):
    """Return a take of markers whose labels were lost: each in pieces, and a reflex at rest."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(0.0, run.end[-1], 1.0 / 60.0)
    tool = 1e3 * seen(run, time_s, 1, 1e-4)
    columns = []
    for i in range(markers):
        ends = np.linspace(0, len(tool), pieces + 1).astype(int) + 7 * i
        for begin, end in itertools.pairwise(ends):
            part = np.full(tool.shape, np.nan)
            part[begin : end + overlap] = (tool + [0.0, 40.0 * i, 0.0])[begin : end + overlap]
            columns.append(part)
    columns.append(np.tile([500.0, 100.0, 1000.0], (len(tool), 1)))
    names = [f'Unlabeled {1000 + i}' for i in range(len(columns))]
    order = rng.permutation(len(columns))
    head = ['Format Version,1.23,Length Units,Millimeters', f',Type{3 * len(names) * ",Marker"}']
    head += [',Name' + ''.join(3 * f',{names[i]}' for i in range(len(names)))]
    head += [f',{3 * len(names) * ",Position"}', f'Frame,Time (Seconds){len(names) * ",X,Y,Z"}']
    values = np.column_stack([columns[i] for i in order])
    rows = [
        f'{i},{t:.6f},{",".join("" if np.isnan(v) else f"{v:.4f}" for v in row)}'
        for i, (t, row) in enumerate(zip(time_s, values))
    ]
    return '\n'.join([*head, *rows, ''])


@pytest.mark.parametrize(('markers', 'overlap'), [(1, 20), (1, -5), (2, -5)])
def test_pieces_of_markers_without_labels(markers, overlap, arm, run, tmp_path):
    take = pieces_of(run, markers, 5, overlap)
    rows = rows_of(tmp_path, arm, take, log_of(run, UNIX_S))
    of = rows.labels.get('marker', [''] * len(rows.q))
    labels = [*dict.fromkeys(of)]
    assert len(labels) == markers
    assert f'{5 * markers} pieces of markers without a label are of {markers}' in rows.warnings
    assert min(of.count(label) for label in labels) >= len(arm.q) - 1
    if markers == 1:
        assert_stops(rows, arm)


def test_pieces_that_belong_to_none_are_refused(arm, run, tmp_path):
    with pytest.raises(InputError, match=r'line 5: .*label them in Motive, or make them a rigid'):
        rows_of(tmp_path, arm, pieces_of(run, 2, 5, -60), log_of(run))


def test_visits_that_are_all_alike_are_told_apart_by_the_robot(arm, tmp_path):
    run = run_of(arm, alike=True)
    # Every offset by a multiple of a visit fits to begins and ends.
    take = take_of(run, begins_s=run.begin[4] - 0.3, ends_s=run.end[-5] + 0.3)
    assert_stops(rows_of(tmp_path, arm, take, log_of(run, 100.0)), arm, slice(4, -4))


def test_where_several_offsets_do_and_no_robot_decides_it_is_asked_for(arm, tmp_path):
    run = run_of(arm, alike=True)
    begins, ends = run.begin[4] - 0.3, run.end[-5] + 0.3
    take, log = take_of(run, begins_s=begins, ends_s=ends), log_of(run, 100.0)
    other = arm_of(seed=3).chain.__class__.from_urdf(
        arm.urdf.replace('xyz="0 0 0.27"', 'xyz="0.5 0.9 0.27"').replace(
            'axis xyz="0 1 0"', 'axis xyz="1 0 0"'
        ),
        arm.chain.base_link,
        arm.chain.tip_link,
    )
    paths = [write(tmp_path, 'take.csv', take), write(tmp_path, 'log.csv', log)]
    with pytest.raises(InputError, match=r'several offsets of the clocks \(.*--clock-offset'):
        read_rows(paths, other, TableOptions())
    chosen = read_rows(paths, other, TableOptions(clock_offset_s=100.0 + begins))
    assert_stops(chosen, arm, slice(4, -4))


@pytest.mark.parametrize('offset', [0.02, 0.1, 0.4, -0.6])
def test_clocks_that_differ_by_less_than_a_stop_are_not_the_same(offset, arm, run, tmp_path):
    """Every standstill overlaps with its own at once, but the means would hold motion."""
    rows = rows_of(tmp_path, arm, take_of(run), log_of(run, offset, rate_hz=10.0))
    assert_stops(rows, arm)
    words = ' '.join(rows.description)
    assert ('the clocks are the same' in words) == (abs(offset) < 0.05)
    if abs(offset) > 0.05:
        found = float(re.search(r'take.csv ([-+0-9.]+) s', words)[1])
        assert found == pytest.approx(offset, abs=0.06)


def test_shots_are_paired_with_a_log_of_another_clock(arm, run, tmp_path):
    shots = 0.5 * (run.begin + run.end)
    shots = np.delete(shots, [3, 7])
    points = seen(run, shots, 2, 3e-5)
    table = text(['name', 'X', 'Y', 'Z', 'time'], [[f'M{i}' for i in range(22)], *points.T, shots])
    rows = rows_of(tmp_path, arm, table, log_of(run, 5123.4))
    assert_stops(rows, arm, np.delete(np.arange(24), [3, 7]))
    np.testing.assert_allclose(rows.stamp_s, shots + 5123.4, atol=1.0)


def test_shots_at_times_of_their_own_are_paired_by_order_where_the_robot_agrees(
    arm, run, tmp_path
):
    points = seen(run, 0.5 * (run.begin + run.end), 2, 3e-5)
    # The times are those of typing them in: a minute each.
    table = text(
        ['name', 'X', 'Y', 'Z', 'time'],
        [[f'M{i}' for i in range(24)], *points.T, 60.0 * np.arange(24)],
    )
    rows = rows_of(tmp_path, arm, table, log_of(run, 5123.4))
    assert 'by their order' in ' '.join(rows.description)
    assert_stops(rows, arm)


@pytest.mark.parametrize('chosen', ['', 'order'])
def test_points_without_times_belong_to_the_standstills_by_order(chosen, arm, run, tmp_path):
    points = seen(run, 0.5 * (run.begin + run.end), 2, 3e-5)
    names = [f'M{i}' for i in range(len(points))]
    log = log_of(run, 5.0)

    def table(points):
        return text(['name', 'X', 'Y', 'Z'], [names[: len(points)], *points.T])

    rows = rows_of(tmp_path, arm, table(points), log, join=chosen)
    assert_stops(rows, arm)
    assert rows.stamp_s is not None
    with pytest.raises(InputError, match=r'23 points, and 24 standstills in log.csv; only'):
        rows_of(tmp_path, arm, table(points[1:]), log, join=chosen)
    if not chosen:
        with pytest.raises(InputError, match=r'take.csv has no times, and by their order'):
            rows_of(tmp_path, arm, table(points[::-1]), log)


def test_a_stream_that_never_stands_still_is_refused(arm, tmp_path):
    time_s = np.arange(0.0, 20.0, 0.05)
    q = np.sin(0.5 * time_s[:, None] + np.arange(6.0))
    names = ['__time', *[f'/joint_states/{name}/position' for name in arm.chain.joint_names]]
    log = text(names, [time_s, *q.T])
    with pytest.raises(InputError, match=r'joints never stand still for 0.5 s.*let the arm stop'):
        rows_of(tmp_path, arm, take_of(run_of(arm)), log)


def test_joints_and_points_in_one_stream_are_a_row_a_stop(arm, run, tmp_path):
    time_s = np.arange(0.0, run.end[-1], 0.04)
    table = text(
        ['time', *[f'A{i}' for i in range(1, 7)], 'X', 'Y', 'Z'],
        [time_s, *np.rad2deg(run.joints(time_s)).T, *seen(run, time_s, 3, 3e-5).T],
    )
    rows = read_rows([write(tmp_path, 't.csv', table)], arm.chain, TableOptions())
    assert_stops(rows, arm)
    assert rows.samples.min() >= 10


@pytest.mark.parametrize(
    ('old', 'new', 'words'),
    [
        ('Length Units,Millimeters', 'Length Units,Leagues', r'line 1: .*Length Units such as'),
        ('Frame,Time', 'Image,Time', r'the line Frame, Time, … is expected'),
        ('\r\n7,', '\r\n7;', r"line 15: '7;.*a frame, its time and \d+ more cells is expected"),
        (',Name,', ',Nom,', r'a line with \d+ cells and Name above this one is expected'),
        ('\r\n9,0.15', '\r\n9,0.05', r'line 17: .*a time after 0.133333 s is expected'),
    ],
)
def test_a_damaged_take_names_its_line_and_what_is_expected(old, new, words, arm, run, tmp_path):
    take = take_of(run, ends_s=3.0)
    assert old in take
    with pytest.raises(InputError, match=words):
        rows_of(tmp_path, arm, take.replace(old, new, 1), log_of(run))
