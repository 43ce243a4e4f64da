"""The commands of docs/import.md are run as they stand there."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
from foreign_tables import measured, text, write

from remaster_ros.cli.main import build_parser, main
from remaster_ros.session.reader import read_session

PAGE = (Path(__file__).parents[3] / 'docs/import.md').read_text(encoding='utf-8')
COMMANDS = re.findall(r'^    remaster (.*)$', PAGE, re.M)


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Return a folder with the files that the page names, in which the commands are run."""
    arm = measured(rows=24)
    names, degrees = [f'P{i}' for i in range(24)], np.rad2deg(arm.q).T
    joints = [f'A{i}' for i in range(1, 7)]
    (tmp_path / 'arm.urdf').write_text(arm.urdf)
    columns = [names, *(1e3 * arm.points.T)]
    write(tmp_path, 'points.csv', text(['name', 'X', 'Y', 'Z'], columns))
    write(tmp_path, 'joints.csv', text(['name', *joints], [names, *degrees]))
    alone = text(['name', *joints, 'X', 'Y', 'Z'], [names, *degrees, *(1e3 * arm.points.T)])
    write(tmp_path, 'alone.csv', alone)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_commands_of_the_page_work(here):
    """The one for a bag is run in test_bags.py, with a bag."""
    assert len(COMMANDS) == 4
    run = [command for command in COMMANDS if 'my_bag' not in command]
    assert len(run) == 3
    for command in run:
        if command.startswith('import points.csv --urdf'):
            # The table that holds both; points.csv is the one of two.
            command = command.replace('points.csv', 'alone.csv')
        if command.startswith('import'):
            shutil.rmtree('my_session', ignore_errors=True)
        assert main(shlex.split(command)) == 0, command
    assert len(read_session('my_session').measurements) == 24
    assert Path('my_fit/report.html').exists()


def test_every_option_that_the_page_names_is_there():
    parser = build_parser('import')._subparsers._group_actions[0].choices['import']
    known = {*parser._option_string_actions}
    named = set(re.findall(r'(?<![\w-])--[a-z][a-z-]+', PAGE))
    assert len(named) > 15
    assert named <= known, named - known
