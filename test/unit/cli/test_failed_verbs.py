# SPDX-License-Identifier: Apache-2.0
"""A verb that fails leaves nothing behind, takes nothing away, and can be tried again."""

import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from rigs.command_line import refusal, remaster
from worlds.robot_descriptions import ROBOTS

from remaster_ros.cli import init
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.session.files import make_folder, undone_on_failure, write_atomically

XACRO = '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" '


def content(folder: Path) -> dict[str, bytes | None]:
    """Return every file and folder below a folder, with what the files hold."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in sorted(folder.rglob('*'))
    }


@pytest.fixture(scope='module')
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small session, a fit of it, a robot, a table, and a cell file."""
    folder = tmp_path_factory.mktemp('made')
    session = folder / 'session'
    remaster('simulate', session, '--poses', 14, '--validation', 6, '--quiet')
    fit = ('fit', session, '--out', folder / 'fit', '--no-figures', '--quiet')
    remaster(*fit, '--draws', 100, '--chains', 2)
    (folder / 'arm.urdf').write_text(ROBOTS['irb120']().urdf)
    (folder / 'arm.urdf.xacro').write_text(ROBOTS['irb120']().urdf.replace('<robot ', XACRO, 1))
    chain = SerialChain.from_urdf(ROBOTS['irb120']().urdf, 'base_link', 'link_6')
    q = np.random.default_rng(3).uniform(-60, 60, (20, 6))
    rows = np.hstack((q, 1e3 * chain.forward(np.deg2rad(q))[:, :3, 3]))
    lines = [';'.join(f'{value:.4f}' for value in row) for row in rows]
    (folder / 'table.csv').write_text('A1;A2;A3;A4;A5;A6;X;Y;Z\n' + '\n'.join(lines) + '\n')
    return folder


VERBS: dict[str, Callable[[Path, Path], list[object]]] = {
    'init': lambda made, out: [made / 'arm.urdf', '--out', out / 'cell.yaml', '--no-plan'],
    'init of a xacro': lambda made, out: [
        *(made / 'arm.urdf.xacro', '--out', out / 'deep/cell.yaml', '--no-plan')
    ],
    'import': lambda made, out: [
        *(made / 'table.csv', '--urdf', made / 'arm.urdf', '--out', out / 'session'),
        '--unchecked',
    ],
    'import of a session': lambda made, out: [
        *(made / 'session', '--out', out / 'a/b', '--unchecked')
    ],
    'simulate': lambda made, out: [out / 'session', '--poses', 4, '--validation', 2],
    'plan': lambda made, out: [
        *('demo', '--poses', 8, '--validation', 1, '--reference-every', 0),
        *('--out', out / 'new/plan.html'),
    ],
    'fit': lambda made, out: [
        *(made / 'session', '--out', out / 'fit', '--no-figures'),
        *('--draws', 100, '--chains', 2),
    ],
    'report': lambda made, out: [
        *(made / 'session', made / 'fit', '--out', out / 'new/page', '--no-figures')
    ],
    'export': lambda made, out: [
        *(made / 'fit/apply/compensation.json', '--to', 'json', '--out', out / 'new/tables')
    ],
    'accuracy': lambda made, out: [
        *(made / 'session', '--offsets', made / 'fit/fit.json', '--out', out / 'new/metrics.json')
    ],
}


@pytest.fixture(autouse=True)
def few_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    """What `init` proposes is of no concern here."""
    monkeypatch.setattr(init, 'COMPARED', 4)
    monkeypatch.setattr(init, 'TRIED', 40)


@pytest.fixture
def full_disk(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Let a given number of files be put in place; the next finds no space."""
    room, replace = [-1], os.replace

    def counting(source: str, target: str) -> None:
        if room[0] == 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(target))
        room[0] -= 1
        replace(source, target)

    monkeypatch.setattr(os, 'replace', counting)

    def only(files: int) -> None:
        room[0] = files

    return only


@pytest.mark.parametrize('verb', VERBS)
def test_a_disk_that_is_full_leaves_nothing_and_the_next_try_works(
    verb: str, made: Path, tmp_path: Path, full_disk: Callable[[int], None]
) -> None:
    """After the first file, and at the last one."""
    (tmp_path / 'mine.txt').write_text('was here before\n')
    arguments = [verb.split()[0], *VERBS[verb](made, tmp_path), '--quiet']
    before = content(tmp_path)
    full_disk(0)
    assert 'No space left on device' in refusal(*arguments)
    assert content(tmp_path) == before
    full_disk(-1)
    remaster(*arguments)
    files = sum(value is not None for value in content(tmp_path).values()) - 1
    assert files >= 1
    if files == 1:
        return
    again = tmp_path / 'again'
    again.mkdir()
    arguments = [verb.split()[0], *VERBS[verb](made, again), '--quiet']
    full_disk(files - 1)
    refusal(*arguments)
    assert content(again) == {}
    full_disk(-1)
    remaster(*arguments)


def test_an_init_that_was_refused_does_not_block_the_next(tmp_path: Path) -> None:
    """The URDF that the xacro was made into lay there, and "with other content" was the answer."""
    robot, cell = tmp_path / 'arm.urdf.xacro', tmp_path / 'cell.yaml'
    good = ROBOTS['irb120']().urdf.replace('<robot ', XACRO, 1)
    bad = good.replace('type="revolute"', 'type="fixed"', 4)
    assert bad != good
    robot.write_text(bad)
    remaster('init', robot, '--out', cell, '--no-plan', status=2)
    assert [path.name for path in tmp_path.iterdir()] == [robot.name]
    robot.write_text(good)
    remaster('init', robot, '--out', cell, '--no-plan', '--quiet')
    # Where the URDF is not init's own, it stays; what is told to do then works.
    cell.unlink()
    robot.write_text(good.replace('<link', '<!-- changed --><link', 1))
    said = refusal('init', robot, '--out', cell, '--no-plan')
    assert 'another folder with --out, such as new/cell.yaml' in said
    remaster('init', robot, '--out', tmp_path / 'new/cell.yaml', '--no-plan', '--quiet')


@pytest.mark.parametrize('verb', ['fit', 'discover', 'report'])
def test_data_that_allow_no_answer_leave_no_folder(verb: str, made: Path, tmp_path: Path) -> None:
    session, out = shutil.copytree(made / 'session', tmp_path / 'session'), tmp_path / 'a/b'
    rows = (session / 'observations.csv').read_text().splitlines(keepends=True)
    (session / 'observations.csv').write_text(''.join(rows[:5]))
    before = content(tmp_path)
    remaster(verb, session, '--out', out, status=1)
    assert content(tmp_path) == before


def test_what_others_put_there_meanwhile_stays(tmp_path: Path) -> None:
    out = tmp_path / 'new/out'

    def interrupted() -> None:
        make_folder(out)
        write_atomically(out / 'ours.json', '{}')
        (tmp_path / 'new/theirs.txt').write_text('theirs')
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), undone_on_failure():
        interrupted()
    assert content(tmp_path) == {'new': None, 'new/theirs.txt': b'theirs'}
