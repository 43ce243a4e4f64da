# SPDX-License-Identifier: Apache-2.0
"""Columns and keys that a session may leave out: kept, not there without, refused by place."""

from dataclasses import replace

import numpy as np
import pytest
from worlds.calibration_scenes import scene
from worlds.oriented_sessions import make_session

from remaster_ros.errors import InputError
from remaster_ros.kinematics.transforms import inverse, matrix_from_quaternion_xyzw, transform
from remaster_ros.session.records.reader import read_session, write_session
from remaster_ros.types import Correction, Session


def of_frames() -> Session:
    """Two markers in each frame of one sensor."""
    session, _ = scene(3, poses=4)
    m = session.measurements
    twice = m.select(np.repeat(np.arange(len(m)), 2))
    rows = np.arange(len(twice))
    frame = twice.configuration.copy()
    frame[3] = -1
    twice = replace(twice, observation=rows, marker=rows % 2, frame=frame)
    return replace(session, measurements=twice, further_markers={'mocap': ('smr',)})


def oriented() -> Session:
    session, _ = scene(3, poses=4)
    orientation = np.tile([0.0, 0.6, 0.0, 0.8], (len(session.measurements), 1))
    orientation[1] = np.nan
    measurements = replace(session.measurements, orientation=orientation)
    return replace(session, measurements=measurements, oriented=frozenset({'mocap'}))


def corrected() -> Session:
    """What was wanted, and whether a correction was on."""
    session, _ = scene(3, poses=4)
    m = session.measurements
    wanted = m.q + 1e-3
    wanted[1] = np.nan
    return replace(
        session,
        measurements=replace(m, wanted=wanted, correction=np.arange(len(m)) % 3 - 1),
        correction=Correction('layer', 'abc'),
        accuracy_option='inactive',
    )


@pytest.mark.parametrize(
    ('made', 'columns', 'keys'),
    [
        (of_frames, ['frame'], ['further_markers']),
        (oriented, ['orientation'], ['oriented']),
        (corrected, ['wanted', 'correction'], ['correction', 'accuracy_option']),
    ],
)
def test_they_survive_the_round_trip_and_are_not_there_without(tmp_path, made, columns, keys):
    wanted = made()
    write_session(tmp_path / 'with', wanted)
    read = read_session(tmp_path / 'with')
    for name in columns:
        given = getattr(wanted.measurements, name)
        np.testing.assert_array_equal(getattr(read.measurements, name), given)
    assert [getattr(read, key) for key in keys] == [getattr(wanted, key) for key in keys]
    assert not read.extra
    write_session(tmp_path / 'without', scene(3, poses=4)[0])
    text = (tmp_path / 'without' / 'observations.csv').read_text()
    text += (tmp_path / 'without' / 'session.yaml').read_text()
    assert not [name for name in columns + keys if name in text]
    plain = read_session(tmp_path / 'without').measurements
    assert [getattr(plain, name) for name in columns] == [None] * len(columns)


@pytest.mark.parametrize(
    ('made', 'old', 'new', 'words'),
    [
        (oriented, '0.0,0.6,0.0,0.8', '0.0,0.6,0.0,0.9', 'line 2, column orientation_x'),
        (oriented, '0.0,0.6,0.0,0.8', '0.0,,0.0,0.8', 'line 2, column orientation_y'),
        (oriented, 'orientation_w', 'w', 'only orientation_x, orientation_y, orientation_z are'),
        (corrected, ',off\n', ',perhaps\n', "'perhaps' is neither on nor off"),
        (corrected, 'wanted1_rad', 'wanted9_rad', 'columns wanted…_rad'),
    ],
)
def test_what_is_none_is_refused_by_its_place(tmp_path, made, old, new, words):
    write_session(tmp_path, made())
    path = tmp_path / 'observations.csv'
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=words):
        read_session(tmp_path)


@pytest.mark.parametrize(
    ('change', 'words'),
    [
        ({'frame': [5, 5, 5, 5]}, 'column frame: 5 belongs to configuration 0 on line 2'),
        ({'marker': [0, 0, 1, 0]}, 'column marker: frame 0 of this sensor has this marker'),
    ],
)
def test_a_frame_that_is_none_is_not_written(tmp_path, change, words):
    made = of_frames()
    for name, values in change.items():
        getattr(made.measurements, name)[: len(values)] = values
    with pytest.raises(InputError, match=words):
        write_session(tmp_path, made)


@pytest.fixture(scope='module')
def on_tool():
    print('seed 12')
    return make_session('camera_on_tool', np.random.default_rng(12), poses=5).session


def test_of_a_sensor_on_the_tool_the_file_has_what_was_measured(on_tool, tmp_path):
    write_session(tmp_path / 's', on_tool)
    back = read_session(tmp_path / 's')
    assert back.on_tool == {'sensor'}
    m = on_tool.measurements
    np.testing.assert_allclose(back.measurements.position, m.position, atol=1e-12)
    lines = (tmp_path / 's' / 'observations.csv').read_text().splitlines()
    row = dict(zip(lines[0].split(','), lines[1].split(','), strict=True))
    seen = transform(
        matrix_from_quaternion_xyzw([float(row[f'orientation_{axis}']) for axis in 'xyzw']),
        [float(row[f'{axis}_m']) for axis in 'xyz'],
    )
    given = transform(matrix_from_quaternion_xyzw(m.orientation[0]), m.position[0])
    np.testing.assert_allclose(seen, inverse(given), atol=1e-9)
    # In front of the camera.
    assert seen[2, 3] > 0.3


def test_a_sensor_on_the_tool_needs_orientations_and_a_marker_of_its_own(on_tool, tmp_path):
    m = on_tool.measurements
    turned = m.orientation.copy()
    turned[3] = np.nan
    broken = replace(on_tool, measurements=replace(m, orientation=turned))
    with pytest.raises(InputError, match='observation 3 has no orientation'):
        write_session(tmp_path / 's', broken)
    other = replace(on_tool, sensors={**on_tool.sensors, 'mocap': 'body'})
    with pytest.raises(InputError, match='one of its own'):
        write_session(tmp_path / 's', other)
