# SPDX-License-Identifier: Apache-2.0
"""Every command of README and docs: those without ROS are run, the others are parsed.

The pages are run one by one in a scratch folder, in the order of their commands. A file or folder
that a page takes for the reader's own (`my_session`, `points.csv`, …) is put there before it is
first read.
"""

from __future__ import annotations

import csv
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from foreign.tables import measured, text, write
from judges.documented_commands import (
    FENCE,
    ROOT,
    Command,
    commands,
    fault,
    hidden_commands,
    parser,
    reads,
    small,
)
from judges.documented_commands import PAGES as ALL
from worlds.moving_bags import CELL, held_out_standing, names_of, recorded, write_bag
from worlds.moving_world import MovingWorld, Recording
from worlds.simple_cells import four_markers, write_cell

from remaster_ros.cli.main import VERBS, main
from remaster_ros.session.records.reader import write_session

# Together a few seconds; the others are run by `make qualify`.
CHEAP = {
    'apply',
    'import',
    'quick-start-real-hardware',
}


@pytest.mark.parametrize('page', ALL, ids=lambda page: page.stem)
def test_every_command_can_be_given_as_it_stands(page: Path) -> None:
    faults = [(c.line, ' '.join(c.words), why) for c in commands(page) if (why := fault(c))]
    assert faults == []
    assert hidden_commands(page) == [], 'commands belong into blocks of bash or console'


def test_commands_of_every_kind_are_found_and_wrong_ones_refused() -> None:
    found = [command for page in ALL for command in commands(page)]
    assert {c.words[0] for c in found} >= {'remaster', 'ros2', 'make', 'pip', 'python'}
    assert sum(c.is_run for c in found) > 30
    for wrong in (
        'remaster fit s --out f --fast',
        'make dem',
        'pip install .[jazz]',
        'python benchmarks/no_such.py',
        'python -m remaster_ros.nodes recorder --ros-args -p sesion:=x',
        'ros2 service call /remaster/colect std_srvs/srv/Trigger',
        'ros2 launch remaster_ros real.launch.py cel:=x',
        'remastr fit',
    ):
        assert fault(Command('', 0, wrong.split(), '')), wrong


@pytest.mark.parametrize('page', ALL, ids=lambda page: page.stem)
def test_commands_within_sentences_have_verbs_and_options_that_exist(page: Path) -> None:
    for words in re.findall(r'`remaster ([^`]+)`', FENCE.sub('', page.read_text('utf-8'))):
        verb, *arguments = words.split()
        if verb in ('VERB', '…') or verb.startswith('-'):
            continue
        assert verb in VERBS, words
        options = {word for word in arguments if word.startswith('--')}
        assert options <= {*parser(verb)._option_string_actions}, words


def test_every_option_that_the_page_on_import_names_is_there() -> None:
    named = re.findall(r'`(--[a-z][a-z-]+)', (ROOT / 'docs/import.md').read_text('utf-8'))
    assert len(named) > 15
    assert {*named} <= {*parser('import')._option_string_actions}


@pytest.fixture(scope='module')
def readers_files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the files that the pages assume the reader to have."""
    folder = tmp_path_factory.mktemp('own')
    arm = measured(rows=24)
    names, degrees, mm = [f'P{i}' for i in range(24)], np.rad2deg(arm.q).T, 1e3 * arm.points.T
    joints = [f'A{i}' for i in range(1, 7)]
    for name in ('arm.urdf', 'robot.urdf', 'robot.urdf.xacro', 'my.urdf.xacro', 'ur.urdf.xacro'):
        (folder / name).write_text(arm.urdf, encoding='utf-8')
    write(folder, 'table.csv', text(['name', *joints, 'X', 'Y', 'Z'], [names, *degrees, *mm]))
    write(folder, 'points.csv', text(['name', 'X', 'Y', 'Z'], [names, *mm]))
    write(folder, 'joints.csv', text(['name', *joints], [names, *degrees]))
    return folder


def run(page: Path, readers_files: Path, here: Path, capsys: pytest.CaptureFixture[str]) -> int:
    """Run the commands of a page that can be run here; return how many."""
    (here / 'docs').symlink_to(ROOT / 'docs')
    count = 0
    for command in commands(page):
        if not command.is_run:
            continue
        for word in reads(command):
            supply(word, readers_files, here)
        capsys.readouterr()
        status = main(small(command))
        shown = capsys.readouterr().err
        place = f'{command.page}:{command.line}: {" ".join(command.words)}'
        if command.error:
            assert status in (1, 2), place
            # Figures may differ in the last digit.
            assert without_numbers(shown.splitlines()[-1]) == without_numbers(command.error), place
        else:
            assert status == 0, f'{place}\n{shown}'
        count += 1
    return count


def supply(word: str, readers_files: Path, here: Path) -> None:
    """Put a file or folder that a page reads and has not made into the scratch folder."""
    name, target = Path(word).parts[0], here / Path(word).parts[0]
    if target.exists() or word.startswith('-'):
        return
    if word == 'session/bag':
        moving_session(Path(name))
    elif name == 'my_bag':
        write_bag(target, *recording_with_stops())
        Path('arm.urdf').write_text(CELL.urdf_text, encoding='utf-8')
    elif (readers_files / name).exists():
        shutil.copy(readers_files / name, target)
    elif name in ('my_session', 'session', 'other_session', 's1', 's2', 'saggy'):
        # A cause so small that it has look-alikes, which `plan --separate` needs.
        options = '--poses 24 --validation 12 --effect joint_compliance@2:0.1 --quiet'
        # The second session is another one; the first has the same data by whatever name.
        seed = '5' if name in ('other_session', 's2') else '0'
        assert main(['simulate', name, '--seed', seed, *options.split()]) == 0
    elif name == 'my_fit':
        supply('my_session', readers_files, here)
        assert main(['fit', 'my_session', '--out', name, '--no-figures', '--quiet']) == 0
    elif name in ('causes', 'discovery.json'):
        supply('s1', readers_files, here)
        assert main(['discover', 's1', '--out', 'causes', '--no-figures', '--quiet']) == 0
        shutil.copy('causes/discovery.json', 'discovery.json')
        # The cell is of the same arm, also where the page has made one of another.
        (here / 'my_cell.yaml').unlink(missing_ok=True)
        supply('my_cell.yaml', readers_files, here)
    elif name == 'poses.csv':
        # The columns of a reader's own table, and the arm that it is of.
        size = '--sensors mocap --poses 24 --validation 0 --orientation-noise-deg 0.02 --on-tool'
        assert main(['simulate', 'made', *size.split(), '--quiet']) == 0
        shutil.move('made/robot.urdf', 'arm.urdf')
        rows = list(csv.reader(Path('made/observations.csv').read_text('utf-8').splitlines()))
        kept = [c for c in zip(*rows) if re.match('q[1-7]_|[xyz]_|orientation_', c[0])]
        write(Path(), name, text([c[0] for c in kept], [c[1:] for c in kept]))
    elif name == 'four_markers.yaml':
        four_markers(Path(name))
    elif name == 'my_cell.yaml':
        cell = (ROOT / 'config/cells/demo.yaml').read_text('utf-8')
        Path(name).write_text(cell.replace('../robots', str(ROOT / 'config/robots')), 'utf-8')


def recording_with_stops() -> tuple[MovingWorld, Recording]:
    """Return the recording of an arm that moves and stands in turn, and its world."""
    return recorded(5003, seconds=7.0, stops=True, joints_hz=125.0, camera_hz=60.0)


def moving_session(folder: Path) -> None:
    """Write a session of standstills with the bag of the motion between them, and its cell."""
    world, recording = recording_with_stops()
    write_session(folder, held_out_standing(world, recording))
    first, *further = names = names_of(world)
    bar = {
        'marker': first,
        'further_markers': {name: number for number, name in enumerate(further, 2)},
        'topic': 'bar/marker',
        'rough_position_m': [1.9, 0.0, 1.3],
    }
    markers = {name: place.tolist() for name, place in zip(names, world.nominal, strict=True)}
    write_cell(Path('my_cell.yaml'), markers=markers, sensors={'bar': bar}, aim_at='bar')
    topics = {f: f'/bar/marker/{f}' for f in further} | {first: '/bar/marker'}
    write_bag(folder / 'bag', world, recording, topics=topics)


def without_numbers(line: str) -> str:
    return re.sub(r'\d+(\.\d+)?', '#', line)


@pytest.mark.parametrize(
    'page',
    [
        pytest.param(p, marks=[] if p.stem in CHEAP else pytest.mark.qualify, id=p.stem)
        for p in ALL
        if any(c.is_run for c in commands(p))
    ],
)
def test_the_commands_of_a_page_work_one_after_the_other(
    page: Path,
    readers_files: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(page, readers_files, tmp_path, capsys) > 0
