# SPDX-License-Identifier: Apache-2.0
"""`remaster recover`: 0 where nothing was lost, 3 where something was (and what), else 2."""

import json
import random

import pytest
from faults.session_crashes import live, make_observations, session_header
from rigs.command_line import refusal, remaster

from remaster_ros.session.records.reader import read_session
from remaster_ros.session.records.session_writer import SessionWriter


@pytest.fixture
def killed(tmp_path):
    """Return the folder of a session whose recorder was killed."""
    writer = SessionWriter(tmp_path / 's', session_header())
    for number, group in enumerate(make_observations(1, 4)):
        writer.record({'kind': 'configuration', 'number': number}, group)
    writer.release()
    return tmp_path / 's'


def test_nothing_was_lost(killed):
    before = len(read_session(killed).measurements)
    assert remaster('recover', killed) == (f'{killed}: recovered\n', '')
    assert remaster('recover', killed) == (f'{killed}: at rest, nothing to recover\n', '')
    assert remaster('recover', '--quiet', killed) == ('', '')
    out, err = remaster('recover', '--json', killed)
    assert json.loads(out) == {'session': str(killed), 'finished': False, 'lost': []}
    assert err == ''
    session = read_session(killed)
    assert len(session.measurements) == before
    assert session.exit_status == 'aborted'


@pytest.mark.parametrize('tail', [b'{"kind":"configur', b'{"name":"gr\xc3', bytes(700)])
def test_a_line_being_written_was_lost(killed, tail):
    with (killed / 'journal.jsonl').open('ab') as file:
        file.write(tail)
    before = len(read_session(killed).measurements)
    out = remaster('recover', killed, status=3).stdout
    assert f'journal.jsonl, line 5: {len(tail)} bytes of a line' in out
    remaster('recover', killed)
    assert len(read_session(killed).measurements) == before


@pytest.mark.parametrize('zeros', [0, 40])
def test_observations_that_only_the_journal_has_come_back(killed, zeros):
    path = killed / 'observations.csv'
    data = path.read_bytes()
    last = data.rstrip(b'\n').rfind(b'\n') + 1
    path.write_bytes(data[: random.Random(2).randint(last + 1, len(data) - 41)] + bytes(zeros))
    remaster('recover', killed)
    assert path.read_bytes() == data


def test_what_is_no_session_or_damaged_or_in_use(killed, tmp_path):
    assert 'none' in refusal('recover', tmp_path / 'none')
    writer = SessionWriter(killed, session_header(), resume=True)
    assert 'another process is writing' in refusal('recover', killed)
    writer.close('stopped')
    data = bytearray((killed / 'journal.jsonl').read_bytes())
    data[40] ^= 1
    (killed / 'journal.jsonl').write_bytes(data)
    assert 'journal.jsonl: not as it was closed' in refusal('recover', killed)
    (killed / 'SHA256SUMS').unlink()
    assert 'journal.jsonl, line 1: damaged' in refusal('recover', killed)


def test_a_life_without_a_crash_needs_no_recovery(tmp_path):
    live(tmp_path, seed=5)
    remaster('recover', tmp_path / 'new' / 'session')
