# SPDX-License-Identifier: Apache-2.0
"""What `append` returned from is on the disk, whatever happens next."""

import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from worlds.session_shapes import observations

from remaster_ros.errors import DiskError, InputError
from remaster_ros.session.records.reader import read_session, write_session
from remaster_ros.session.records.session_writer import SessionWriter


def test_the_folder_is_readable_after_every_observation(session, tmp_path):
    folder = tmp_path / 'new' / 'session'
    with SessionWriter(folder, session) as writer:
        for count, observation in enumerate(observations(session), start=1):
            writer.append(observation)
            read = read_session(folder)
            assert len(read.measurements) == count
            assert read.exit_status == 'aborted'
    read = read_session(folder)
    assert read.exit_status == 'complete'
    for name, value in vars(session.measurements).items():
        if name != 'effort':
            np.testing.assert_array_equal(getattr(read.measurements, name), value, err_msg=name)
    assert sorted(os.listdir(folder)) == [
        'SHA256SUMS', 'journal.jsonl', 'observations.csv', 'robot.urdf', 'session.yaml',
    ]  # fmt: skip


def test_both_writers_write_the_same_bytes(session, tmp_path):
    session = replace(session, measurements=replace(session.measurements, effort=None))
    write_session(tmp_path / 'a', session)
    with SessionWriter(tmp_path / 'b', session) as writer:
        for observation in observations(session):
            writer.append(observation)
    for name in ('observations.csv', 'session.yaml', 'robot.urdf'):
        assert (tmp_path / 'a' / name).read_bytes() == (tmp_path / 'b' / name).read_bytes()


def test_the_exit_status_is_what_close_says(session, tmp_path):
    writer = SessionWriter(tmp_path / 's', session)
    first, second, *_ = observations(session)
    writer.append(first)
    writer.close('stopped')
    writer.close('complete')
    assert read_session(tmp_path / 's').exit_status == 'stopped'
    with pytest.raises(InputError, match='closed'):
        writer.append(second)


def test_an_exception_leaves_an_aborted_session(session, tmp_path):
    def collect():
        with SessionWriter(tmp_path / 's', session) as writer:
            writer.append(next(observations(session)))
            raise RuntimeError('cable')

    with pytest.raises(RuntimeError, match='cable'):
        collect()
    assert read_session(tmp_path / 's').exit_status == 'aborted'


def test_a_wrong_observation_is_refused_and_not_written(session, tmp_path):
    first, second, *_ = observations(session)
    with SessionWriter(tmp_path / 's', session) as writer:
        writer.append(first)
        before = (tmp_path / 's' / 'observations.csv').read_bytes()
        for wrong, problem in [
            (first, 'already on line 2'),
            (replace(second, stamp_s=-1.0), 'time runs backwards'),
            (replace(second, sensor='camera'), 'not among the sensors'),
            (replace(second, marker='a\nb'), 'not among the markers'),
            (replace(second, split='validation'), 'one split'),
            (replace(second, pose=9), 'one pose'),
            (replace(second, q=np.array([0.0, 2.5])), 'outside the limits of joint_2'),
            (replace(second, q=np.zeros(3)), 'columns instead of'),
            (replace(second, position=np.array([0.0, np.nan, 0.0])), 'column y_m'),
        ]:
            with pytest.raises(InputError, match=problem):
                writer.append(wrong)
        assert (tmp_path / 's' / 'observations.csv').read_bytes() == before
        writer.append(second)
    assert len(read_session(tmp_path / 's').measurements) == 2


def test_a_full_disk_costs_nothing(session, tmp_path, full_disk):
    """Wherever it is full, in the journal or behind it, the same is written when there is room."""
    folder = tmp_path / 's'
    first, second, *_ = observations(session)
    writer = SessionWriter(folder, session)
    writer.append(first)
    journal = (folder / 'journal.jsonl').stat().st_size
    for room in (0, 60, journal, journal + 60):
        with full_disk(room), pytest.raises(DiskError, match='No space left'):
            writer.append(second)
        assert len(read_session(folder).measurements) == 1
        assert (folder / 'journal.jsonl').stat().st_size == journal
    writer.append(second)
    with full_disk(), pytest.raises(DiskError, match='No space left'):
        writer.close('complete')
    assert read_session(folder).exit_status == 'aborted'
    writer.close('complete')
    session = read_session(folder)
    assert session.exit_status == 'complete'
    assert len(session.measurements) == 2


def test_a_folder_with_files_is_refused(session, tmp_path):
    (tmp_path / 'notes.txt').write_text('mine')
    with pytest.raises(InputError, match='already holds files'):
        SessionWriter(tmp_path, session)
    assert os.listdir(tmp_path) == ['notes.txt']


KILLED = """
import sys
from remaster_ros.session.records.reader import read_session
from remaster_ros.session.records.session_writer import SessionWriter
sys.path[:0] = [{tests!r}]
from worlds.session_shapes import observations
session = read_session({source!r})
writer = SessionWriter({folder!r}, session)
for observation in observations(session):
    writer.append(observation)
    print(observation.observation, flush=True)
sys.stdin.read()
"""


def test_a_killed_writer_loses_nothing_it_acknowledged(session, tmp_path):
    write_session(tmp_path / 'source', session)
    script = KILLED.format(
        tests=str(Path(__file__).parents[2]),
        source=str(tmp_path / 'source'),
        folder=str(tmp_path / 's'),
    )
    with subprocess.Popen(
        [sys.executable, '-c', script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        acknowledged = [int(process.stdout.readline()) for _ in range(12)]
        process.send_signal(signal.SIGKILL)
    read = read_session(tmp_path / 's')
    assert read.exit_status == 'aborted'
    assert set(acknowledged) <= set(read.measurements.observation.tolist())


def resumed(session, folder):
    return SessionWriter(folder, session, resume=True)


def test_a_killed_session_is_gone_on_with(session, tmp_path):
    """Numbers go on, the journal is there again, and the rows are those of one run."""
    rows = list(observations(session))
    writer = resumed(session, tmp_path / 's')
    assert not writer.resumed
    writer.record({'kind': 'configuration', 'pose': 0}, rows[:2])
    writer.record({'kind': 'note', 'text': 'größer'})
    writer.release()
    writer = resumed(session, tmp_path / 's')
    assert writer.resumed
    assert (writer.observations, writer.configurations) == (2, 1)
    assert writer.last_stamp_s == rows[1].stamp_s
    assert [record['kind'] for record in writer.records] == ['configuration', 'note']
    assert writer.records[1]['text'] == 'größer'
    with pytest.raises(InputError, match='already on line 2'):
        writer.append(rows[0])
    writer.close('stopped')
    assert read_session(tmp_path / 's').exit_status == 'stopped'
    writer = resumed(session, tmp_path / 's')
    assert read_session(tmp_path / 's').exit_status == 'aborted'
    for row in rows[2:]:
        writer.append(row)
    writer.close()
    with SessionWriter(tmp_path / 'whole', session) as single_run:
        for row in rows:
            single_run.append(row)
    for name in ('observations.csv', 'session.yaml'):
        assert (tmp_path / 's' / name).read_bytes() == (tmp_path / 'whole' / name).read_bytes()
    with pytest.raises(InputError, match='is complete'):
        resumed(session, tmp_path / 's')


def test_a_session_is_written_by_one_process(session, tmp_path):
    with (
        resumed(session, tmp_path / 's'),
        pytest.raises(InputError, match='another process is writing'),
    ):
        resumed(session, tmp_path / 's')


@pytest.mark.parametrize(
    ('change', 'problem'),
    [
        ({'settle_s': 1.0}, 'another settle_s'),
        ({'sensors': {'mocap': 'sir', 'tracker': 'sir'}}, 'another sensors'),
        ({'markers': {'sir': np.zeros(3), 'smr': np.zeros(3)}}, 'another markers'),
    ],
)
def test_another_session_is_not_gone_on_with(session, tmp_path, change, problem):
    writer = SessionWriter(tmp_path / 's', session)
    writer.append(next(observations(session)))
    writer.release()
    before = {p.name: p.read_bytes() for p in (tmp_path / 's').iterdir()}
    with pytest.raises(InputError, match=problem):
        resumed(replace(session, **change), tmp_path / 's')
    with pytest.raises(InputError, match='another URDF'):
        resumed(replace(session, urdf=session.urdf + '<!-- -->'), tmp_path / 's')
    assert {p.name: p.read_bytes() for p in (tmp_path / 's').iterdir()} == before


def test_a_session_of_another_program_is_not_gone_on_with(session, tmp_path):
    write_session(tmp_path / 's', replace(session, exit_status='stopped'))
    with pytest.raises(InputError, match=r'without journal\.jsonl'):
        resumed(
            replace(session, base_prior=read_session(tmp_path / 's').base_prior), tmp_path / 's'
        )


@pytest.mark.parametrize('name', ['observations.csv', 'session.yaml', 'robot.urdf'])
def test_a_closed_file_that_changed_is_named_and_not_used(session, tmp_path, name):
    with SessionWriter(tmp_path / 's', session) as writer:
        for observation in observations(session):
            writer.append(observation)
    check = subprocess.run(
        ['sha256sum', '--check', '--strict', 'SHA256SUMS'],
        cwd=tmp_path / 's', capture_output=True, text=True,
    )  # fmt: skip
    assert check.returncode == 0, check.stdout
    path = tmp_path / 's' / name
    original = path.read_bytes()
    seed = 4
    print('seed', seed)
    rng = np.random.default_rng(seed)
    for _ in range(50):
        data = bytearray(original)
        data[rng.integers(len(data))] ^= 1 << rng.integers(8)
        path.write_bytes(data)
        with pytest.raises(InputError, match=f'{name}: not as it was closed'):
            read_session(tmp_path / 's')
    path.write_bytes(original)
    read_session(tmp_path / 's')
