"""Several markers in one frame: the column, and what its rows must hold; the cell file's key."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calibration_scenes import scene

from remaster_ros.errors import InputError
from remaster_ros.session.reader import read_session, write_session
from remaster_ros.session.workcell import config_path, parse_cell
from remaster_ros.types import Session


def session_of_frames() -> Session:
    """Two markers in each frame of one sensor."""
    session, _ = scene(3, poses=4)
    m = session.measurements
    twice = m.select(np.repeat(np.arange(len(m)), 2))
    rows = np.arange(len(twice))
    marker = rows % 2
    twice = replace(twice, observation=rows, marker=marker, frame=twice.configuration.copy())
    return replace(session, measurements=twice, further_markers={'mocap': ('smr',)})


def test_frames_survive_the_round_trip(tmp_path):
    made = session_of_frames()
    made.measurements.frame[3] = -1
    write_session(tmp_path, made)
    read = read_session(tmp_path)
    np.testing.assert_array_equal(read.measurements.frame, made.measurements.frame)
    assert read.further_markers == {'mocap': ('smr',)}


def test_without_frames_a_session_is_written_as_ever(tmp_path):
    session, _ = scene(3, poses=4)
    write_session(tmp_path, session)
    header = (tmp_path / 'observations.csv').read_text().splitlines()[0]
    assert 'frame' not in header
    assert 'further' not in (tmp_path / 'session.yaml').read_text()
    assert read_session(tmp_path).measurements.frame is None


@pytest.mark.parametrize(
    ('change', 'words'),
    [
        ({'frame': [5, 5, 5, 5]}, 'column frame: 5 belongs to configuration 0 on line 2'),
        ({'marker': [0, 0, 1, 0]}, 'column marker: frame 0 of this sensor has this marker'),
    ],
)
def test_a_frame_that_is_none_is_refused(tmp_path, change, words):
    made = session_of_frames()
    for name, values in change.items():
        getattr(made.measurements, name)[: len(values)] = values
    with pytest.raises(InputError, match=words):
        write_session(tmp_path, made)


def cell(change: str, markers: str = ''):
    """Return the demo cell with the marker line of its bar changed."""
    path = config_path('cells/demo.yaml')
    text = path.read_text()
    text = text.replace('markers:\n', f'markers:\n{markers}', 1)
    return parse_cell(text.replace('    marker: sir\n', change, 1).encode(), path)


BODY = '  b: [0.05, 0.05, 0.0]\n  c: [0.0, -0.05, 0.03]\n'


def test_a_cell_with_several_markers():
    made = cell('    marker: sir\n    further_markers: {b: 2, c: 3}\n', BODY)
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
        cell(further, extra)
    assert words in str(refused.value)
    assert '\n' not in str(refused.value)
