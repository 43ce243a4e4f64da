# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C at any moment: every process gone soon, the session readable."""

import os
import signal
import time
from pathlib import Path

import pytest
import yaml
from rigs.ros_rig import PATIENCE, wait_until

from remaster_ros.session.records.reader import read_session

LIMIT_S = 5.0 * PATIENCE

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(900)]


def children(pid):
    """Return the pids of the processes that descend from `pid`."""
    found = []
    for entry in Path('/proc').iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / 'stat').read_text().rpartition(')')[2].split()
            except OSError:
                continue
            if int(fields[1]) == pid:
                found += [int(entry.name), *children(int(entry.name))]
    return found


def alive(pids):
    states = []
    for pid in pids:
        try:
            states.append(Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[0])
        except OSError:
            continue
    return [state for state in states if state != 'Z']


def observations(session):
    try:
        lines = (session / 'observations.csv').read_text().splitlines()
        # Those of references are none.
        return sum(',reference,' not in line for line in lines) - 1
    except OSError:
        return -1


def stop(process, signum=signal.SIGINT):
    """Send the signal; return how long until the demo and all its children were gone."""
    pids = [process.pid, *children(process.pid)]
    began = time.monotonic()
    os.kill(process.pid, signum)
    process.wait(timeout=900)
    wait_until(lambda: not alive(pids), 20, 'the processes to end')
    return time.monotonic() - began, len(pids)


def imports(pid):
    """Whether a process has begun to import what the command line needs."""
    return 'numpy' in Path(f'/proc/{pid}/maps').read_text()


@pytest.mark.parametrize(
    ('moment', 'signum'), [(imports, signal.SIGINT), (children, signal.SIGTERM)]
)
def test_while_it_starts(start, tmp_path, moment, signum):
    process = start('remaster_ros.cli.main', 'demo', '--out', tmp_path / 'out')
    wait_until(lambda: moment(process.pid), 30, f'it {moment.__name__}')
    seconds, _ = stop(process, signum)
    assert seconds < LIMIT_S
    assert 'Traceback' not in process.stderr.read()


@pytest.mark.qualify
def test_while_it_collects(start, tmp_path):
    out = tmp_path / 'out'
    process = start(
        'remaster_ros.cli.main', 'demo', '--out', out, '--no-figures', '--candidates', '4'
    )
    wait_until(
        lambda: observations(out / 'session') >= 2 or process.poll() is not None,
        150,
        'two observations',
    )
    assert process.poll() is None, process.communicate()
    seconds, processes = stop(process)
    assert processes >= 10
    assert seconds < LIMIT_S
    assert process.returncode == 130
    assert 'Traceback' not in process.stderr.read()
    assert (
        yaml.safe_load((out / 'session' / 'session.yaml').read_text())['exit_status'] == 'stopped'
    )
    session = read_session(out / 'session')
    assert len(session.measurements) >= 2
    for log in (out / 'log').iterdir():
        assert 'Traceback' not in log.read_text(), log


@pytest.mark.qualify
def test_a_halted_demo_ends_and_says_why(start, tmp_path):
    """The fake robot stands still: the bridge halts, and nobody is there who could end that."""
    out = tmp_path / 'out'
    process = start(
        'remaster_ros.cli.main', 'demo', '--out', out, '--no-figures', '--candidates', '4'
    )
    wait_until(lambda: observations(out / 'session') >= 2, 300, 'two observations')
    (robot,) = [
        pid
        for pid in children(process.pid)
        if b'fake_robot' in Path(f'/proc/{pid}/cmdline').read_bytes().split(b'\0')
    ]
    os.kill(robot, signal.SIGSTOP)
    process.wait(timeout=120)
    printed, error = process.stdout.read(), process.stderr.read()
    # 1 where it was measured for long enough to be fitted.
    assert process.returncode in (1, 2), (printed, error)
    told = ' '.join((error if process.returncode == 2 else printed).split())
    assert 'the arm was halted' in told
    assert f'remaster demo --out {out} goes on' in told
    assert 'Traceback' not in error
    assert len(read_session(out / 'session').measurements) >= 2


def test_a_killed_demo_leaves_no_process(start, tmp_path):
    """Even SIGKILL: the kernel signals the children that their parent has died."""
    out = tmp_path / 'out'
    process = start('remaster_ros.cli.main', 'demo', '--out', out, '--no-figures')
    wait_until(lambda: observations(out / 'session') >= 0, 60, 'the session')
    pids = children(process.pid)
    assert len(pids) >= 9
    process.kill()
    process.wait(timeout=900)
    wait_until(lambda: not alive(pids), 10, 'the orphans to end')
    assert (
        yaml.safe_load((out / 'session' / 'session.yaml').read_text())['exit_status'] == 'stopped'
    )
