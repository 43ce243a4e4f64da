"""Orientations of measured bodies: columns of observations.csv, a key of session.yaml."""

from dataclasses import replace

import numpy as np
import pytest
from calibration_scenes import scene

from remaster_ros.collection.pairing import PairedReading
from remaster_ros.errors import InputError
from remaster_ros.session.reader import read_session, write_session
from remaster_ros.session.session_journal import SessionJournal
from remaster_ros.types import Measurements

TURN = np.array([0.0, 0.6, 0.0, 0.8])


@pytest.fixture
def made():
    session, _ = scene(3, poses=4)
    orientation = np.tile(TURN, (len(session.measurements), 1))
    orientation[1] = np.nan
    measurements = replace(session.measurements, orientation=orientation)
    return replace(session, measurements=measurements, oriented=frozenset({'mocap'}))


def test_orientations_survive_the_round_trip(made, tmp_path):
    write_session(tmp_path, made)
    read = read_session(tmp_path)
    np.testing.assert_array_equal(read.measurements.orientation, made.measurements.orientation)
    assert read.oriented == {'mocap'}


def test_without_them_a_session_is_written_as_ever(made, tmp_path):
    plain = replace(made.measurements, orientation=None)
    write_session(tmp_path, replace(made, measurements=plain, oriented=frozenset()))
    assert 'orientation' not in (tmp_path / 'observations.csv').read_text()
    assert 'orientation' not in (tmp_path / 'session.yaml').read_text()
    assert read_session(tmp_path).measurements.orientation is None


@pytest.mark.parametrize(
    ('old', 'new', 'message'),
    [
        ('0.0,0.6,0.0,0.8', '0.0,0.6,0.0,0.9', 'line 2, column orientation_x'),
        ('0.0,0.6,0.0,0.8', '0.0,,0.0,0.8', 'line 2, column orientation_y'),
        ('orientation_w', 'w', 'only orientation_x, orientation_y, orientation_z are there'),
    ],
)
def test_what_is_no_orientation_is_refused_by_its_place(made, tmp_path, old, new, message):
    write_session(tmp_path, made)
    path = tmp_path / 'observations.csv'
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(InputError, match=message):
        read_session(tmp_path)


def test_a_journal_keeps_them_across_a_kill(made, tmp_path):
    header = replace(made, measurements=Measurements.empty(made.measurements.q.shape[1]))
    reading = PairedReading(
        'mocap', 'sir', 5.0, made.measurements.q[0], np.ones(3), np.ones(3), 9, TURN
    )
    for pose, split in enumerate(('optimization', 'registration', 'reference')):
        # Opened anew each time, as after a kill.
        journal = SessionJournal(tmp_path / 'session', header)
        journal.write(
            pose=pose,
            solution=0,
            split=split,
            result='recorded',
            reason='',
            readings=[replace(reading, stamp_s=5.0 + pose)],
            from_q=None,
            temperatures_c=[None],
        )
        journal._writer.release()  # killed
    journal = SessionJournal(tmp_path / 'session', header)
    np.testing.assert_array_equal(journal.registration[0].orientation, TURN)
    np.testing.assert_array_equal(journal.watched[0][2][0].orientation, TURN)
    journal.close('complete')
    np.testing.assert_array_equal(
        read_session(tmp_path / 'session').measurements.orientation, [TURN]
    )
