# SPDX-License-Identifier: Apache-2.0
"""Data frames are read as the same table in a file is; their index joins two of them."""

import numpy as np
import pytest
from foreign.frames import Frame
from foreign.tables import measured, text, write

import remaster_ros
from remaster_ros.errors import InputError, InsufficientDataError


@pytest.fixture
def arm(tmp_path):
    (tmp_path / 'robot.urdf').write_text(measured().urdf)
    return measured()


@pytest.fixture(params=['stand-in', 'pandas'])
def frame(request):
    """Return a function from columns and labels to a frame."""
    if request.param == 'pandas':
        return pytest.importorskip('pandas', reason='pandas, which is never needed').DataFrame
    return Frame


JOINTS = [f'A{i}' for i in range(1, 7)]


def columns_of(arm):
    joints = dict(zip(JOINTS, np.rad2deg(arm.q).round(4).T, strict=True))
    points = dict(zip('XYZ', (1e3 * arm.points).round(3).T, strict=True))
    return joints, points


def array_frame(array, frame):
    return frame(dict(enumerate(array.T)))


def test_a_frame_is_the_table_in_a_file(arm, frame, tmp_path):
    joints, points = columns_of(arm)
    urdf = tmp_path / 'robot.urdf'
    both = remaster_ros.import_table(frame({**joints, **points}), urdf=urdf).measurements
    cells = [[f'{v:.12g}' for v in column] for column in (*joints.values(), *points.values())]
    table = write(tmp_path, 't.csv', text([*JOINTS, *'XYZ'], cells))
    of_file = remaster_ros.import_table(table, urdf=urdf).measurements
    np.testing.assert_array_equal(both.q, of_file.q)
    np.testing.assert_array_equal(both.position, of_file.position)
    two = remaster_ros.session_from(frame(joints), frame(points), urdf).measurements
    np.testing.assert_array_equal(two.q, of_file.q)
    np.testing.assert_array_equal(two.position, of_file.position)


@pytest.mark.parametrize('columns', ['counted', 'counted on', 'other numbers'])
@pytest.mark.parametrize('index', ['from 5', 'permuted', 'names'])
def test_frames_of_arrays_have_no_row_more_than_the_arrays(columns, index, arm, frame, tmp_path):
    """Column labels that are numbers are no row of data, whatever the index is."""
    urdf, n = tmp_path / 'robot.urdf', len(arm.q)
    rows = np.arange(5, n) if index == 'from 5' else np.random.default_rng(2).permutation(n)
    labels = [f'P{i:02d}' for i in rows] if index == 'names' else [int(i) for i in rows]
    first = {'counted': 0, 'counted on': 3, 'other numbers': -1.5}[columns]
    q, points = np.rad2deg(arm.q).round(4)[rows], (1e3 * arm.points).round(3)[rows]
    frames = [
        frame({first + i: column for i, column in enumerate(array.T)}, index=labels)
        for array in (q, points)
    ]
    found = remaster_ros.session_from(*frames, urdf).measurements
    arrays = [array_frame(array, frame) for array in (q, points)]
    of_arrays = remaster_ros.session_from(*arrays, urdf)
    np.testing.assert_array_equal(found.q, of_arrays.measurements.q)
    np.testing.assert_array_equal(found.position, of_arrays.measurements.position)


def test_a_frame_of_an_array_with_its_index_as_a_column(arm, frame, tmp_path):
    """As `reset_index` of pandas leaves it: a name among numbers."""
    urdf, values = tmp_path / 'robot.urdf', np.hstack([np.rad2deg(arm.q), 1e3 * arm.points])
    given = frame({'index': [*range(3, 3 + len(values))], **dict(enumerate(values.T))})
    with pytest.raises(InputError, match=r'the columns are index, column 0, column 1'):
        remaster_ros.import_table(given, urdf=urdf)
    names = [f'column {i}' for i in range(9)]
    found = remaster_ros.import_table(given, urdf=urdf, joints=names[:6], points=names[6:])
    np.testing.assert_allclose(found.measurements.q, arm.q, atol=1e-9)


def test_a_row_without_values_is_left_out_with_its_label(arm, frame, tmp_path, caplog):
    urdf, kept = tmp_path / 'robot.urdf', np.delete(np.arange(5, len(arm.q)), 3)
    q, points = np.rad2deg(arm.q).round(4)[5:], (1e3 * arm.points).round(3)[5:]
    q[3] = np.nan
    labels = range(5, len(arm.q))
    frames = [frame(dict(enumerate(array.T)), index=[*labels]) for array in (q, points)]
    found = remaster_ros.session_from(*frames, urdf).measurements
    np.testing.assert_allclose(found.q, arm.q[kept], atol=1e-6)
    assert 'joints, row 3: no value, left out' in caplog.text
    assert 'points: 8: not in the other table, left out' in caplog.text


@pytest.mark.parametrize('labels', ['names', 'numbers'])
def test_rows_belong_together_by_their_index(labels, arm, frame, tmp_path):
    joints, points = columns_of(arm)
    urdf, n = tmp_path / 'robot.urdf', len(arm.q)
    index = [f'P{i:02d}' for i in range(n)] if labels == 'names' else [*range(n)]
    right = remaster_ros.session_from(frame(joints), frame(points), urdf).measurements
    order = np.random.default_rng(1).permutation(n)
    mixed = frame(
        {name: np.asarray(column)[order] for name, column in joints.items()},
        index=[index[i] for i in order],
    )
    found = remaster_ros.session_from(mixed, frame(points, index=index), urdf).measurements
    np.testing.assert_array_equal(found.q, right.q)
    np.testing.assert_array_equal(found.position, right.position)


def test_a_row_with_nan_is_left_out_and_said(arm, frame, tmp_path, caplog):
    joints, points = columns_of(arm)
    urdf = tmp_path / 'robot.urdf'
    points['Y'] = points['Y'].copy()
    points['Y'][3] = np.nan
    for name in JOINTS:
        joints[name] = joints[name].copy()
        joints[name][5] = np.nan
    session = remaster_ros.session_from(frame(joints), frame(points), urdf)
    kept = np.delete(np.arange(len(arm.q)), [3, 5])
    np.testing.assert_allclose(session.measurements.q, arm.q[kept], atol=1e-6)
    np.testing.assert_allclose(session.measurements.position, arm.points[kept], atol=1e-6)
    assert 'points, row 3: no point, left out' in caplog.text
    assert 'joints, row 5: no value, left out' in caplog.text
    caplog.clear()
    gap = arm.points.copy()
    gap[7, 1] = np.nan
    assert len(remaster_ros.session_from(arm.q, gap, urdf).measurements) == len(arm.q) - 1
    assert 'row 7: not a number, left out' in caplog.text


def test_errors_name_arguments(arm, frame, tmp_path):
    joints, points = columns_of(arm)
    urdf = tmp_path / 'robot.urdf'
    other = dict(zip('UVW', points.values(), strict=True))
    turned = {**joints, 'A3': -joints['A3']}
    for call, words in (
        (lambda: remaster_ros.import_table(frame({**joints, **other}), urdf=urdf), 'with points'),
        (lambda: remaster_ros.session_from(frame(turned), frame(points), urdf), "reverse=['A3']"),
        (
            lambda: remaster_ros.session_from(
                frame(joints, index=['a'] * len(arm.q)), frame(points), urdf
            ),
            "joints: two rows have the index 'a'",
        ),
    ):
        with pytest.raises((InputError, InsufficientDataError)) as error:
            call()
        assert words in str(error.value)
        assert '--' not in str(error.value)
