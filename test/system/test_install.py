# SPDX-License-Identifier: Apache-2.0
"""Installed by pip and by colcon: what `ros2 run` would find is there, starts, and finds config/.

There is no `ros2` among the wheels, so its part is played by hand: look the package up in the
ament index, then execute ``lib/<package>/<executable>``.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from rigs.ros_rig import domains

pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')
pytestmark = [pytest.mark.ros, pytest.mark.slow]

ROOT = Path(__file__).parents[2]
EXECUTABLES = sorted(path.name for path in (ROOT / 'scripts').iterdir() if path.is_file())
PARTS = (
    'setup.py',
    'setup.cfg',
    'package.xml',
    'README.md',
    'LICENSE',
    'pytest.ini',
    'config',
    'launch',
    'remaster_ros',
    'resource',
    'scripts',
)
ASK = """
import json
from ament_index_python.packages import get_package_prefix, get_package_share_directory
import remaster_ros
from remaster_ros.session.cells.workcell import config_path, read_cell
read_cell('demo')
print(json.dumps({
    'prefix': get_package_prefix('remaster_ros'),
    'share': get_package_share_directory('remaster_ros'),
    'package': remaster_ros.__file__,
    'config': str(config_path('fake.yaml')),
}))
"""


def environment(**variables: str) -> dict[str, str]:
    """Return the environment of a shell in which only our Python comes first."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith('PYTEST')}
    # The wheels' bootstrapper sets both; a child gets both or neither.
    if kept.pop('_ROS_WHEELS_BOOTSTRAP_COMPLETE', None):
        kept.pop('LD_LIBRARY_PATH', None)
    kept['PATH'] = f'{Path(sys.executable).parent}:{kept["PATH"]}'
    return {**kept, **variables}


def run(command: list[str], env: dict[str, str], cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command, env=env, cwd=cwd, capture_output=True, text=True, timeout=900, check=False
    )


def copy_of_the_source(folder: Path) -> Path:
    """Copy what a build reads: it writes build/ and egg-info beside it."""
    folder.mkdir(parents=True)
    for name in PARTS:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=shutil.ignore_patterns('__pycache__'))
        else:
            shutil.copy(source, folder / name)
    return folder


@pytest.fixture(scope='module')
def by_pip(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, str]]:
    """Install with pip into a prefix; return it and an environment that has it activated."""
    pytest.importorskip('setuptools', reason='pip builds with it')
    folder = tmp_path_factory.mktemp('pip')
    source, prefix = copy_of_the_source(folder / 'source'), folder / 'prefix'
    # Without --ignore-installed pip would take the checkout that is tested out of its environment.
    options = ['--ignore-installed', '--no-deps', '--no-build-isolation', '--no-index']
    command = [sys.executable, '-m', 'pip', 'install', '--quiet', *options]
    command += ['--prefix', str(prefix), str(source)]
    done = run(command, environment(), folder)
    assert done.returncode == 0, done.stderr
    (packages,) = prefix.glob('lib/python3*/site-packages')
    earlier = os.environ.get('AMENT_PREFIX_PATH', '')
    return prefix, environment(
        AMENT_PREFIX_PATH=f'{prefix}:{earlier}'.rstrip(':'),
        PYTHONPATH=f'{packages}:{os.environ.get("PYTHONPATH", "")}'.rstrip(':'),
    )


@pytest.fixture(scope='module')
def by_colcon(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, str]]:
    """Build with colcon; return the prefix and the environment after sourcing its setup file."""
    pytest.importorskip('colcon_core', reason='needs: pip install colcon-common-extensions')
    folder = tmp_path_factory.mktemp('colcon')
    copy_of_the_source(folder / 'src' / 'remaster_ros')
    command = [sys.executable, '-m', 'colcon', 'build', '--packages-select', 'remaster_ros']
    env = environment(COLCON_HOME=str(folder / 'home'))
    done = run(command, env, folder)
    assert done.returncode == 0, done.stdout + done.stderr
    script = f'source {folder}/install/setup.bash && {sys.executable} -c "{PRINT_ENVIRONMENT}"'
    sourced = run(['bash', '-c', script], env, folder)
    assert sourced.returncode == 0, sourced.stderr
    return folder / 'install' / 'remaster_ros', environment(**json.loads(sourced.stdout))


PRINT_ENVIRONMENT = (
    'import json, os; '
    "print(json.dumps({n: os.environ[n] for n in ('PATH', 'PYTHONPATH', 'AMENT_PREFIX_PATH')}))"
)


@pytest.fixture(params=['by_pip', 'by_colcon'])
def installed(request: pytest.FixtureRequest) -> tuple[Path, dict[str, str]]:
    return request.getfixturevalue(request.param)


def test_the_package_and_its_configuration_are_found(
    installed: tuple[Path, dict[str, str]], tmp_path: Path
) -> None:
    prefix, env = installed
    answer = run([sys.executable, '-c', ASK], env, tmp_path)
    assert answer.returncode == 0, answer.stderr
    found = {key: Path(value) for key, value in json.loads(answer.stdout).items()}
    assert found['prefix'] == prefix
    assert found['package'].is_relative_to(prefix), 'the source was imported, not the installation'
    assert found['config'].is_relative_to(prefix)
    for name in ('package.xml', 'config/real.yaml', 'config/cells/demo.yaml'):
        assert (found['share'] / name).is_file()
    assert (found['share'] / 'launch' / 'real.launch.py').is_file()


def start_wrongly(executable: str, installed: tuple[Path, dict[str, str]], cwd: Path) -> None:
    """Expect one line for an argument that is none: so it was found, and imports."""
    prefix, env = installed
    wrong = ['--nonsense'] if executable == 'demo' else ['--ros-args', '-p', 'nonsense:=1']
    if executable == 'sensor_markers':
        # The name of this node chooses what it is.
        wrong += ['-r', '__node:=optitrack_markers']
    here = {'ROS_DOMAIN_ID': str(next(domains)), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
    done = run([str(prefix / 'lib' / 'remaster_ros' / executable), *wrong], {**env, **here}, cwd)
    assert done.returncode == 2
    assert done.stderr.count('\n') == 1, done.stderr
    assert 'nonsense' in done.stderr


@pytest.mark.parametrize(
    'executable',
    [EXECUTABLES[0], *(pytest.param(name, marks=pytest.mark.qualify) for name in EXECUTABLES[1:])],
)
def test_an_executable_starts(
    executable: str, by_pip: tuple[Path, dict[str, str]], tmp_path: Path
) -> None:
    start_wrongly(executable, by_pip, tmp_path)


def test_an_executable_starts_after_colcon(
    by_colcon: tuple[Path, dict[str, str]], tmp_path: Path
) -> None:
    """One is enough: the scripts are the same, and all of them are executable."""
    folder = by_colcon[0] / 'lib' / 'remaster_ros'
    assert sorted(path.name for path in folder.iterdir()) == EXECUTABLES
    assert all(os.access(path, os.X_OK) for path in folder.iterdir())
    start_wrongly('recorder', by_colcon, tmp_path)


def test_only_remaster_is_on_the_path(
    installed: tuple[Path, dict[str, str]], tmp_path: Path
) -> None:
    prefix, env = installed
    assert [path.name for path in (prefix / 'bin').iterdir()] == ['remaster']
    done = run([str(prefix / 'bin' / 'remaster'), '--version'], env, tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith('remaster ')
