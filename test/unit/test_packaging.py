# SPDX-License-Identifier: Apache-2.0
"""What is declared (setup.py, package.xml, constraints, launch files, docs) is what is there."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from remaster_ros.requirements import FROM_PIP

ROOT = Path(__file__).parents[2]
# The contract of design.md.
EXECUTABLES = {
    'pose_planner',
    'robot_bridge',
    'optitrack_markers',
    'laser_tracker_markers',
    'recorder',
    'optimizer',
    'replay',
    'fake_robot',
    'fake_optitrack',
    'fake_laser_tracker',
    'demo',
}
# Modules whose distribution has another name.
DISTRIBUTION = {
    'yaml': 'pyyaml',
    'markupsafe': 'jinja2',
    'zstandard': 'mcap',
    'lz4': 'mcap',
    'collada': 'pycollada',
    'coal': 'pin',
    'hppfcl': 'pin',
    'dateutil': 'python-dateutil',
}
# Brought by rclpy itself, as wheel and as Debian package.
WITH_RCLPY = {'rcl_interfaces', 'action_msgs'}


@pytest.fixture
def setup_arguments(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    setuptools = pytest.importorskip('setuptools', reason='needs setuptools, as pip does')
    found: dict[str, Any] = {}
    monkeypatch.setattr(setuptools, 'setup', lambda **arguments: found.update(arguments))
    monkeypatch.chdir(ROOT)
    runpy.run_path(str(ROOT / 'setup.py'))
    return found


def normal(name: str) -> str:
    """Return the distribution of a requirement, as pip compares names."""
    return re.sub(r'[-_.]+', '-', re.split(r'[<>=~!\[; ]', name)[0]).lower()


def imported(folder: Path) -> set[str]:
    """Return the top-level modules that the code in a folder imports, but not from the library."""
    names = set()
    for path in folder.rglob('*.py'):
        for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
            if isinstance(node, ast.Import):
                names |= {alias.name.split('.')[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
                names.add(node.module.split('.')[0])
    return names - sys.stdlib_module_names - {'remaster_ros'}


def pins(name: str) -> dict[str, str]:
    lines = (ROOT / name).read_text(encoding='utf-8').splitlines()
    lines = [line for line in lines if line and not line.startswith('#')]
    return {normal(line): line for line in lines}


def test_every_python_file_names_its_licence_at_the_top() -> None:
    """As SPDX, in the first line or behind that of the interpreter; the licence is LICENSE's."""
    licence = ElementTree.parse(ROOT / 'package.xml').getroot().findtext('license')
    text = (ROOT / 'LICENSE').read_text(encoding='utf-8')
    assert re.search(r'Apache License\s+Version 2\.0', text)
    assert licence == 'Apache-2.0'
    folders = ('remaster_ros', 'test', 'docs', 'benchmarks', 'launch')
    paths = [ROOT / 'setup.py', *(ROOT / 'scripts').glob('[a-z]*')]
    paths += [path for folder in folders for path in (ROOT / folder).rglob('*.py')]
    paths = [path for path in paths if ROOT / 'remaster_ros/discovery' not in path.parents]
    assert len(paths) > 500
    without = [
        str(path.relative_to(ROOT))
        for path in paths
        if f'# SPDX-License-Identifier: {licence}'
        not in path.read_text(encoding='utf-8').splitlines()[:2]
    ]
    assert without == []


def test_the_version_is_the_same_everywhere(setup_arguments: dict[str, Any]) -> None:
    version = setup_arguments['version']
    assert ElementTree.parse(ROOT / 'package.xml').getroot().findtext('version') == version
    assert importlib.import_module('remaster_ros').__version__ == version
    heads = re.findall(r'^(\d+\.\d+\.\d+)', (ROOT / 'CHANGELOG.rst').read_text(), re.MULTILINE)
    assert heads[0] == version


def test_executables_are_those_of_the_contract(setup_arguments: dict[str, Any]) -> None:
    installed = dict(setup_arguments['data_files'])['lib/remaster_ros']
    assert {Path(path).name for path in installed} >= EXECUTABLES
    for path in installed:
        assert (ROOT / path).stat().st_mode & 0o111 == 0o111, f'{path} is not executable'
        assert (ROOT / path).read_text().startswith('#!/usr/bin/env python3\n')
    assert [
        line.split(' = ')[0] for line in setup_arguments['entry_points']['console_scripts']
    ] == ['remaster']


def test_every_configuration_file_is_installed_twice(setup_arguments: dict[str, Any]) -> None:
    """Under share/ for ROS users, in the package for those without."""
    there = {str(path.relative_to(ROOT)) for path in ROOT.glob('config/**/*') if path.is_file()}
    shared = {
        path
        for folder, paths in setup_arguments['data_files']
        for path in paths
        if 'config' in folder
    }
    patterns = setup_arguments['package_data']['remaster_ros.config']
    packaged = {
        str(path.relative_to(ROOT)) for p in patterns for path in (ROOT / 'config').glob(p)
    }
    assert shared == there
    assert packaged == there


def test_every_import_is_declared(setup_arguments: dict[str, Any]) -> None:
    declared = {normal(line) for line in setup_arguments['install_requires']}
    ros = {
        normal(line).removeprefix('ros-jazzy-')
        for line in setup_arguments['extras_require']['jazzy']
    }
    extras = setup_arguments['extras_require']
    further = (line for name in ('pdf', 'cluster') for line in extras[name])
    optional = {normal(line) for line in further}
    root = ElementTree.parse(ROOT / 'package.xml').getroot()
    depends = {element.text for element in root.findall('exec_depend')}
    # The launch files alone need these, which come with ROS and not with pip.
    launch = {'launch', 'launch_ros'}
    assert 'ros2launch' in depends
    for module in imported(ROOT / 'remaster_ros') - WITH_RCLPY - launch:
        name = normal(DISTRIBUTION.get(module, module))
        assert name in declared | ros | optional, f'{module} is imported but not required'
        if name in ros:
            assert module in depends, f'{module} is missing in package.xml'


def test_a_user_installs_nothing_that_only_tests_need(setup_arguments: dict[str, Any]) -> None:
    used = {normal(DISTRIBUTION.get(m, m)) for m in imported(ROOT / 'remaster_ros')}
    required = {normal(line) for line in setup_arguments['install_requires']}
    # Of plotly the script is served, by importlib.resources.
    server = (ROOT / 'remaster_ros/reports/live_server.py').read_text(encoding='utf-8')
    assert "files('plotly')" in server
    assert required - {'plotly'} <= used
    extras = setup_arguments['extras_require']
    for name in ('test', 'qualify', 'bench', 'check', 'docs'):
        assert required.isdisjoint(map(normal, extras[name])), name


def test_package_xml_names_every_requirement_or_a_program_does_when_it_starts(
    setup_arguments: dict[str, Any],
) -> None:
    root = ElementTree.parse(ROOT / 'package.xml').getroot()
    depends = {
        normal(element.text.removeprefix('python3-').removesuffix('-pip'))
        for element in root.iter('exec_depend')
        if element.text
    }
    known = {
        'pyyaml': 'yaml',
        'pycollada': 'collada',
        'pin': 'coal',
        'python-dateutil': 'dateutil',
    }
    required = {normal(line) for line in setup_arguments['install_requires']}
    by_rosdep = {name for name in required if known.get(name, name) in depends}
    from_pip = {normal(name) for name in FROM_PIP}
    # A node without it says so only where it is asked for, by `client: natnetclient`.
    assert by_rosdep | from_pip | {'natnetclient'} == required
    assert from_pip & by_rosdep == {'rosbags', 'trimesh'}, 'those whose keys call pip'


def test_the_package_is_described_where_pip_and_ros_look(setup_arguments: dict[str, Any]) -> None:
    root = ElementTree.parse(ROOT / 'package.xml').getroot()
    urls = {element.get('type'): element.text for element in root.findall('url')}
    projects = setup_arguments['project_urls']
    assert urls['website'] == setup_arguments['url']
    assert (urls['repository'], urls['bugtracker']) == (projects['Source'], projects['Issues'])
    assert setup_arguments['keywords']
    classifiers = setup_arguments['classifiers']
    assert 'License :: OSI Approved :: Apache Software License' in classifiers
    assert root.findtext('license') == 'Apache-2.0'
    versions = [c.rpartition(' ')[2] for c in classifiers if ':: 3.' in c]
    supported = re.search(
        r'\((\d+), (\d+)\) <= .* <= \((\d+), (\d+)\)', (ROOT / 'tools/make-venv').read_text()
    )
    assert supported is not None
    first, last = int(supported[2]), int(supported[4])
    assert versions == [f'3.{minor}' for minor in range(first, last + 1)]


@pytest.mark.parametrize('program', ['remaster_ros.cli.main', 'remaster_ros.nodes'])
def test_a_program_without_a_requirement_says_so_in_one_line(tmp_path: Path, program: str) -> None:
    (tmp_path / 'sitecustomize.py').write_text(BLOCKER.format(modules={'msgspec', 'eaik'}))
    path = os.pathsep.join([str(tmp_path), str(ROOT), os.environ.get('PYTHONPATH', '')])
    done = subprocess.run(
        [sys.executable, '-m', program, 'watch'],
        env={**os.environ, 'PYTHONPATH': path},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 2
    assert done.stdout == ''
    assert done.stderr.count('\n') == 1
    assert done.stderr.startswith('error: remaster_ros needs EAIK, msgspec, ')
    assert done.stderr.endswith(' -m pip install EAIK msgspec\n')


BLOCKER = """
import sys
from importlib.machinery import PathFinder

class Without(PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return None if name.split('.')[0] in {modules!r} else super().find_spec(name, path, target)

sys.meta_path[sys.meta_path.index(PathFinder)] = Without
"""


def collected(modules: set[str], folder: Path) -> subprocess.CompletedProcess[str]:
    """Collect all tests in a Python that has these modules not."""
    (folder / 'blocker.py').write_text(BLOCKER.format(modules=modules), encoding='utf-8')
    path = os.pathsep.join([str(folder), str(ROOT), os.environ.get('PYTHONPATH', '')])
    plugins = ['-p', 'blocker', '-p', 'pytest_timeout', '-p', '_hypothesis_pytestplugin']
    return subprocess.run(
        [sys.executable, '-m', 'pytest', *plugins, '-q', '--collect-only', str(ROOT / 'test')],
        env={**os.environ, 'PYTHONPATH': path, 'PYTEST_DISABLE_PLUGIN_AUTOLOAD': '1'},
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=250,
        check=False,
    )


@pytest.mark.qualify
def test_without_the_judges_the_other_tests_are_collected(tmp_path: Path) -> None:
    """Another's program that judges is not there on every machine; it must not stop the rest."""
    judges = {'pinocchio', 'mcap_ros2', 'NatNetClient', 'natnet', 'CESAPI'}
    done = collected(judges, tmp_path)
    for judge in judges:
        assert f"No module named '{judge}" not in done.stdout
    assert 'needs the judge: pip install pin' in done.stdout
    assert 'test_robots.py::test_names_masses_and_limits' in done.stdout


def test_without_a_requirement_one_line_says_how_to_get_it(tmp_path: Path) -> None:
    done = collected({'msgspec', 'eaik'}, tmp_path)
    assert done.returncode not in (0, 5), 'colcon takes 5, no tests, for good'
    line = '-m pip install EAIK msgspec'
    assert line in done.stdout + done.stderr
    assert 'Traceback' not in done.stdout + done.stderr


def test_every_requirement_is_pinned_exactly(setup_arguments: dict[str, Any]) -> None:
    wheels, system = pins('constraints.txt'), pins('constraints-ros.txt')
    for line in wheels.values():
        assert re.fullmatch(r'[a-z0-9-]+==[0-9a-z.]+', line), line
    extras = setup_arguments['extras_require']
    for line in (
        *setup_arguments['install_requires'],
        *(r for name in extras for r in extras[name]),
    ):
        assert normal(line) in wheels, f'constraints.txt has no {line}'
    # Where both have an exact version, only what NumPy 1 or launch_testing ask for may differ.
    differing = {n for n in wheels.keys() & system if '==' in system[n] and wheels[n] != system[n]}
    numpy_2 = {'arviz-stats', 'pin', 'eigenpy', *(n for n in wheels if n.startswith('cmeel-'))}
    assert differing <= numpy_2 | {'pytest'}


@pytest.mark.parametrize('name', ['parameters', 'command_line'])
def test_pages_from_the_code_are_up_to_date(name: str) -> None:
    if name == 'parameters':
        pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')
    path = ROOT / 'docs' / f'make_{name}.py'
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.PAGE.read_text(encoding='utf-8') == module.page(), 'run: make docs'


def test_every_page_is_in_the_table_of_contents() -> None:
    pages = {page.stem for page in (ROOT / 'docs').glob('*.md')} - {'index'}
    blocks = re.findall(
        r'```{toctree}\n(.*?)```', (ROOT / 'docs/index.md').read_text('utf-8'), re.S
    )
    listed = [line for block in blocks for line in block.splitlines() if re.match(r'[a-z]', line)]
    assert sorted(listed) == sorted(pages)


def test_links_in_the_pages_lead_somewhere() -> None:
    for page in (ROOT / 'README.md', *(ROOT / 'docs').glob('*.md')):
        for target in re.findall(r'\]\(([^)#]+)', page.read_text(encoding='utf-8')):
            if '://' not in target:
                assert (page.parent / target).exists(), f'{page.name}: {target}'
