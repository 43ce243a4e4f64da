# SPDX-License-Identifier: Apache-2.0
"""Every file that a command reads may be a pipe that nobody writes, or a link to a device."""

import json
import os

import pytest

from remaster_ros.cli.main import main

KINDS = ('pipe', 'device')
# Command lines in which FILE is the file, and OUT a new folder or file.
COMMANDS = {
    'a session': ['fit', 'FILE', '--out', 'OUT'],
    'a session to discover': ['discover', 'FILE', '--out', 'OUT'],
    'a session of a batch': ['batch', 'FILE', '--out', 'OUT'],
    'rows': ['fit', 'FOLDER/observations.csv', '--out', 'OUT'],
    'rows of a batch': ['batch', 'FOLDER/observations.csv', '--out', 'OUT'],
    'a header': ['fit', 'FOLDER/session.yaml', '--out', 'OUT'],
    'a header of a batch': ['batch', 'FOLDER/session.yaml', '--out', 'OUT'],
    'the arm of a batch': ['batch', 'FOLDER/robot.urdf', '--out', 'OUT'],
    'a manifest of a batch': ['batch', 'FOLDER/SHA256SUMS', '--out', 'OUT'],
    'a baseline of a batch': ['batch', 'SESSION', '--baseline', 'FILE', '--out', 'OUT'],
    'a table': ['import', 'FILE', '--urdf', 'URDF', '--out', 'OUT'],
    'an arm': ['import', 'TABLE', '--urdf', 'FILE', '--out', 'OUT'],
    'a robot': ['init', 'FILE', '--out', 'OUT'],
    'a robot in xacro': ['init', 'FILE.xacro', '--out', 'OUT'],
    'a cell': ['plan', 'FILE', '--out', 'OUT'],
    'offsets': ['accuracy', 'SESSION', '--offsets', 'FILE'],
    'a correction': ['compensate', 'FILE', 'TABLE', '--out', 'OUT'],
    'a correction to export': ['export', 'FILE', '--to', 'json', '--out', 'OUT'],
    'a correction to verify': ['verify', 'SESSION', '--compensation', 'FILE'],
    'a baseline': ['check', 'SESSION', '--baseline', 'FILE', '--history', 'OUT'],
    'a bag': ['replay', 'FILE', '--out', 'OUT'],
    'a session to report': ['report', 'FILE', '--out', 'OUT'],
    'a session to recover': ['recover', 'FILE'],
}


@pytest.mark.timeout(120)
@pytest.mark.parametrize('kind', KINDS)
@pytest.mark.parametrize('name', COMMANDS)
def test_a_file_without_an_end_is_refused_in_one_line(name, kind, tmp_path, capsys):
    words = [word for word in COMMANDS[name]]
    session = tmp_path / 'session'
    session.mkdir()
    (tmp_path / 'table.csv').write_text('j1;x;y;z\n1;2;3;4\n')
    (tmp_path / 'arm.urdf').write_text('<robot name="r"><link name="a"/></robot>')
    inside = next((w.partition('/')[2] for w in words if w.startswith('FOLDER/')), '')
    suffix = '.xacro' if 'FILE.xacro' in words else ''
    path = session / inside if inside else tmp_path / f'file{suffix}'
    if kind == 'pipe':
        os.mkfifo(path)
    else:
        path.symlink_to('/dev/zero')
    named = {
        'FILE': path,
        'FILE.xacro': path,
        'SESSION': session,
        'TABLE': tmp_path / 'table.csv',
        'URDF': tmp_path / 'arm.urdf',
        'OUT': tmp_path / 'out',
    }
    arguments = [
        str(session if word.startswith('FOLDER/') else named.get(word, word)) for word in words
    ]
    # A batch goes on with its other sessions, and its rows have the error.
    is_batch = words[0] == 'batch'
    arguments += ['--workers', '1', '--json'] if is_batch else []
    assert main([*arguments, '--quiet']) == (1 if is_batch else 2)
    said = capsys.readouterr()
    if is_batch:
        (row,) = json.loads(said.out)['rows']
        assert row['status'] == 'error'
        assert 'fault' not in row['error']
    else:
        assert len(said.err.strip().splitlines()) == 1
        assert 'a fault of this program' not in said.err


def test_a_pipe_as_history_is_refused_before_anything_is_written(tmp_path, capsys):
    os.mkfifo(tmp_path / 'history.jsonl')
    from remaster_ros.cli.check import _require_history
    from remaster_ros.errors import InputError
    from remaster_ros.session.records.journal import Journal

    with pytest.raises(InputError, match='not a regular file'):
        _require_history(tmp_path / 'history.jsonl')
    with pytest.raises(InputError, match='not a regular file'):
        Journal(tmp_path / 'history.jsonl')
