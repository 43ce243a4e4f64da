"""What `append` returned from is on the disk, whatever happens next."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from remaster_ros.core.errors import InputError
from remaster_ros.core.types import Observation
from remaster_ros.storage.session import read_session, write_session
from remaster_ros.storage.session_writer import SessionWriter


def observations(session):
    m = session.measurements
    for i in range(len(m)):
        yield Observation(
            observation=int(m.observation[i]),
            pose=int(m.pose[i]),
            configuration=int(m.configuration[i]),
            split='validation' if m.is_validation[i] else 'optimization',
            stamp_s=m.stamp_s[i],
            sensor=session.sensor_names[m.sensor[i]],
            marker=session.marker_names[m.marker[i]],
            q=m.q[i],
            position=m.position[i],
            from_q=None if np.isnan(m.from_q[i]).any() else m.from_q[i],
            std=None if np.isnan(m.std[i]).any() else m.std[i],
            samples=None if m.samples[i] < 0 else int(m.samples[i]),
            temperature_c=None if np.isnan(m.temperature_c[i]) else m.temperature_c[i],
        )


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


def test_a_full_disk_costs_only_the_observation_being_written(session, tmp_path, monkeypatch):
    first, second, *_ = observations(session)
    write = os.write
    with SessionWriter(tmp_path / 's', session) as writer:
        writer.append(first)

        def full(descriptor, data):
            if len(data) < 60:
                raise OSError(errno.ENOSPC, 'No space left on device')
            return write(descriptor, data[:60])

        with monkeypatch.context() as patch:
            patch.setattr(os, 'write', full)
            with pytest.raises(InputError, match='No space left'):
                writer.append(second)
        assert len(read_session(tmp_path / 's').measurements) == 1
        writer.append(second)
    assert len(read_session(tmp_path / 's').measurements) == 2


def test_a_folder_with_files_is_refused(session, tmp_path):
    (tmp_path / 'notes.txt').write_text('mine')
    with pytest.raises(InputError, match='already holds files'):
        SessionWriter(tmp_path, session)
    assert os.listdir(tmp_path) == ['notes.txt']


KILLED = """
import sys
from remaster_ros.storage.session import read_session
from remaster_ros.storage.session_writer import SessionWriter
sys.path.insert(0, {tests!r})
from test_session_writer import observations
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
        tests=str(Path(__file__).parent),
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
