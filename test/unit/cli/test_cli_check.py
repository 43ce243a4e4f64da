# SPDX-License-Identifier: Apache-2.0
"""``remaster check``: the history, what it refuses, and what is printed."""

import json
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from rigs.command_line import refusal, remaster
from scipy.spatial.transform import Rotation
from worlds.checked_arms import CheckedArm
from worlds.compensation_files import save
from worlds.hidden_tours import robot
from worlds.measured_rows import measured_rows

from remaster_ros.compensation.checking import Measured
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.session.records.reader import write_session
from remaster_ros.types import Session


def write(folder: Path, check: Measured) -> Path:
    """Write a check as a session."""
    m = measured_rows(check.q, check.position)
    markers = {'sir': np.array([0.1, 0.0, 0.02])}
    write_session(
        folder, Session(robot('iiwa7'), 'base_link', 'tool', markers, {'mocap': 'sir'}, m)
    )
    return folder


@pytest.fixture
def arm():
    return CheckedArm(21)


@pytest.fixture
def run(tmp_path, arm):
    """Return a function that checks a session, and what it prints as JSON."""
    baseline = save(tmp_path, arm.found, robot('iiwa7'))

    def check(folder, *more, status=0, history='arm.jsonl'):
        given = ('--baseline', baseline, '--history', tmp_path / history, '--json')
        stdout, stderr = remaster('check', folder, *given, *more, status=status)
        return json.loads(stdout) if status == 0 else stderr

    return check


def test_day_by_day_until_a_joint_has_changed(run, arm, tmp_path):
    for day in range(12):
        found = run(write(tmp_path / f'day{day}', arm.check()))
        assert found['format'] == 'remaster-check/1'
        assert found['verdict'] == 'unchanged', found
        assert found['checks'] == day + 1
    assert [joint['detectable_mm'] is None for joint in found['joints']] == [True, *[False] * 6]
    changed = arm.joint(3, 5e-4)
    for day in range(12, 16):
        found = run(write(tmp_path / f'day{day}', arm.check(changed)))
    assert found['verdict'] == 'changed'
    assert found['changed'] == ['joint_4']
    assert found['since'] == 'day12'
    assert abs(found['joints'][3]['change_mm']) == pytest.approx(0.5, abs=0.1)
    page = tmp_path / 'check.html'
    # The same session again is the same check: it is judged, not added.
    again = run(tmp_path / 'day15', '--out', str(page))
    assert again == found
    assert 'joint_4: changed' in page.read_text(encoding='utf-8')
    assert 'already, as check 1 of 16' in run(tmp_path / 'day0', status=2)
    args = ('check', tmp_path / 'day15', '--history', tmp_path / 'arm.jsonl')
    text = remaster(*args, '--baseline', tmp_path / 'compensation.json').stdout
    assert 'changed: Changed since check 13 (day12): joint_4' in text
    assert 'joint_1: looks like a sensor that was moved' in text


def test_a_drift_is_told_with_the_day_of_the_next_check(run, arm, tmp_path):
    """A check a day by what sessions state; the history keeps the times."""
    first = datetime(2026, 11, 1, tzinfo=UTC)
    found = {}
    for day in range(26):
        folder = write(tmp_path / f'day{day}', arm.check(arm.joint(3, 1.2e-5 * max(0, day - 4))))
        header = folder / 'session.yaml'
        created = (first + timedelta(days=day)).isoformat()
        header.write_text(f'{header.read_text()}created: "{created}"\n')
        found = run(folder)
        if found['trend'] is not None or found['verdict'] == 'changed':
            break
    assert found['trend'] is not None, found['text']
    assert found['trend']['joints'] == ['joint_4']
    assert found['text'].startswith('Drifting: joint_4, 0.')
    assert found['next_check'].startswith('2026-1')
    args = ('check', folder, '--baseline', tmp_path / 'compensation.json')
    page = tmp_path / 'check.html'
    text = remaster(*args, '--history', tmp_path / 'arm.jsonl', '--out', page).stdout
    assert text.startswith(f'Drifting: joint_4, {found["trend"]["size_mm"]:.2f} mm at the tool in')
    assert '<h1>Drifting</h1>' in page.read_text(encoding='utf-8')


def test_no_check_that_shows_a_change_says_that_none_has_changed(run, arm, tmp_path):
    """A short history takes some checks to be sure; until then what it shows is not denied."""
    changed = arm.joint(3, 8e-4)
    for day in range(6):
        page = tmp_path / 'check.html'
        check = arm.check(changed) if day > 1 else arm.check()
        found = run(write(tmp_path / f'day{day}', check), '--out', str(page))
        beyond = [
            row['joint']
            for row in found['joints']
            if row['detectable_mm'] and abs(row['change_mm']) > row['detectable_mm']
        ]
        denied = 'No joint has changed by more than a check can see' in found['text']
        assert not (denied and beyond)
        assert denied == (found['verdict'] == 'unchanged' and not beyond)
        assert 'Nothing has changed' not in page.read_text(encoding='utf-8')


def test_a_torn_line_is_dropped_and_said(run, arm, tmp_path):
    run(write(tmp_path / 'day0', arm.check()))
    history = tmp_path / 'arm.jsonl'
    history.write_bytes(history.read_bytes() + b'{"format": "remaster-ch')
    args = ('--history', history, '--baseline', tmp_path / 'compensation.json', '--json')
    stdout, stderr = remaster('check', write(tmp_path / 'day1', arm.check()), *args)
    assert json.loads(stdout)['checks'] == 2
    assert 'cut off while being written are dropped' in stderr


def test_what_is_refused_leaves_the_history_as_it_was(run, arm, tmp_path):
    first = arm.check()
    run(write(tmp_path / 'day0', first))
    history = tmp_path / 'arm.jsonl'
    before = history.read_bytes()
    short = Measured(first.q[1:], first.sensor[1:], first.marker[1:], first.position[1:])
    error = run(write(tmp_path / 'short', short), status=2)
    assert 'day' not in error
    assert 'where the first check has one: measure the same poses' in error
    few = Measured(first.q[:2], first.sensor[:2], first.marker[:2], first.position[:2])
    assert 'measure' in run(write(tmp_path / 'few', few), status=1, history='other.jsonl')
    assert history.read_bytes() == before


def test_a_file_that_is_no_history_is_left_as_it_was(run, arm, tmp_path):
    folder = write(tmp_path / 'day0', arm.check())
    table = folder / 'observations.csv'
    before = table.read_bytes()
    error = run(folder, status=2, history='day0/observations.csv')
    assert 'observations.csv, line 1: is no check of an arm' in error
    assert table.read_bytes() == before
    assert run(folder, status=2, history='day0').count('\n') == 1
    # A history of which a crash has left a part of the first line alone is one.
    for torn in (b'', b'{"form', bytes(40), b'{"format":"remaster-check-history/1","base'):
        (tmp_path / 'torn.jsonl').write_bytes(torn)
        assert run(folder, history='torn.jsonl')['checks'] == 1


def test_another_arm_and_another_baseline_are_refused(run, arm, tmp_path):
    folder = write(tmp_path / 'day0', arm.check())
    run(folder)
    other = tmp_path / 'other'
    other.mkdir()
    model = replace(arm.found, joint_offsets=arm.found.joint_offsets + 1e-3)
    baseline = save(other, model, robot('iiwa7'))
    args = ('check', folder, '--history', tmp_path / 'arm.jsonl', '--baseline', baseline)
    assert 'was compared with another baseline' in refusal(*args)


def test_figures_of_iso_9283_need_its_visits(run, arm, tmp_path):
    """Five poses, 30 visits each; AP and RP by the standard's formulas and SciPy's alignment."""
    rng = np.random.default_rng(9283)
    q, names = np.tile(arm.q[:5], (30, 1)), {'sensor': ('mocap',) * 150, 'marker': ('sir',) * 150}
    at = arm.true.in_sensor(arm.true.state(q), 'mocap', 'sir')
    at += 1e-4 * rng.standard_normal(at.shape)
    iso = run(write(tmp_path / 'whole', Measured(q=q, position=at, **names)))['iso9283']
    each = at.reshape(30, 5, 3)
    distance = np.linalg.norm(each - each.mean(axis=0), axis=2)
    repeatability = distance.mean(axis=0) + 3.0 * distance.std(axis=0, ddof=1)
    assert iso['repeatability_mm'] == pytest.approx(1e3 * repeatability, rel=1e-9)
    frames = SerialChain.from_urdf(robot('iiwa7'), 'base_link', 'tool').forward(arm.q[:5])
    drawn = frames[:, :3, :3] @ arm.found.markers['sir'] + frames[:, :3, 3]
    drawn, centres = drawn - drawn.mean(axis=0), each.mean(axis=0) - at.mean(axis=0)
    turn, _ = Rotation.align_vectors(drawn, centres)
    accuracy = np.linalg.norm(turn.apply(centres) - drawn, axis=1)
    assert iso['accuracy_mm'] == pytest.approx(1e3 * accuracy, rel=1e-6)
    # Readings one after the other are one visit.
    order = np.argsort(np.arange(150) % 5, kind='stable')
    standing = Measured(q=q[order], position=at[order], **names)
    page = tmp_path / 'check.html'
    none = run(
        write(tmp_path / 'standing', standing), '--out', str(page), history='another.jsonl'
    )['iso9283']
    assert none['accuracy_mm'] == []
    missing = 'it asks for 30 visits of each of 5 poses, and here 5 were visited, 1 time at most'
    assert missing in none['text']
    assert missing in page.read_text(encoding='utf-8')
