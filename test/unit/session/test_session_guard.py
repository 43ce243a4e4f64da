# SPDX-License-Identifier: Apache-2.0
"""What others do to the files of a session while it is written: restored, said, never sealed."""

import json
import os
import shutil
import subprocess

import numpy as np
import pytest
from rigs.command_line import remaster
from worlds.session_shapes import observations

from remaster_ros.errors import InputError, MovedError
from remaster_ros.session.records.reader import read_session
from remaster_ros.session.records.session_writer import SessionWriter

FILES = ('observations.csv', 'journal.jsonl', 'session.yaml', 'robot.urdf')


@pytest.fixture
def folder(tmp_path):
    return tmp_path / 'runs' / 's'


@pytest.fixture
def begun(session, folder):
    """Return a writer with half of the observations, and the rest."""
    writer = SessionWriter(folder, session)
    rows = list(observations(session))
    for row in rows[:10]:
        writer.append(row)
    yield writer, rows[10:]
    writer.release()


@pytest.fixture
def intact_files(session, tmp_path):
    """Return the bytes of the same session when nobody touches it."""
    with SessionWriter(tmp_path / 'whole', session) as writer:
        for row in observations(session):
            writer.append(row)
    return {name: (tmp_path / 'whole' / name).read_bytes() for name in FILES}


def finish(writer, remaining_rows, status='complete'):
    for row in remaining_rows:
        writer.append(row)
    return writer.close(status)


def check_is_whole(folder, intact_files):
    for name in FILES:
        if name != 'journal.jsonl':
            assert (folder / name).read_bytes() == intact_files[name], name
    sealed = subprocess.run(
        ['sha256sum', '--check', '--strict', 'SHA256SUMS'], cwd=folder, capture_output=True
    )
    assert sealed.returncode == 0
    read = read_session(folder)
    assert read.exit_status == 'complete'
    journal = (folder / 'journal.jsonl').read_bytes().splitlines()
    kept = [line for line in journal if b'"kind":"restored"' not in line]
    assert kept == intact_files['journal.jsonl'].splitlines()


def sed(path, script):
    subprocess.run(['sed', '-i', script, str(path)], check=True)


def test_a_file_that_an_editor_saved_is_restored(begun, folder, intact_files):
    """`sed -i` left 20 of 94 rows, sealed as complete."""
    writer, remaining_rows = begun
    sed(folder / 'observations.csv', '4,$d')
    short = (folder / 'observations.csv').read_bytes()
    assert finish(writer, remaining_rows) == 'complete'
    check_is_whole(folder, intact_files)
    (line,) = writer.restored
    assert 'observations.csv: was replaced by another file' in line
    assert 'what was found there is observations.csv.changed' in line
    assert (folder / 'observations.csv.changed').read_bytes() == short
    records = [json.loads(line) for line in (folder / 'journal.jsonl').read_bytes().splitlines()]
    assert [r['file'] for r in records if r['kind'] == 'restored'] == ['observations.csv']


@pytest.mark.parametrize('name', FILES)
@pytest.mark.parametrize(
    ('change', 'when'),
    [
        ('saved', 'in the run'),
        ('saved', 'before the end'),
        ('flipped', 'before the end'),
        ('flipped, dated back', 'in the run'),
        ('cut', 'before the end'),
        ('longer', 'in the run'),
        ('removed', 'before the end'),
        ('folder', 'in the run'),
    ],
)
def test_whatever_is_done_to_a_file_is_undone(begun, folder, intact_files, name, when, change):
    writer, remaining_rows = begun
    path = folder / name
    if when == 'before the end':
        for row in remaining_rows:
            writer.append(row)
        remaining_rows = []
    data, dated = path.read_bytes(), path.stat()
    place = len(data) // 2
    flipped = data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :]
    if change == 'saved':
        sed(path, '1s/e/f/')
        assert path.stat().st_ino != dated.st_ino
    elif change == 'removed':
        path.unlink()
    elif change == 'folder':
        path.unlink()
        path.mkdir()
    else:
        with path.open('r+b') as file:
            file.write(flipped if change.startswith('flipped') else data + b'x\n')
            file.truncate({'cut': place, 'longer': len(data) + 2}.get(change, len(data)))
    if change == 'flipped, dated back':
        os.utime(path, ns=(dated.st_atime_ns, dated.st_mtime_ns))
    assert finish(writer, remaining_rows) == 'complete'
    check_is_whole(folder, intact_files)
    assert len(writer.restored) == 1
    assert str(path) in writer.restored[0]


def test_a_file_that_was_only_touched_is_no_news(begun, folder, intact_files):
    writer, remaining_rows = begun
    for name in FILES:
        os.utime(folder / name)
    writer.check()
    assert finish(writer, remaining_rows) == 'complete'
    assert not writer.restored
    check_is_whole(folder, intact_files)


def test_a_removed_folder_is_noticed_and_its_observations_come_back(begun, folder, session):
    writer, remaining_rows = begun
    shutil.rmtree(folder.parent)
    writer.check()
    assert len(read_session(folder).measurements) == 10
    assert len(writer.restored) == 4
    assert finish(writer, remaining_rows) == 'aborted', 'the bag and the plan are lost'
    assert 'the bag and the plan' in writer.beyond_repair
    assert len(read_session(folder).measurements) == len(session.measurements)
    assert read_session(folder).exit_status == 'aborted'


def test_a_renamed_folder_is_noticed_and_gone_on_with_when_it_is_back(begun, folder, intact_files):
    writer, remaining_rows = begun
    folder.rename(folder.parent / 'elsewhere')
    for attempt in (writer.check, lambda: writer.append(remaining_rows[0]), writer.close):
        with pytest.raises(MovedError, match='put it back under its name'):
            attempt()
    folder.mkdir()
    with pytest.raises(MovedError):
        writer.append(remaining_rows[0])
    folder.rmdir()
    (folder.parent / 'elsewhere').rename(folder)
    assert finish(writer, remaining_rows) == 'complete'
    assert not writer.restored
    check_is_whole(folder, intact_files)


def test_a_restored_journal_is_still_written_by_one_process(begun, folder, session):
    writer, remaining_rows = begun
    sed(folder / 'journal.jsonl', '3d')
    writer.check()
    with pytest.raises(InputError, match='another process is writing'):
        SessionWriter(folder, session, resume=True)
    assert finish(writer, remaining_rows) == 'complete'


def test_a_killed_session_whose_rows_were_changed_is_recovered(begun, folder, session):
    """What the journal has is restored, and what was found is kept beside it."""
    writer, _remaining_rows = begun
    good = (folder / 'observations.csv').read_bytes()
    writer.release()
    sed(folder / 'observations.csv', '3s/$/0/')
    with pytest.raises(InputError, match=r'line 3: not as .*let `remaster recover` re'):
        SessionWriter(folder, session, resume=True)
    assert 'observations.csv.changed' in remaster('recover', folder, status=3).stdout
    assert (folder / 'observations.csv').read_bytes() == good
    remaster('recover', folder)
    read = read_session(folder)
    assert read.exit_status == 'aborted'
    np.testing.assert_array_equal(read.measurements.observation, range(10))
