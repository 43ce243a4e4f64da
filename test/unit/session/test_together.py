# SPDX-License-Identifier: Apache-2.0
"""Several sessions of one arm: one set of offsets, registrations and markers of each session."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from rigs.command_line import refusal, remaster

import remaster_ros
from remaster_ros.calibration.estimate import Problem, estimate
from remaster_ros.discovery.to_extension import offsets_of
from remaster_ros.errors import InputError
from remaster_ros.kinematics.transforms import rotation_vector_to_matrix
from remaster_ros.session.records.reader import write_session
from remaster_ros.session.records.together import disagreements, together

SEED = 5


@pytest.fixture(scope='module')
def made():
    return remaster_ros.simulate(poses=40, validation_poses=12, seed=SEED)


@pytest.fixture(scope='module')
def halves(made):
    """Two sessions with no pose in common; before the second the sensors were set up anew."""
    session = made.session
    poses = np.unique(session.measurements.pose)
    first = np.isin(session.measurements.pose, poses[::2])
    first_half, second_half = session.select(first), session.select(~first)
    turned = rotation_vector_to_matrix(np.array([0.02, -0.3, 0.5]))
    moved = second_half.measurements.position @ turned.T + np.array([0.3, -0.2, 0.1])
    return first_half, replace(
        second_half, measurements=replace(second_half.measurements, position=moved)
    )


def test_the_arm_is_shared_and_registrations_are_not(made, halves) -> None:
    print('seed', SEED)
    joined_session, lines = together([('monday', halves[0]), ('tuesday', halves[1])])
    assert len(joined_session.measurements) == sum(len(half.measurements) for half in halves)
    assert len(np.unique(joined_session.measurements.observation)) == len(
        joined_session.measurements
    )
    assert len(lines) == 1
    assert 'tuesday' in lines[0]
    assert 'mocap_2' in lines[0]
    stds = []
    for session in (*halves, joined_session):
        offsets, std = offsets_of(estimate(Problem.of(session)))
        known = std < np.radians(1.0)
        assert known.sum() >= 5
        # Beyond four standard deviations in one of 16,000 offsets.
        error = np.abs(offsets - made.truth.joint_offsets)[known]
        assert np.all(error < 4.0 * std[known])
        stds.append(std[known])
    assert np.all(stds[2] < np.minimum(stds[0], stds[1]))


def test_markers_whose_names_are_numbered_already_keep_apart(halves) -> None:
    """As those of the demo: the first of the second session is not the second of the first."""
    numbered = []
    for half in halves:
        places = {'ball': np.zeros(3), 'ball_2': np.ones(3), 'ball_3': 2.0 * np.ones(3)}
        rows = replace(half.measurements, marker=half.measurements.observation % 3)
        sensors = dict(zip(half.sensors, places, strict=False))
        numbered.append(replace(half, markers=places, sensors=sensors, measurements=rows))
    joined_session, _ = together([('monday', numbered[0]), ('tuesday', numbered[1])])
    assert len(joined_session.markers) == 6
    place = np.array(
        [
            joined_session.markers[joined_session.marker_names[i]]
            for i in joined_session.measurements.marker
        ]
    )
    np.testing.assert_array_equal(place[:, 0], joined_session.measurements.marker % 3)


@pytest.fixture(scope='module')
def of_another_arm(made):
    """A session of an arm of the same kind, with zero-offsets of its own."""
    return remaster_ros.simulate(poses=20, validation_poses=6, seed=SEED + 1).session


def one_joint_mastered(session, joint: int, by_deg: float):
    """Return a session whose arm counts one joint's angle from elsewhere."""
    q = session.measurements.q.copy()
    q[:, joint] += np.radians(by_deg)
    return replace(session, measurements=replace(session.measurements, q=q))


@pytest.mark.parametrize('verb', ['fit', 'discover'])
def test_two_arms_are_refused_before_a_joint_fit(verb, halves, of_another_arm, tmp_path) -> None:
    """The error falls by such a fit, too, and its offsets are those of neither arm."""
    folders = [tmp_path / name for name in ('monday', 'tuesday')]
    for folder, session in zip(folders, (halves[0], of_another_arm), strict=True):
        write_session(folder, session)
    said = refusal(verb, *folders, '--out', tmp_path / 'out')
    assert 'monday' in said
    assert 'tuesday are not of one arm as it was' in said
    assert re.search(r'joint_[2-6] by \d+', said)
    assert 'standard deviations. Fit them one by one' in said
    assert not (tmp_path / 'out' / 'fit.json').exists()


def test_one_joint_that_was_mastered_in_between_is_named(halves, tmp_path) -> None:
    """The joint fit is made, and no page of it is green."""
    folders = [tmp_path / name for name in ('monday', 'tuesday')]
    sessions = halves[0], one_joint_mastered(halves[1], 3, 0.3)
    for folder, session in zip(folders, sessions, strict=True):
        write_session(folder, session)
    done = remaster('fit', *folders, '--out', tmp_path / 'out', '--no-figures')
    assert 'do not have the same zero-offsets' in done.stderr
    assert re.search(r'differ, joint_4 by \d+ standard deviations\.', done.stderr), done.stderr
    judgement = json.loads((tmp_path / 'out' / 'fit.json').read_text())['judgement']
    assert judgement['mood'] != 'good'
    assert any('joint_4 by' in line for line in judgement['disagreements'])


def test_sessions_of_one_arm_disagree_in_nothing(halves) -> None:
    assert disagreements([('monday', halves[0]), ('tuesday', halves[1])]) == ([], [])


def test_a_session_that_cannot_answer_alone_says_so(halves) -> None:
    few = halves[1].select(halves[1].measurements.pose == halves[1].measurements.pose[0])
    assert not few.measurements.is_validation.all()
    differing, silent = disagreements([('monday', halves[0]), ('tuesday', few)])
    assert not differing
    assert len(silent) == 1
    assert silent[0].startswith('tuesday alone does not tell')


def test_what_is_not_of_one_arm_is_refused_by_name(halves) -> None:
    other = replace(halves[1], urdf=halves[1].urdf + '<!-- another -->')
    with pytest.raises(InputError, match='monday and tuesday are not of one arm: their URDF'):
        together([('monday', halves[0]), ('tuesday', other)])
    same = replace(halves[0], observations_sha256='ab' * 32)
    with pytest.raises(InputError, match='give each session once'):
        together([('monday', same), ('copy', same)])


def test_sessions_without_times_stay_in_their_order(halves) -> None:
    first, second = (replace(half, timed=False) for half in halves)
    joined_session, _ = together([('a', first), ('b', second)])
    assert not joined_session.timed
    stamps, count = joined_session.measurements.stamp_s, len(first.measurements)
    assert stamps[:count].max() < stamps[count:].min()
    mixed, _ = together([('a', halves[0]), ('b', second)])
    assert not mixed.timed


def test_fit_takes_several_sessions(halves, tmp_path) -> None:
    for name, half in zip('ab', halves, strict=True):
        write_session(tmp_path / name, half)
    out = tmp_path / 'fit'
    sessions = [str(tmp_path / name) for name in 'ab']
    few = ('--draws', 200, '--chains', 2, '--no-figures')
    done = remaster('fit', *sessions, '--out', out, *few)
    assert 'its sensors and markers are mocap_2' in done.stdout
    content = json.loads((out / 'fit.json').read_text())
    assert {'mocap', 'mocap_2'} <= set(content['registration'])
    said = refusal('fit', sessions[0], sessions[0], '--out', tmp_path / 'twice', '--no-figures')
    assert 'give each session once' in said
