# SPDX-License-Identifier: Apache-2.0
"""``remaster verify``: what a session must tell, and what is printed."""

import json
from dataclasses import replace

import numpy as np
import pytest
from rigs.command_line import refusal, remaster
from worlds.compensation_files import save
from worlds.hidden_tours import robot
from worlds.measured_rows import measured_rows
from worlds.verified_arms import Case, found_arm, measured

from remaster_ros.cli.verify import WORDS
from remaster_ros.compensation.file import read_compensation
from remaster_ros.session.records.reader import write_session
from remaster_ros.types import Correction, Session

CASE = Case(11, 0.2, 0.1, 'in_use', toggled=True)


def session_of(case: Case) -> Session:
    """Return a session as a recorder writes it: reported angles are those commanded."""
    compensator, visits = measured(case)
    m = measured_rows(
        np.where(visits.on[:, None], compensator.command(visits.wanted), visits.wanted),
        visits.position,
        pose=visits.configuration,
        configuration=visits.configuration,
        is_validation=np.ones(len(visits.on), bool),
        wanted=visits.wanted,
        correction=visits.on.astype(np.int64),
    )
    marker = compensator.model.markers['sir']
    return Session(robot(case.name), 'base_link', 'tool', {'sir': marker}, {'mocap': 'sir'}, m)


@pytest.fixture
def file(tmp_path):
    return save(tmp_path, found_arm(CASE)[1], robot(CASE.name))


def verified(session, folder, file):
    write_session(folder, session)
    return json.loads(remaster('verify', folder, '--compensation', file, '--json').stdout)


@pytest.mark.parametrize('state', ['in_use', 'not_in_use'])
def test_a_recorded_session_with_the_layer_on(tmp_path, file, state):
    """Where raw joint states are recorded a new fit would find the old offsets in any case."""
    found = verified(session_of(replace(CASE, state=state)), tmp_path / 's', file)
    assert found['format'] == 'remaster-verify/1'
    assert found['verdict'] == found['toggle']['verdict'] == state
    assert [joint['joint'] for joint in found['joints']] == list(
        read_compensation(file).compensator.joint_names
    )
    assert found['error_mm']['on'].keys() == {'mean_mm', 'interval95_mm'}
    output = remaster('verify', tmp_path / 's', '--compensation', file).stdout
    assert output.startswith(f'{state}: ')


def test_visits_for_the_same_joints_belong_together_whatever_their_numbers(tmp_path, file):
    """A recorder numbers each visit; the arm stands a little off what was wanted."""
    session = session_of(CASE)
    m, rng = session.measurements, np.random.default_rng(5)
    order = rng.permutation(len(m))
    off = rng.normal(0.0, 1e-5, m.wanted.shape)
    shuffled_rows, each = m.select(order), np.arange(len(m))
    shuffled_rows = replace(
        shuffled_rows, observation=each, configuration=each, pose=each, stamp_s=1.0 * each
    )
    shuffled_rows = replace(
        shuffled_rows, wanted=shuffled_rows.wanted + off, q=shuffled_rows.q + off
    )
    found = verified(replace(session, measurements=shuffled_rows), tmp_path / 's', file)
    assert found['verdict'] == found['toggle']['verdict'] == 'in_use'
    assert found['text'] == WORDS['in_use']


def test_on_the_pad_what_is_reported_was_wanted(tmp_path, file):
    session = session_of(replace(CASE, toggled=False))
    m = session.measurements
    mastered = replace(m, q=m.wanted, wanted=None, correction=None)
    found = verified(
        replace(session, measurements=mastered, correction=Correction('pad', 'x')),
        *(tmp_path / 's', file),
    )
    assert found['verdict'] == 'in_use'
    assert found['toggle'] is None
    assert found['error_mm']['off'] is None
    assert 'another file' in found['warnings'][0]
    # It could act twice, and nothing would show it.
    assert 'not seen' in found['warnings'][1]


def test_the_makers_accuracy_option_is_compared(tmp_path, file):
    content = json.loads(file.read_text())
    content['state'] = {'accuracy_option': 'active'}
    file.write_text(json.dumps(content))
    other = replace(session_of(CASE), accuracy_option='inactive')
    (warning,) = verified(other, tmp_path / 's', file)['warnings']
    assert "maker's accuracy option is inactive, and was active" in warning
    same = replace(other, accuracy_option='active')
    assert verified(same, tmp_path / 't', file)['warnings'] == []
    out = tmp_path / 'pad'
    remaster('export', file, '--to', 'pad', '--out', out, '--quiet')
    assert 'accuracy option active' in (out / 'remaster.txt').read_text()


def test_what_is_refused_is_one_line(tmp_path, file):
    session = session_of(CASE)
    m = session.measurements

    def refused(changed, given=file, status=2):
        folder = tmp_path / str(len(list(tmp_path.iterdir())))
        write_session(folder, changed)
        line = refusal('verify', folder, '--compensation', given, status=status)
        assert str(folder) in line or status == 1
        return line

    assert 'column correction' in refused(
        replace(session, measurements=replace(m, correction=None))
    )
    layer = replace(session, correction=Correction('layer'))
    assert 'wanted1_rad' in refused(replace(layer, measurements=replace(m, wanted=None)))
    other = save(tmp_path, found_arm(replace(CASE, name='six'))[1], robot('six'))
    assert 'its joints' in refused(session, other)
    few = m.select(np.r_[0:3, 10:13])
    assert 'rows' in refused(
        replace(session, measurements=few),
        save(tmp_path, found_arm(CASE)[1], robot(CASE.name)),
        status=1,
    )
