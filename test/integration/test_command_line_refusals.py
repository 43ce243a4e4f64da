# SPDX-License-Identifier: Apache-2.0
"""Bad input: each one clear line on stderr and its exit status, from real processes."""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from rigs.command_line import refusal, remaster, run

# Permissions do not bind root; without CAP_DAC_OVERRIDE (1) in what a process may inherit
# (PR_CAPBSET_DROP, 24) they do from its next exec on.
CANNOT = 77
OBEYING = (
    sys.executable,
    '-c',
    'import ctypes, os, sys\n'
    'if os.geteuid() == 0 and ctypes.CDLL(None).prctl(24, 1, 0, 0, 0) != 0:\n'
    f'    sys.exit({CANNOT})\n'
    'os.execv(sys.argv[1], sys.argv[1:])\n',
)


@pytest.fixture(scope='module')
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A good session, with its fit in `fit` beside it."""
    folder = tmp_path_factory.mktemp('good')
    size = ('--poses', 16, '--validation', 8)
    remaster('simulate', folder / 'session', *size)
    remaster('fit', folder / 'session', '--out', folder / 'fit', '--no-figures')
    return folder


@pytest.fixture
def session(good: Path, tmp_path: Path) -> Path:
    """A copy of the good session to spoil."""
    return Path(shutil.copytree(good / 'session', tmp_path / 'session'))


def edit(path: Path, change: Callable[[str], str]) -> None:
    before = path.read_text(encoding='utf-8')
    after = change(before)
    assert after != before
    path.write_text(after, encoding='utf-8')


def edit_row(session: Path, line: int, column: str, cell: str) -> None:
    """Replace one cell of observations.csv; the header is line 1."""
    path = session / 'observations.csv'
    lines = path.read_text(encoding='utf-8').splitlines()
    cells = lines[line - 1].split(',')
    cells[lines[0].split(',').index(column)] = cell
    lines[line - 1] = ','.join(cells)
    path.write_text('\n'.join(lines) + '\n', encoding='utf-8')


def fit(session: Path) -> tuple[object, ...]:
    return ('fit', session, '--out', session.parent / 'out', '--no-figures')


@pytest.mark.parametrize('verb', ['fit', 'accuracy'])
def test_no_such_session(verb: str, good: Path, tmp_path: Path) -> None:
    options = {
        'fit': ('--out', tmp_path / 'out'),
        'accuracy': ('--offsets', good / 'fit/fit.json'),
    }
    line = refusal(verb, tmp_path / 'nowhere', *options[verb])
    assert 'nowhere: no such session folder' in line


@pytest.mark.parametrize('name', ['session.yaml', 'observations.csv', 'robot.urdf'])
def test_a_missing_file(name: str, session: Path) -> None:
    (session / name).unlink()
    assert f'{name}: no such file' in refusal(*fit(session))


def test_a_row_a_column_short(session: Path) -> None:
    path = session / 'observations.csv'
    edit(path, lambda text: re.sub(r'^(5,.*),[^,]*$', r'\1', text, flags=re.MULTILINE))
    line = refusal(*fit(session))
    assert 'observations.csv, line 7: 28 columns instead of the 29 of the header' in line


def test_a_missing_column(session: Path) -> None:
    edit(session / 'observations.csv', lambda text: text.replace(',y_m,', ',count,', 1))
    line = refusal(*fit(session))
    assert 'observations.csv, line 1: column y_m is missing' in line


@pytest.mark.parametrize('cell', ['nan', 'inf', '', '0,1'])
def test_a_number_that_is_none(cell: str, session: Path) -> None:
    edit_row(session, 4, 'y_m', cell)
    line = refusal(*fit(session))
    where = 'line 4: ' if ',' in cell else f'line 4, column y_m: {cell!r} is not'
    assert f'observations.csv, {where}' in line


def test_an_unknown_sensor(session: Path) -> None:
    edit_row(session, 3, 'sensor', 'sonar')
    line = refusal(*fit(session))
    assert "line 3, column sensor: 'sonar' is not among the sensors" in line
    assert '(mocap, tracker)' in line


def test_joints_that_do_not_match_the_urdf(session: Path) -> None:
    edit(session / 'session.yaml', lambda text: text.replace('tip_link: tool', 'tip_link: link_6'))
    line = refusal(*fit(session))
    assert 'observations.csv, line 1: 7 columns q…_rad for the 6 joints of the robot' in line


def test_a_position_outside_the_limits(session: Path) -> None:
    edit_row(session, 2, 'q1_rad', '170')
    line = refusal(*fit(session))
    assert "line 2, column q1_rad: '170' rad is more than 1 degree outside the limits" in line


def test_a_prismatic_joint(session: Path) -> None:
    urdf = session / 'robot.urdf'
    edit(urdf, lambda text: text.replace('joint_4" type="revolute', 'joint_4" type="prismatic'))
    line = refusal(*fit(session))
    assert 'observations.csv, line 1: column q4_rad' in line
    assert 'slides' in line
    assert 'q4_m' in line


def test_a_urdf_that_is_none(session: Path) -> None:
    (session / 'robot.urdf').write_text('solid robot', encoding='utf-8')
    assert 'robot.urdf: ' in refusal(*fit(session))


def test_an_empty_session(session: Path) -> None:
    edit(session / 'observations.csv', lambda text: text.splitlines(keepends=True)[0])
    assert 'no observations below the header' in refusal(*fit(session))


@pytest.mark.parametrize(
    ('text', 'words'),
    [
        ('markers: {nose: {position_m: [0, 0, 0], std_m: 1e-3}}', "prior on marker 'nose'"),
        ('joint_offsets: {joint_1: {mean_deg: 0.1, std_deg: 0}}', 'joint_1.std_deg is 0'),
        ('joint_offsets: [', 'priors.yaml'),
    ],
)
def test_priors_that_cannot_be(text: str, words: str, good: Path, tmp_path: Path) -> None:
    priors = tmp_path / 'priors.yaml'
    priors.write_text(text)
    out = tmp_path / 'out'
    assert words in refusal('fit', good / 'session', '--out', out, '--prior', priors)
    assert not (out / 'fit.json').exists()


def test_data_that_allow_no_answer_end_with_1(session: Path) -> None:
    """Two poses: not bad input, but no registration either."""

    def first_two_poses(text: str) -> str:
        header, *rows = text.splitlines(keepends=True)
        return ''.join([header, *(row for row in rows if row.split(',')[1] in '01')])

    edit(session / 'observations.csv', first_two_poses)
    line = refusal(*fit(session), status=1)
    assert "sensor 'mocap' saw 2 poses to fit; at least 3 are needed" in line


def test_only_validation_rows_end_with_1(session: Path) -> None:
    edit(session / 'observations.csv', lambda text: text.replace(',optimization,', ',validation,'))
    assert 'no optimization rows' in refusal(*fit(session), status=1)


def test_no_folder_below_a_file(session: Path, tmp_path: Path) -> None:
    out = tmp_path / 'file' / 'out'
    (tmp_path / 'file').write_text('', encoding='utf-8')
    assert f'{out}: cannot be written' in refusal('fit', session, '--out', out)
    assert f'{out}: cannot be written' in refusal('simulate', out, '--poses', 8)


def test_a_read_only_folder(good: Path, session: Path, tmp_path: Path) -> None:
    if run('--version', through=OBEYING).returncode == CANNOT:
        pytest.skip('running as root, whom permissions do not bind, with no way to change that')
    folder = tmp_path / 'read_only'
    folder.mkdir(mode=0o555)
    offsets = ('--offsets', good / 'fit/fit.json')
    for out, args in (
        (folder / 'new', ('fit', session, '--out', folder / 'new')),
        (folder / 'a.json', ('accuracy', session, *offsets, '--out', folder / 'a.json')),
    ):
        line = refusal(*args, through=OBEYING)
        assert f'{out}: cannot be written (Permission denied)' in line
    assert list(folder.iterdir()) == []


def test_a_session_is_never_overwritten(session: Path) -> None:
    line = refusal('simulate', session, '--poses', 8)
    assert 'already holds files' in line


@pytest.mark.parametrize(
    ('args', 'words'),
    [
        (('simulate', 'out', '--poses', 0), '--poses: 0 is less than 1'),
        (('simulate', 'out', '--noise-mm', 'nan'), '--noise-mm: nan is not a finite number'),
        (('simulate', 'out', '--pose-noise-mm', '-0.1'), '--pose-noise-mm: -0.1 is less than 0'),
        (('simulate', 'out', '--outliers', 1.5), '--outliers: 1.5 is more than 1'),
        (('simulate', 'out', '--seed', -1), '--seed: -1 is less than 0'),
        (('simulate', 'out', '--sensors', 'sonar'), "no sensor 'sonar' in the cell"),
        (('simulate', 'out', '--robot', 'nix'), 'nix: no such file; --robot takes a URDF file'),
        (('simulate', 'out', '--cell', 'nix'), 'nix.yaml: no such file; name a cell file'),
        (('simulate', 'out', '--tip-link', 'nix'), 'nix'),
        (('fit', 'session'), 'required: --out'),
        (('fit', 'session', '--out', 'o', '--chains', 1), '--chains: 1 is less than 2'),
        (('fit', 'session', '--out', 'o', '--precision', 3), '--precision: 3 is more than 0.1'),
        (('fit', 'session', '--out', 'o', '--sampler', 'slow'), "invalid choice: 'slow'"),
        (('fit', 'session', '--out', 'o', '--fast'), 'unrecognized arguments: --fast'),
        (('demo', '--rate', 'nan'), '--rate: nan is not a finite number'),
        (('replay', 'bag', '--rate', -1), '--rate: -1 is less than 0.01'),
        (('recalibrate',), "invalid choice: 'recalibrate'"),
    ],
)
def test_wrong_usage(args: tuple[object, ...], words: str) -> None:
    assert words in refusal(*args)


class TestOffsets:
    """`remaster accuracy` and what it takes for a fit.json."""

    def spoil(self, good: Path, tmp_path: Path, change: Callable[[dict], object]) -> Path:
        content = json.loads((good / 'fit/fit.json').read_text(encoding='utf-8'))
        change(content)
        path = tmp_path / 'fit.json'
        path.write_text(json.dumps(content), encoding='utf-8')
        return path

    def test_missing(self, session: Path) -> None:
        line = refusal('accuracy', session, '--offsets', session / 'fit.json')
        assert 'fit.json: no such file' in line

    def test_a_folder(self, good: Path, session: Path) -> None:
        line = refusal('accuracy', session, '--offsets', good / 'fit')
        assert 'not a regular file; give the fit.json' in line

    def test_no_json(self, session: Path) -> None:
        line = refusal('accuracy', session, '--offsets', session / 'session.yaml')
        assert 'give a fit.json of format remaster-fit/1' in line

    @pytest.mark.parametrize(
        ('change', 'words'),
        [
            (lambda fit: fit.update(format='other/1'), "format is 'other/1'"),
            (lambda fit: fit.pop('joint_offsets'), 'joint_offsets'),
            (lambda fit: fit['joint_offsets'][2].update(mean_deg='0.1'), r'mean_deg'),
            (
                lambda fit: fit['joint_offsets'][2].update(std_deg=-1),
                'std_deg is -1, not 0 to 360',
            ),
            (lambda fit: fit['joint_offsets'].pop(), 'use the fit of this robot'),
            (lambda fit: fit['joint_offsets'][2].update(joint='A3'), 'use the fit of this robot'),
        ],
    )
    def test_spoilt(
        self,
        change: Callable[[dict], object],
        words: str,
        good: Path,
        session: Path,
        tmp_path: Path,
    ) -> None:
        path = self.spoil(good, tmp_path, change)
        assert words in refusal('accuracy', session, '--offsets', path)

    def test_of_another_urdf_is_a_warning(self, good: Path, session: Path) -> None:
        edit(session / 'robot.urdf', lambda text: text.replace('0 0 0.102', '0 0 0.103', 1))
        args = ('accuracy', session, '--offsets', good / 'fit/fit.json')
        process = remaster(*args)
        assert process.stderr.count('\n') == 1
        assert process.stderr.startswith('WARNING: ')
        assert "fitted with another URDF than this session's" in process.stderr
        assert remaster(*args, '--quiet') == ('', '')


@pytest.fixture
def without_ros(tmp_path: Path) -> dict[str, str]:
    """Variables for a Python that finds no rclpy, whether one is installed or not."""
    folder = tmp_path / 'site'
    folder.mkdir()
    (folder / 'sitecustomize.py').write_text(
        'import sys\n'
        'from importlib.machinery import PathFinder\n'
        'class WithoutRos(PathFinder):\n'
        '    @classmethod\n'
        '    def find_spec(cls, name, path=None, target=None):\n'
        "        if name.split('.')[0] == 'rclpy':\n"
        '            return None\n'
        '        return super().find_spec(name, path, target)\n'
        'sys.meta_path[sys.meta_path.index(PathFinder)] = WithoutRos\n',
        encoding='utf-8',
    )
    root = Path(__file__).parents[2]
    return {'PYTHONPATH': os.pathsep.join((str(folder), str(root)))}


@pytest.mark.parametrize('args', [('demo',), ('replay', 'bag'), ('watch',)])
def test_without_ros_the_error_names_what_to_install(
    args: tuple[str, ...], without_ros: dict[str, str]
) -> None:
    line = refusal(*args, environment=without_ros)
    assert f'remaster {args[0]} needs ROS 2 Jazzy' in line
    assert "pip install '.[jazzy]'" in line


def test_without_ros_the_rest_works(
    good: Path, tmp_path: Path, without_ros: dict[str, str]
) -> None:
    options = ('--out', tmp_path / 'out', '--no-figures', '--quiet')
    printed = remaster('fit', good / 'session', *options, environment=without_ros)
    assert printed == ('', '')
