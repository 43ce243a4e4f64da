# SPDX-License-Identifier: Apache-2.0
"""A bag gives its session again, without ROS: every row, to the last bit, whatever was decided."""

import csv
import shutil

import numpy as np
import pytest
from rigs.command_line import refusal, remaster
from worlds.recorded_bags import CHAIN, RecordedArm

from remaster_ros.collection.events import BridgeState, ReadByHand
from remaster_ros.session.records.journal import read_journal
from remaster_ros.session.records.reader import read_session
from remaster_ros.types import Correction

SEED = 7


@pytest.fixture
def arm(tmp_path):
    print(f'seed {SEED}')
    (tmp_path / 'session').mkdir()
    arm = RecordedArm(tmp_path / 'session' / 'bag', SEED)
    arm.began(reference_stop_m=0.0)
    return arm


def replay(arm, tmp_path, *options, out='again', status=0):
    args = ('replay', tmp_path / 'session', '--out', tmp_path / out, *options)
    done = remaster(*args, status=status)
    assert 'Traceback' not in done.stderr
    return done


def rows(folder):
    with (folder / 'observations.csv').open(newline='') as file:
        return list(csv.DictReader(file))


def place(row):
    return np.array([float(row[f'{axis}_m']) for axis in 'xyz'])


def test_the_rows_are_what_the_sensors_measured_while_the_arm_stood(arm, tmp_path):
    arm.register()
    first, second = arm.visit(), arm.visit('validation')
    arm.planner('complete')
    arm.close()
    replay(arm, tmp_path)
    found = rows(tmp_path / 'again')
    assert [row['split'] for row in found] == 4 * ['optimization'] + 4 * ['validation']
    visited = [*first, *second]
    for number, q in enumerate(visited):
        # The last four of eight configurations; the first four registered the sensors.
        stamps, places = arm.frames[4 + number]
        shot, mean = sorted(
            found[2 * number : 2 * number + 2], key=lambda row: row['marker'] == 'sir'
        )
        inside = stamps <= stamps[0] - 0.02 + 0.5 + 1e-9
        assert int(mean['samples']) == inside.sum()
        np.testing.assert_allclose(place(mean), places[inside].mean(axis=0), atol=1e-12)
        np.testing.assert_allclose(place(shot), arm.shots[4 + number], atol=1e-15)
        for row in (shot, mean):
            reported = [float(row[f'q{i + 1}_rad']) for i in range(len(CHAIN))]
            np.testing.assert_allclose(reported, q, atol=1e-12)
            came_from = [float(row[f'from_q{i + 1}_rad']) for i in range(len(CHAIN))]
            if number:
                np.testing.assert_allclose(came_from, visited[number - 1], atol=1e-12)
    assert read_session(tmp_path / 'again').exit_status == 'complete'


def test_twice_is_the_same_and_the_session_beside_the_bag_is_compared(arm, tmp_path):
    arm.register()
    arm.visit()
    arm.close()
    assert 'nothing to compare' in replay(arm, tmp_path, out='first').stdout
    for name in ('session.yaml', 'observations.csv', 'robot.urdf'):
        shutil.copy(tmp_path / 'first' / name, tmp_path / 'session' / name)
    assert 'all rows are those of' in replay(arm, tmp_path, out='second').stdout
    first, second = ((tmp_path / n / 'observations.csv').read_bytes() for n in ('first', 'second'))
    assert first == second

    # Averaged over fewer frames; a row that is not in the bag; one that the session lacks.
    path = tmp_path / 'session' / 'observations.csv'
    header, first_row, second_row, _, fourth_row = path.read_text().splitlines()
    assert ',25,' in second_row, second_row
    path.write_text(
        '\n'.join([header, first_row, second_row.replace(',25,', ',5,'), fourth_row, ''])
    )
    done = replay(arm, tmp_path, out='third', status=1)
    (line,) = done.stderr.splitlines()
    assert 'error: 2 rows' in line
    for words in (
        'observation 1 (pose 3, mocap, sir',
        'samples is 25 instead of 5',
        'observation 2 (',
        'is not in the session recorded',
    ):
        assert words in line


@pytest.mark.parametrize('last', [False, True])
def test_what_no_message_holds_is_decided_as_the_recorder_did(arm, tmp_path, last):
    """The tracker's device refuses; then a camera is gone for 40 s, and is waited for."""
    arm.register()
    solutions = arm.rng.uniform(-1.0, 1.0, (2, len(CHAIN)))
    arm.announce('optimization', solutions)
    arm.stand(solutions[0], 0.8)
    arm.ended(0, 'partial', 'tracker: device: no reflector')
    if not last:
        arm.stand(solutions[1], 40.0, camera=False, shot_after=0.4)
        arm.stand_on(0.6)
        arm.ended(1, 'recorded')
        arm.visit()
    arm.close()
    replay(arm, tmp_path)
    kinds = [(row['pose'], row['sensor']) for row in rows(tmp_path / 'again')]
    expected = [('3', 'tracker'), ('3', 'mocap'), *4 * [('4', '')]]
    assert kinds[0] == ('3', 'mocap')
    if last:
        assert len(kinds) == 1
        return
    assert kinds[1:3] == expected[:2]
    assert len(kinds) == 7
    journal = read_journal(tmp_path / 'again' / 'journal.jsonl').records
    ended = [record for record in journal if record['kind'] == 'configuration']
    assert [record['result'] for record in ended[4:]] == ['partial', *3 * ['recorded']]
    assert 'no reflector' in ended[4]['reason']


def test_a_sensor_that_was_registered_by_hand_is_registered_again(arm, tmp_path):
    """What a person asked for by a service is in no topic; the recorder writes an event of it."""
    places = [arm.rng.uniform(-1.0, 1.0, len(CHAIN)) for _ in range(3)]
    for q in places:
        arm.t, arm.q = arm.t + 1.0, q
        arm.joints()
        arm.record('/recorder', ReadByHand(stamp_s=arm.t, q=tuple(q.tolist())))
        # The tracker is not there: the camera's points are taken when the next one begins.
        arm.stand_on(0.8)
    arm.visit()
    arm.close()
    replay(arm, tmp_path)
    journal = read_journal(tmp_path / 'again' / 'journal.jsonl').records
    by_hand = [record for record in journal if record.get('split') == 'registration']
    assert [[reading['sensor'] for reading in r['readings']] for r in by_hand] == 3 * [['mocap']]
    found = rows(tmp_path / 'again')
    assert len(found) == 4
    came_from = [float(found[0][f'from_q{i + 1}_rad']) for i in range(len(CHAIN))]
    np.testing.assert_allclose(came_from, places[-1], atol=1e-12)


def test_a_recorder_that_was_started_again_begins_anew(arm, tmp_path):
    """It has no record of where the arm came from, and drops the reading under way."""
    arm.register()
    arm.visit()
    solutions = arm.rng.uniform(-1.0, 1.0, (1, len(CHAIN)))
    arm.announce('optimization', solutions)
    arm.stand(solutions[0], 0.2)
    arm.began(reference_stop_m=0.0)
    arm.visit()
    arm.close()
    replay(arm, tmp_path)
    found = rows(tmp_path / 'again')
    assert [row['pose'] for row in found] == 4 * ['3'] + 4 * ['5']
    assert [row['from_q1_rad'] == '' for row in found] == [*4 * [False], True, True, False, False]


def test_other_parameters_than_the_default_are_those_of_the_bag(tmp_path):
    (tmp_path / 'session').mkdir()
    arm = RecordedArm(tmp_path / 'session' / 'bag', SEED)
    arm.began(dwell_s=0.3)
    arm.register()
    arm.visit()
    arm.close()
    replay(arm, tmp_path)
    assert {row['samples'] for row in rows(tmp_path / 'again')} == {'1', '15'}


def test_what_is_wrong_is_refused_in_a_line(arm, tmp_path):
    arm.visit()
    arm.close()
    full = tmp_path / 'full'
    full.mkdir()
    (full / 'x').write_text('')
    for options, words in (
        (('--out', full), 'there is something already; name a new folder'),
        (('--out', tmp_path / 'a', '--rate', 8), '--rate is for a replay over ROS'),
        (('--cell', 'demo'), '--cell is of use with --out alone'),
        (('--out', tmp_path / 'b', '--cell', tmp_path / 'none.yaml'), 'none.yaml'),
    ):
        assert words in refusal('replay', tmp_path / 'session', *options)
    other = RecordedArm(tmp_path / 'other', SEED)
    other.stand(np.zeros(len(CHAIN)), 0.5)
    other.close()
    said = refusal('replay', tmp_path / 'other', '--out', tmp_path / 'c')
    assert 'no recorder of remaster_ros has written it; `remaster import`' in said


def test_a_bag_with_a_damaged_message_leaves_no_half_a_session_in_the_way(arm, tmp_path):
    arm.visit()
    arm.writer.write('/joint_states', 'sensor_msgs/msg/JointState', b'damaged', round(arm.t * 1e9))
    arm.close()
    for _ in range(2):
        done = replay(arm, tmp_path, out='new/again', status=2)
        assert 'a damaged message' in done.stderr
        assert not (tmp_path / 'new').exists()


def test_what_was_wanted_before_a_correction_of_the_bridge(arm, tmp_path):
    """Half a degree and more: a solution is found by what was wanted, and a row has both."""
    arm.record('/robot_bridge', BridgeState(halted='', correction='ab12'))
    arm.change = np.linspace(-0.03, 0.03, len(CHAIN))
    arm.register()
    first = arm.visit()
    # The bridge was started again without: the rows go on, and tell it.
    arm.record('/robot_bridge', BridgeState(halted=''))
    arm.change = None
    second = arm.visit('validation')
    arm.close()
    replay(arm, tmp_path)
    read = read_session(tmp_path / 'again')
    m = read.measurements
    assert read.correction == Correction('robot_bridge', 'ab12')
    assert m.correction.tolist() == 4 * [1] + 4 * [0]
    visited = np.repeat([*first, *second], 2, axis=0)
    np.testing.assert_allclose(m.wanted, visited, atol=1e-12)
    change = np.where(m.correction[:, None], np.linspace(-0.03, 0.03, len(CHAIN)), 0.0)
    np.testing.assert_allclose(m.q - m.wanted, change, atol=1e-12)
    journal = read_journal(tmp_path / 'again' / 'journal.jsonl').records
    assert [record['kind'] for record in journal].count('correction') == 1


@pytest.mark.parametrize('before', ['', 'ab12'])
def test_rows_of_two_corrections_are_not_mixed(arm, tmp_path, before):
    if before:
        arm.record('/robot_bridge', BridgeState(halted='', correction=before))
        arm.change = np.full(len(CHAIN), 0.01)
    arm.register()
    arm.visit()
    arm.record('/robot_bridge', BridgeState(halted='', correction='cd34'))
    arm.change = np.full(len(CHAIN), 0.02)
    arm.visit()
    arm.close()
    replay(arm, tmp_path)
    read = read_session(tmp_path / 'again')
    assert len(read.measurements) == 4
    assert (read.correction.sha256 if read.correction else '') == before


def test_a_correction_of_which_nothing_is_told_is_not_recorded(arm, tmp_path):
    arm.change = np.full(len(CHAIN), 0.01)
    arm.register()
    arm.visit()
    arm.change = None
    arm.visit()
    arm.close()
    replay(arm, tmp_path)
    read = read_session(tmp_path / 'again')
    assert read.correction is None
    assert read.measurements.pose.tolist() == 4 * [4]
