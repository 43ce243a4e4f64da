# SPDX-License-Identifier: Apache-2.0
"""``remaster batch``: rows that stay, workers that die, and what is said over all sessions."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from rigs import batch_jobs
from rigs.command_line import refusal, remaster, run

from remaster_ros.cli import batch, batch_workers
from remaster_ros.errors import InputError
from remaster_ros.reports.batch_page import summary_of, write_batch_page
from remaster_ros.session.records.journal import read_journal
from remaster_ros.session.records.reader import read_session


def rows(folder: Path) -> dict[str, dict]:
    """Return the rows by session, without what a line is sealed with."""
    found = read_journal(folder / batch.ROWS).records
    return {row['session']: {k: v for k, v in row.items() if k != 'crc32'} for row in found}


@pytest.fixture(scope='module')
def sessions(tmp_path_factory):
    folder = tmp_path_factory.mktemp('sessions')
    for seed, hidden in ((1, ['--effect', 'joint_compliance@2:1.0']), (2, [])):
        given = ('--poses', 12, '--validation', 6, '--sensors', 'mocap', '--seed', seed)
        remaster('simulate', folder / f's{seed}', *given, '--quiet', *hidden)
    return folder


@pytest.fixture(scope='module')
def by_one(sessions, tmp_path_factory):
    """Return the folder that one worker filled, of s1, a copy of it and a broken one.

    And the rows that the calls printed: at the first two something lay where s1 is written. The
    worker is a thread: a process of its own is what `by_two` has.
    """
    folder = tmp_path_factory.mktemp('one')
    (folder / 'empty').mkdir()
    shutil.copytree(sessions / 's1', folder / 'copy')
    out = folder / 'out'
    out.mkdir()
    job = batch._job((sessions / 's1').resolve(), out.resolve(), 0, '')
    Path(job.out).write_text('in the way', encoding='utf-8')
    given = [sessions / 's1', folder / 'copy', folder / 'empty']
    printed = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(batch, 'local_pool', ThreadPoolExecutor)
        for sessions_given in (given[:1], given[:1], given):
            if sessions_given == given:
                Path(job.out).unlink()
            done = run('batch', *sessions_given, '--out', out, '--workers', 1, '--json')
            printed.append((done.returncode, json.loads(done.stdout)['rows']))
    return out, printed


@pytest.fixture(scope='module')
def by_two(sessions, tmp_path_factory):
    """Return the folder that two workers filled."""
    out = tmp_path_factory.mktemp('two') / 'out'
    (sessions / 'empty').mkdir()
    both = (sessions / 'empty', sessions / 's1')
    remaster('batch', *both, '--out', out, '--workers', 2, '--quiet')
    return out


def test_rows_do_not_depend_on_the_workers_and_are_not_made_again(
    sessions, by_one, by_two, monkeypatch
):
    """A broken session has its error and stops nobody."""
    out, (*_, (status, printed)) = by_one
    assert status == 0
    assert [row['status'] for row in printed] == ['done', 'done', 'error']
    assert 'session.yaml: no such file' in printed[2]['error']
    s1 = str(sessions / 's1')
    row = {k: v for k, v in printed[0].items() if k != 'crc32'}
    (cause,) = row['discovery']['effects']
    assert (cause['name'], cause['joints']) == ('joint_compliance', [2])
    (folder,), (other,) = [fit.parent for fit in out.glob('*/fit')], by_two.glob('s1-*')
    effects = json.loads((folder / 'discovery' / 'discovery.json').read_bytes())['effects']
    assert cause['size_mm'] == 1e3 * effects[0]['size_m'] > 0.1
    assert row == rows(by_two)[s1]
    for file in ('fit/fit.json', 'discovery/discovery.json', 'fit/apply/compensation.json'):
        assert (folder / file).read_bytes() == (other / file).read_bytes()
    before = (out / batch.ROWS).read_bytes()
    (out / batch.PAGE).unlink()
    monkeypatch.setattr(batch, 'local_pool', ThreadPoolExecutor)
    said = remaster('batch', s1, out.parent / 'empty', '--out', out).stdout
    assert '1 done, 1 error' in said
    assert (out / batch.ROWS).read_bytes() == before, 'made again'
    assert 's1' in (out / batch.PAGE).read_text(encoding='utf-8')


def test_a_page_does_not_advise_what_was_done(tmp_path):
    fit = {
        'headline': 'The mean falls. But what is left has structure, which noise has not: other '
        'errors dominate; run "remaster discover".',
        'held_out_mm': {'before': 1.0, 'after': 0.5},
    }
    row = {'session': 's', 'status': 'done', 'fit': fit, 'discovery': {'headline': 'A cause.'}}
    over_all = {'lines': [], 'joints': []}
    write_batch_page(tmp_path / 'batch.html', [row], over_all)
    text = (tmp_path / 'batch.html').read_text(encoding='utf-8')
    assert 'other errors dominate.</td>' in text
    assert 'remaster discover' not in text


@pytest.mark.parametrize('file', ['fit.json', 'discovery.json', 'session.yaml', 'report.html'])
def test_a_folder_of_another_command_is_refused(file, sessions, tmp_path):
    (tmp_path / file).write_text('{}', encoding='utf-8')
    assert refusal('batch', sessions / 's1', '--out', tmp_path) == (
        f'error: {tmp_path}: holds {file}, not written by this command; name another folder\n'
    )
    assert [path.name for path in tmp_path.iterdir()] == [file]


def test_a_row_is_of_the_files_the_seed_and_the_baseline(sessions, tmp_path):
    shutil.copytree(sessions / 's1', tmp_path / 's1')

    def key(seed=0, baseline=''):
        return batch._job(tmp_path / 's1', tmp_path, seed, baseline).key

    keys = [key(), key(seed=1), key(baseline=str(tmp_path / 's1' / 'robot.urdf'))]
    table = tmp_path / 's1' / 'observations.csv'
    table.write_text(table.read_text(encoding='utf-8') + '\n', encoding='utf-8')
    keys.append(key())
    assert len(set(keys)) == 4


def test_copies_are_worked_on_once_and_each_has_its_name(sessions, by_one, tmp_path):
    """Also a session that was moved between two calls."""
    out, (*_, (_, printed)) = by_one
    s1, copy = str(sessions / 's1'), str(out.parent / 'copy')
    assert [row['session'] for row in printed][:2] == [s1, copy]
    assert len(list(out.glob('*/fit'))) == 1
    shutil.copytree(sessions / 's1', tmp_path / 'moved')
    again = ('batch', tmp_path / 'moved', '--out', out, '--workers', 1, '--json')
    before = (out / batch.ROWS).read_bytes()
    (moved,) = json.loads(remaster(*again).stdout)['rows']
    assert moved['session'] == str(tmp_path / 'moved')
    assert (out / batch.ROWS).read_bytes() == before
    # Against the correction of one session, made of each: another arm's, and its own.
    (baseline,) = out.glob('*/fit/apply/compensation.json')
    other, source = sessions / 's2', sessions / 's1'
    job = batch.Job('', str(other), '', 0, str(baseline))
    found = batch._of_check(job, read_session(other))
    assert found['verdict'] == 'unclear', 'offsets of half a degree lie between the two arms'
    assert [joint['joint'] for joint in found['joints']] == [f'joint_{i}' for i in range(1, 8)]
    with pytest.raises(InputError, match='is the session that the correction was made of'):
        batch._of_check(job, read_session(source))


def test_an_error_that_is_none_of_the_session_is_tried_again(sessions, by_one):
    out, printed = by_one
    job = batch._job((sessions / 's1').resolve(), out.resolve(), 0, '')
    for status, (row,) in printed[:2]:
        assert status == 1
        assert row['status'] == 'error'
        assert Path(job.out).name in row['error']
    found = read_journal(out / batch.ROWS).records
    assert len([row for row in found if row['key'] == job.key]) == 2, 'says the same twice'


STARTS = """
import sys, time
from remaster_ros.cli import batch, batch_workers
if __name__ == '__main__':
    pool = batch_workers.local_pool(1)
    print(pool.submit(batch.os.getpid).result(), flush=True)
    time.sleep(600)
"""


def test_workers_end_with_a_batch_that_is_killed(tmp_path):
    (tmp_path / 'starts.py').write_text(STARTS, encoding='utf-8')
    command = [sys.executable, str(tmp_path / 'starts.py')]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as started:
        assert started.stdout is not None
        worker = int(started.stdout.readline())
        started.kill()
    for _ in range(300):
        try:
            os.kill(worker, 0)
        except ProcessLookupError:
            return
        # One that has ended and whom nobody asks for its status is still there by name.
        if Path(f'/proc/{worker}/stat').read_text(encoding='utf-8').split()[2] == 'Z':
            return
        time.sleep(0.1)
    os.kill(worker, signal.SIGKILL)
    pytest.fail('a worker stays')


def worked_off(jobs, work, workers=2):
    """Work jobs off, two of them under way at a time; return the rows, and how many pools."""
    done, made = {}, []

    def make() -> Executor:
        made.append(batch_workers.local_pool(workers))
        assert isinstance(made[-1], ProcessPoolExecutor)
        return made[-1]

    batch_workers.work_off(jobs, work, make, 2, lambda job, row: done.update({job: row}))
    return done, len(made)


def test_what_was_under_way_when_a_worker_was_killed_is_done_again(tmp_path):
    jobs = [(number, str(tmp_path / 'mark')) for number in range(4)]
    done, pools = worked_off(jobs, batch_jobs.dies_once)
    assert {job[0]: row['square'] for job, row in done.items()} == {n: n * n for n in range(4)}
    assert pools == 2


def test_a_session_that_kills_its_worker_twice_has_that_in_its_row():
    done, _ = worked_off(list(range(4)), batch_jobs.always_dies, workers=1)
    assert done.pop(2)['status'] == 'killed'
    assert {job: row['square'] for job, row in done.items()} == {0: 0, 1: 1, 3: 9}


@pytest.mark.parametrize(
    ('address', 'insecure', 'refused'),
    [
        ('tcp://127.0.0.1:8786', False, False),
        ('127.0.0.1:8786', False, False),
        ('tcp://[::1]:8786', False, False),
        ('localhost:8786', False, False),
        ('tls://10.0.0.7:8786', False, False),
        ('tcp://10.0.0.7:8786', False, True),
        ('10.0.0.7:8786', False, True),
        ('tcp://localhost.example.org:8786', False, True),
        ('tcp://10.0.0.7:8786', True, False),
    ],
)
def test_a_scheduler_on_another_computer_takes_tls(address, insecure, refused):
    if not refused:
        batch_workers.refuse_open(address, insecure=insecure)
        return
    with pytest.raises(batch.InputError, match='without TLS'):
        batch_workers.refuse_open(address, insecure=insecure)


@pytest.fixture
def scheduler():
    """A scheduler whose two workers are threads of this process."""
    distributed = pytest.importorskip('distributed', reason='the extra `cluster` is not installed')
    cluster = distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, protocol='tcp', host='127.0.0.1',
        dashboard_address=None,
    )  # fmt: skip
    yield cluster
    cluster.close(timeout=60)


def test_a_scheduler_makes_the_same_rows(scheduler, sessions, by_two, tmp_path):
    given = (sessions / 's1', sessions / 'empty', '--quiet', '--out', tmp_path)
    remaster('batch', *given, '--scheduler', scheduler.scheduler_address)
    assert rows(tmp_path) == rows(by_two)


SCHEDULER = """
import distributed
cluster = distributed.LocalCluster(
    n_workers=2, threads_per_worker=1, processes=False, protocol='tcp', host='127.0.0.1',
    dashboard_address=None,
)
print(cluster.scheduler_address, flush=True)
input()
"""


def test_a_scheduler_that_ends_is_one_line():
    pytest.importorskip('distributed', reason='the extra `cluster` is not installed')
    command = [sys.executable, '-c', SCHEDULER]
    done = []

    def finished(seconds, _row):
        done.append(seconds)
        if len(done) == 2:
            scheduler.kill()

    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as scheduler:
        address = scheduler.stdout.readline().strip()
        jobs = [0.2 + 0.001 * i for i in range(50)]
        with (
            pytest.raises(batch.InputError, match='the scheduler has ended'),
            batch_workers.scheduled(address, insecure=False) as (executor, workers),
        ):
            batch_workers.work_off(jobs, time.sleep, lambda: executor, 2 * workers, finished)
    assert 2 <= len(done) < 50


def test_workers_of_another_version_are_refused(scheduler, monkeypatch):
    monkeypatch.setattr(batch_workers, '_version', other_version)
    with (
        pytest.raises(batch.InputError, match=r'has remaster_ros 0\.0\.1'),
        batch_workers.scheduled(scheduler.scheduler_address, insecure=False),
    ):
        pass


def other_version():
    return '0.0.1'


def made_row(name, offsets):
    joints = [
        {'joint': f'j{i}', 'mean_deg': value, 'std_deg': 0.01} for i, value in enumerate(offsets)
    ]
    return {'status': 'done', 'session': name, 'fit': {'robot': 'arm', 'joints': joints}}


def test_who_differs_and_which_joint_changes_along_the_sessions():
    """Twelve sessions: one has another j0, j1 has another zero from the seventh on."""
    seed = 3
    print('seed', seed)
    offsets = 0.02 * np.random.default_rng(seed).standard_normal((12, 3))
    offsets[4, 0] += 0.5
    offsets[6:, 1] += 0.3
    found = summary_of([made_row(f's{i}', row) for i, row in enumerate(offsets.tolist())])
    j0, j1, j2 = found['joints']
    assert j0['differs'] == ['s4']
    assert j1['since'] == 's6'
    assert j1['change_deg'] == pytest.approx(0.3, abs=0.05)
    assert (j0['since'], j2['since'], j2['differs']) == ('', '', [])
    assert json.dumps(found)


def test_what_a_slide_is_off_by_is_summed_up_in_mm():
    offsets = 0.02 * np.random.default_rng(3).standard_normal((12, 3))
    offsets[6:, 1] += 0.3
    rows = [made_row(f's{i}', row) for i, row in enumerate(offsets.tolist())]
    for row in rows:
        joint = row['fit']['joints'][1]
        joint |= {'unit': 'mm', 'mean_mm': joint['mean_deg'], 'std_mm': 0.01}
        joint |= {'mean_deg': None, 'std_deg': None}
    found = summary_of(rows)
    j0, j1, _ = found['joints']
    assert (j0['unit'], j1['unit']) == ('deg', 'mm')
    assert (j1['median_deg'], j1['change_deg']) == (None, None)
    assert j1['change_mm'] == pytest.approx(0.3, abs=0.05)
    (line,) = (line for line in found['lines'] if 'j1: changed by' in line)
    assert ' mm along the sessions, since s6' in line


@pytest.mark.parametrize('arms', [5, 12])
def test_arms_that_scatter_are_not_said_to_differ(arms):
    """100 pages, any named on 1 % of them: more than 6 by chance once in 14,000."""
    seed = 11
    print('seed', seed)
    rng = np.random.default_rng(seed)
    named = 0
    for _ in range(100):
        offsets = 0.3 * rng.standard_normal((arms, 6))
        found = summary_of([made_row(f's{i}', row) for i, row in enumerate(offsets.tolist())])
        named += any(joint['differs'] for joint in found['joints'])
    assert named <= 6


def test_two_that_differ_do_not_hide_each_other():
    offsets = 0.3 * np.random.default_rng(2).standard_normal((12, 1))
    offsets[[3, 8]] += 6.0
    found = summary_of([made_row(f's{i}', row) for i, row in enumerate(offsets.tolist())])
    assert found['joints'][0]['differs'] == ['s3', 's8']
