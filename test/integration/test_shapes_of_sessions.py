# SPDX-License-Identifier: Apache-2.0
"""Sessions of every shape go through every verb of the command line."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
from rigs.command_line import refusal, remaster
from worlds.session_shapes import CHEAP, LARGE, LAST_ALONE, observations, one_pose_for_all

from remaster_ros.session.records.reader import read_session, write_session
from remaster_ros.session.records.session_writer import SessionWriter

# Every append waits for the disk.
MOST_RECORDED = 300
# What is read again in another way takes the same turns, and three sensors those of two, which
# test_what_is_told has.
ALIKE = (
    'three sensors',
    'each read three times, none held out',
    'some read twice',
    'read twice, a pose for every reading',
    # As another one that is read twice, or that has few rows held out.
    'a real arm, each read twice',
    'one pose of twenty held out',
)


def own_table(session, folder):
    """Write the joints and points of one sensor and marker as a table of anybody's."""
    m = session.measurements
    rows = np.flatnonzero((m.sensor == m.sensor[0]) & (m.marker == m.marker[0]))
    path = folder / 'table.csv'
    joints = [f'q{i + 1}_rad' for i in range(m.q.shape[1])]
    with path.open('w', newline='') as file:
        writer = csv.writer(file)
        writer.writerow([*joints, 'x_m', 'y_m', 'z_m'])
        writer.writerows(np.column_stack((m.q[rows], m.position[rows])).tolist())
    (folder / 'arm.urdf').write_text(session.urdf)
    return path


def goes_through_every_verb(session, folder, figures=False):
    given, fit, found = folder / 'session', folder / 'fit', folder / 'found'
    if len(session.measurements) <= MOST_RECORDED:
        with SessionWriter(given, session) as writer:
            for observation in observations(session):
                writer.append(observation)
    else:
        write_session(given, session)
    table = own_table(session, folder)
    ends = ('--base-link', session.base_link, '--tip-link', session.tip_link)
    for verb in (
        ('recover', given),
        ('fit', given, '--out', fit),
        ('discover', given, '--out', found),
        ('accuracy', given, '--offsets', fit / 'fit.json'),
        ('report', given, fit, found, '--out', folder / 'page'),
        ('import', table, '--urdf', folder / 'arm.urdf', '--out', folder / 'again', *ends),
    ):
        plain = verb[0] in ('fit', 'discover', 'report') and not figures
        # Without a recorder's journal there is nothing to recover from.
        recorded = (given / 'journal.jsonl').exists() or verb[0] != 'recover'
        more = ('--quiet', *(['--no-figures'] if plain else []))
        said = remaster(*verb, *more, status=0 if recorded else 2)
        assert ('error' in said.stderr) == (not recorded)
    offsets = json.loads((fit / 'fit.json').read_text())['joint_offsets']
    assert sum(offset['identifiable'] for offset in offsets) >= len(offsets) - 3
    again = read_session(folder / 'again').measurements
    assert len(again) == len(table.read_text().splitlines()) - 1


@pytest.mark.parametrize(
    'shape',
    [pytest.param(s, marks=pytest.mark.qualify if s in ALIKE else ()) for s in CHEAP],
)
def test_a_small_session_goes_through_every_verb(shape, tmp_path):
    session = CHEAP[shape]()
    if session is None:
        pytest.skip('the real data sets are not beside this repository (../shared/data)')
    goes_through_every_verb(session, tmp_path, figures=shape == LAST_ALONE)


@pytest.mark.qualify
@pytest.mark.timeout(3600)
@pytest.mark.parametrize('shape', LARGE)
def test_a_large_session_goes_through_every_verb(shape, tmp_path):
    session = LARGE[shape]()
    if session is None:
        pytest.skip('the real data sets are not beside this repository (../shared/data)')
    goes_through_every_verb(session, tmp_path)


def test_forty_rows_of_one_pose_are_too_little_and_it_is_said(tmp_path):
    write_session(tmp_path / 'session', one_pose_for_all(10))
    for verb in ('fit', 'discover'):
        args = (verb, tmp_path / 'session', '--out', tmp_path / verb, '--no-figures')
        assert 'saw 1 pose to fit; at least 3 are needed' in refusal(*args, status=1)
