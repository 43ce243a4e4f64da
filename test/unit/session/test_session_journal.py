# SPDX-License-Identifier: Apache-2.0
"""The recorder's memory: numbering, results, registration and time across restarts."""

from dataclasses import replace

import numpy as np
import pytest

from remaster_ros.collection.events import Decided
from remaster_ros.collection.pairing import PairedReading
from remaster_ros.collection.recording import BY_HAND
from remaster_ros.errors import InputError
from remaster_ros.session.records.reader import read_session
from remaster_ros.session.records.session_journal import SessionJournal, read_outcomes


def reading(sensor, stamp_s):
    return PairedReading(
        sensor=sensor,
        marker={'mocap': 'sir', 'tracker': 'smr'}[sensor],
        stamp_s=stamp_s,
        q=np.array([0.1, 0.2]) + 1e-3 * stamp_s,
        position=np.array([1.0, 2.0, 3.0]),
        std=np.full(3, 1e-5) if sensor == 'mocap' else None,
        samples=7,
    )


def write(book, pose, solution, readings, split='optimization', result='recorded', **options):
    options.setdefault('temperatures_c', [21.5] * len(readings))
    book.write(
        pose=pose, solution=solution, split=split, result=result, reason='', readings=readings,
        from_q=None, **options,
    )  # fmt: skip


def test_a_recorder_started_again_knows_what_it_decided(session, tmp_path):
    book = SessionJournal(tmp_path, session)
    assert not book.notes
    assert book.follow('plan a')
    points = [reading('mocap', 1.0), reading('tracker', 2.0)]
    write(book, -1, 0, points, split='registration')
    write(book, 0, 3, [reading('mocap', 9.0), reading('tracker', 8.0)])
    write(book, 0, 1, [], result='rejected', temperatures_c=[])
    write(book, 0, 2, [reading('mocap', 11.0)], result='partial', temperatures_c=[None])
    book._writer.release()  # killed

    book = SessionJournal(tmp_path, session)
    assert 'after 3 observations' in book.notes[0]
    assert book.plan_id == 'plan a'
    results = [book.result(0, solution) for solution in range(4)]
    assert results == [None, None, 'partial', 'recorded']
    write(book, 0, 4, [], result='failed')
    write(book, 2, 0, [], result='no_free_path', split='reference')
    write(book, BY_HAND.pose, 0, [], result='rejected', split='registration')
    outcomes = {'recorded': 1, 'rejected': 1, 'partial': 1, 'failed': 1}
    assert book.outcomes.decided() == Decided(2, (0,), outcomes, references=1)
    write(book, 0, 4, [], result='rejected')
    assert book.outcomes.decided().pose == 0
    assert sorted(book.outcomes.decided().solutions) == [1, 2, 3, 4]
    assert [r.sensor for r in book.registration] == ['mocap', 'tracker']
    np.testing.assert_array_equal(book.registration[0].q, points[0].q)
    write(book, 0, 1, [reading('tracker', 12.0)])
    book.close('complete')
    m = read_session(tmp_path).measurements
    assert m.observation.tolist() == [0, 1, 2, 3]
    assert m.configuration.tolist() == [0, 0, 1, 2]
    assert m.stamp_s.tolist() == [8.0, 9.0, 11.0, 12.0]
    np.testing.assert_array_equal(m.temperature_c, [21.5, 21.5, np.nan, 21.5])

    book = SessionJournal(tmp_path, session)
    assert book.closed == 'complete'
    assert book.observations == 4
    assert 'is complete' in book.notes[0]
    assert book.outcomes.decided().outcomes == {'recorded': 2, 'partial': 1, 'rejected': 1}
    assert read_outcomes(tmp_path).poses == book.outcomes.poses


def test_another_plan_is_not_followed_once_there_are_observations(session, tmp_path):
    book = SessionJournal(tmp_path, session)
    assert book.follow('a')
    write(book, -1, 0, [reading('mocap', 1.0)], split='registration')
    assert book.follow('b')
    assert not book.result(-1, 0)
    write(book, 0, 0, [reading('mocap', 2.0)])
    assert not book.follow('c')
    assert book.follow('b')
    book.close('stopped')


def test_time_goes_on_though_the_clock_began_anew(session, tmp_path):
    book = SessionJournal(tmp_path, session)
    write(book, 0, 0, [reading('mocap', 500.0)])
    book.close('stopped')
    for solution in (1, 2):
        book.reopen()
        write(book, 0, solution, [reading('mocap', 100.0 + solution)])
        assert 'ran backwards' in ' '.join(book.notes) or solution == 2
        book.close('stopped')
    book.reopen()
    write(book, 1, 0, [reading('mocap', 50.0)])
    book.close('complete')
    stamps = read_session(tmp_path).measurements.stamp_s.tolist()
    assert stamps == pytest.approx([500.0, 501.0, 502.0, 503.0])


def test_references_are_rows_of_their_own_and_are_remembered(session, tmp_path):
    book = SessionJournal(tmp_path, session)
    book.follow('a')
    places = [[reading('mocap', 1.0), reading('tracker', 1.5)], [reading('mocap', 2.0)]]
    write(book, 0, 0, places[0], split='reference')
    write(book, 1, 0, [reading('mocap', 3.0)], split='validation')
    book.note_accepted()
    write(book, 2, 0, places[1], split='reference')
    book._writer.release()  # killed
    book = SessionJournal(tmp_path, session)
    assert [kind for kind, _, _ in book.watched] == ['reference', 'other', 'accepted', 'reference']
    assert [number for kind, number, _ in book.watched if kind == 'reference'] == [0, 2]
    for readings, (_, _, found) in zip(places, (book.watched[0], book.watched[3])):
        for original, other in zip(readings, found, strict=True):
            assert (original.sensor, original.stamp_s) == (other.sensor, other.stamp_s)
            np.testing.assert_array_equal(original.position, other.position)
            assert (original.std is None) == (other.std is None)
    assert not book.registration
    write(book, 3, 0, [reading('mocap', 4.0)])
    book.close('complete')
    found = read_session(tmp_path)
    assert found.measurements.observation.tolist() == [2, 4]
    assert found.measurements.is_validation.tolist() == [True, False]
    assert found.references.observation.tolist() == [0, 1, 3]
    assert found.references.configuration.tolist() == [0, 0, 2]


def test_a_complete_session_is_gone_further_with_on_request_alone(session, tmp_path):
    book = SessionJournal(tmp_path, session)
    assert book.follow('plan a')
    write(book, -1, 0, [reading('mocap', 1.0)], split='registration')
    write(book, 0, 0, [reading('mocap', 9.0)])
    book.close('complete')
    before = (tmp_path / 'observations.csv').read_bytes()
    for again in (SessionJournal(tmp_path, session), book):
        again.reopen()
        assert (again.closed, again.plan_id) == ('complete', 'plan a')

    book.reopen(go_further=True)
    assert book.closed == ''
    assert read_session(tmp_path).exit_status == 'aborted'
    assert book.follow('plan a')
    assert book.result(0, 0) == 'recorded'
    assert len(book.registration) == 1
    write(book, 5, 0, [reading('mocap', 20.0)])
    book._writer.release()  # killed

    book = SessionJournal(tmp_path, session)
    assert book.closed == ''
    write(book, 6, 0, [reading('mocap', 30.0)])
    book.close('complete')
    found = read_session(tmp_path)
    assert found.exit_status == 'complete'
    assert found.measurements.pose.tolist() == [0, 5, 6]
    assert (tmp_path / 'observations.csv').read_bytes().startswith(before)


def test_a_complete_session_that_was_changed_is_not_gone_further_with(session, tmp_path):
    book = SessionJournal(tmp_path, session)
    book.follow('plan a')
    write(book, 0, 0, [reading('mocap', 9.0)])
    book.close('complete')
    path = tmp_path / 'observations.csv'
    path.write_text(path.read_text().replace('9.0', '9.5'))
    with pytest.raises(InputError, match=r'observations\.csv'):
        book.reopen(go_further=True)
    assert book.closed == 'complete'


def test_orientations_are_kept_across_a_kill(session, tmp_path):
    turn = np.array([0.0, 0.6, 0.0, 0.8])
    oriented = replace(session, oriented=frozenset({'mocap'}))
    for pose, split in enumerate(('optimization', 'registration', 'reference')):
        # Opened anew each time, as after a kill.
        book = SessionJournal(tmp_path, oriented)
        write(book, pose, 0, [replace(reading('mocap', 5.0 + pose), orientation=turn)], split)
        book._writer.release()  # killed
    book = SessionJournal(tmp_path, oriented)
    np.testing.assert_array_equal(book.registration[0].orientation, turn)
    np.testing.assert_array_equal(book.watched[0][2][0].orientation, turn)
    book.close('complete')
    np.testing.assert_array_equal(read_session(tmp_path).measurements.orientation, [turn])
