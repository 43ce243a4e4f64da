"""Sensors on the tool: what the file holds, what the fit sees, what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from oriented_sessions import make_session

from remaster_ros.errors import InputError
from remaster_ros.kinematics.transforms import inverse, matrix_from_quaternion_xyzw, transform
from remaster_ros.session.reader import read_session, write_session


@pytest.fixture(scope='module')
def session():
    print('seed 12')
    return make_session('camera_on_tool', np.random.default_rng(12), poses=5).session


def test_the_file_has_what_was_measured_and_reading_gives_back_the_session(session, tmp_path):
    write_session(tmp_path / 's', session)
    back = read_session(tmp_path / 's')
    assert back.on_tool == {'sensor'}
    m = session.measurements
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


def test_a_reading_without_orientation_is_refused(session, tmp_path):
    m = session.measurements
    turned = m.orientation.copy()
    turned[3] = np.nan
    broken = replace(session, measurements=replace(m, orientation=turned))
    with pytest.raises(InputError, match='observation 3 has no orientation'):
        write_session(tmp_path / 's', broken)


def test_a_marker_that_another_sensor_has_is_refused(session, tmp_path):
    other = replace(session, sensors={**session.sensors, 'mocap': 'body'})
    with pytest.raises(InputError, match='one of its own'):
        write_session(tmp_path / 's', other)
