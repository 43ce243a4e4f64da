# SPDX-License-Identifier: Apache-2.0
"""The launch files with stand-ins for launch, and what they start, which needs none."""

from __future__ import annotations

import importlib.util
import re
import runpy
import shutil
import subprocess
import sys
import types
from pathlib import Path

import pytest
import yaml

from remaster_ros.errors import InputError
from remaster_ros.nodes.launching import (
    COMMANDS,
    CORE,
    FAKES,
    FOLDERS,
    SENSORS,
    exit_ends_launch,
    fake_nodes,
    real_nodes,
)
from remaster_ros.sensors.registry import DRIVERS

ROOT = Path(__file__).parents[3]
CELL, REAL = str(ROOT / 'config' / 'cells' / 'demo.yaml'), str(ROOT / 'config' / 'real.yaml')


def edited(tmp_path, change):
    """Return a copy of real.yaml with something changed."""
    data = yaml.safe_load(Path(REAL).read_text())
    change(data)
    path = tmp_path / 'mine.yaml'
    path.write_text(yaml.safe_dump(data))
    return str(path)


def test_every_node_is_started_with_the_cell_and_the_file():
    nodes = {node.name: node for node in real_nodes(CELL, REAL)}
    assert set(nodes) == {*CORE, *SENSORS}
    for name, node in nodes.items():
        assert node.executable == name
        assert node.parameters[0] == REAL
        assert node.remappings == ()
        if name not in FOLDERS:
            assert node.parameters[1] == {'cell': CELL}


def test_folders_are_beside_the_parameter_file_wherever_launch_was_started(tmp_path, monkeypatch):
    def change(data):
        data['/**/optimizer']['ros__parameters'] |= {'out': 'results/fit', 'prior': '/abs/known'}
        del data['/**/pose_planner']['ros__parameters']['cell']

    params = Path(edited(tmp_path, change))
    elsewhere = tmp_path / 'elsewhere'
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    nodes = {node.name: node for node in real_nodes(CELL, f'../{params.name}')}
    session = {'session': str(tmp_path / 'session')}
    assert nodes['recorder'].parameters[1] == {'cell': CELL, **session}
    discovery = {'discovery': str(tmp_path / 'discovery')}
    assert nodes['pose_planner'].parameters[1] == {'cell': CELL, **session, **discovery}
    assert nodes['optimizer'].parameters[1] == {
        'cell': CELL,
        **session,
        'out': str(tmp_path / 'results/fit'),
        'discovery': str(tmp_path / 'discovery'),
        'prior': '/abs/known',
    }


def test_sensors_by_the_names_of_the_cell(tmp_path, monkeypatch):
    nodes = {node.name: node for node in real_nodes(CELL, REAL, 'mocap')}
    assert set(nodes) == {*CORE, 'optitrack_markers'}
    # Nobody waits for the one that is not there.
    assert nodes['recorder'].parameters[1]['require'] == 'mocap'
    both = real_nodes(CELL, REAL, 'tracker, mocap')
    assert [node.name for node in both[len(CORE) :]] == [
        'laser_tracker_markers',
        'optitrack_markers',
    ]

    def rename(data):
        section = data.pop('/**/optitrack_markers')
        data['/**/optitrack_markers_left'] = section

    (bar,) = real_nodes(CELL, edited(tmp_path, rename), 'mocap')[len(CORE) :]
    assert (bar.executable, bar.name) == ('optitrack_markers', 'optitrack_markers_left')

    def another(data):
        data['/**/gauge_left'] = data.pop('/**/optitrack_markers')

    monkeypatch.setitem(DRIVERS, 'gauge', 'gauge.driver:GaugeDriver')
    (gauge,) = real_nodes(CELL, edited(tmp_path, another), 'mocap')[len(CORE) :]
    assert (gauge.executable, gauge.name) == ('sensor_markers', 'gauge_left')
    with pytest.raises(InputError, match=r"no sensor 'leica'; it has mocap, tracker"):
        real_nodes(CELL, REAL, 'leica')
    lost = edited(tmp_path, lambda data: data.pop('/**/laser_tracker_markers'))
    with pytest.raises(InputError, match="no node for the sensor 'tracker'"):
        real_nodes(CELL, lost)


def test_a_topic_of_another_package_needs_no_section(tmp_path):
    text = Path(CELL).read_text(encoding='utf-8')
    text = text.replace('../robots', str(Path(CELL).parents[1] / 'robots')).replace(
        'topic: optitrack/marker',
        'topic: /vrpn/tool\n    message_type: geometry_msgs/msg/PoseStamped',
    )
    cell = tmp_path / 'cell.yaml'
    cell.write_text(text, encoding='utf-8')
    params = edited(tmp_path, lambda data: data.pop('/**/optitrack_markers'))
    (node,) = real_nodes(str(cell), params, 'mocap')[len(CORE) :]
    assert (node.executable, node.name) == ('sensor_markers', 'topic_markers_mocap')
    assert node.parameters[1] == {'cell': str(cell), 'sensor': 'mocap'}


def test_the_names_of_the_arm_are_remapped_within_the_namespace():
    for node in real_nodes(CELL, REAL, controller='/arm', joint_states='/arm/joints'):
        assert node.remappings == (
            (COMMANDS, '/arm/joint_trajectory'),
            ('joint_states', '/arm/joints'),
        )


@pytest.mark.parametrize('name', ['cell', 'params'])
def test_a_wrong_path_ends_it(name, tmp_path):
    given = {'cell': CELL, 'params': REAL, name: str(tmp_path / 'nowhere.yaml')}
    with pytest.raises(InputError, match=f'{name}:=.*nowhere.yaml: there is no such file'):
        real_nodes(**given)
    # The name of a shipped cell is no path: a real arm is never the demo's.
    with pytest.raises(InputError, match='no such file'):
        real_nodes('demo', REAL)


@pytest.mark.parametrize('core', CORE)
def test_no_node_runs_on_defaults(core, tmp_path):
    lost = edited(tmp_path, lambda data: data.pop(f'/**/{core}'))
    with pytest.raises(InputError, match=f'no section for {core}, it would run on its defaults'):
        real_nodes(CELL, lost)

    def bare(data):
        data[core] = data.pop(f'/**/{core}')

    path = edited(tmp_path, bare)
    assert real_nodes(CELL, path)
    # A bare name is the node of the root namespace alone.
    with pytest.raises(InputError, match=rf'section {core} is not for .* namespace /left'):
        real_nodes(CELL, path, namespace='left')
    assert real_nodes(CELL, REAL, namespace='/left')


@pytest.mark.parametrize('text', ['', '- 1', 'a: 3', '/**/recorder: {}', '{'])
def test_no_parameter_file(text, tmp_path):
    path = tmp_path / 'mine.yaml'
    path.write_text(text)
    with pytest.raises(InputError, match=r'mine\.yaml'):
        real_nodes(CELL, str(path))


def test_fakes_have_the_clock_of_their_namespace():
    nodes = fake_nodes(str(ROOT / 'config' / 'fake.yaml'))
    assert {node.name for node in nodes} == {*CORE, *SENSORS, *FAKES}
    assert all(node.remappings == (('/clock', 'clock'),) for node in nodes)


def test_a_wrong_configuration_is_not_started_again():
    assert exit_ends_launch('recorder-3', 2)
    assert not any(exit_ends_launch('recorder-3', code) for code in (0, 1, -9, -11, None))
    assert not exit_ends_launch('watch-9', 2), 'the arm does not need the live page'


def test_the_live_page_is_started_where_it_is_asked_for():
    for nodes in (real_nodes(CELL, REAL), fake_nodes(REAL)):
        assert 'watch' not in [node.name for node in nodes]
    assert fake_nodes(REAL, dashboard='True')[-1].name == 'watch'
    nodes = {node.name: node for node in real_nodes(CELL, REAL, dashboard='true')}
    fit = nodes['optimizer'].parameters[1]['out']
    assert nodes['watch'].parameters == (REAL, {'cell': CELL, 'fit': fit})
    with pytest.raises(InputError, match='true or false'):
        real_nodes(CELL, REAL, dashboard='yes')


@pytest.mark.parametrize('name', ['real', 'fake'])
def test_the_launch_files(name, monkeypatch):
    """Run with stand-ins for launch, which is not on every machine that runs this."""
    given = {'cell': CELL, 'params': REAL, 'sensors': 'all', 'namespace': '/left'}
    given['dashboard'] = 'false'
    if name == 'fake':
        given['params'] = str(ROOT / 'config' / 'fake.yaml')

    class Configuration(str):
        def perform(self, context):
            return given.get(self, '')

    def argument(name, **options):
        return name, options

    stand_ins = {
        'launch': {'LaunchDescription': list},
        'launch.actions': {
            'DeclareLaunchArgument': argument,
            'EmitEvent': lambda event: ('emit', event),
            'OpaqueFunction': lambda function: function,
            'RegisterEventHandler': lambda handler: handler,
        },
        'launch.event_handlers': {'OnProcessExit': lambda on_exit: ('exit', on_exit)},
        'launch.events': {'Shutdown': lambda reason: ('shutdown', reason)},
        'launch.substitutions': {'LaunchConfiguration': Configuration},
        'launch_ros': {},
        'launch_ros.actions': {'Node': lambda **arguments: arguments},
        'ament_index_python': {},
        'ament_index_python.packages': {'get_package_share_directory': lambda package: ROOT},
    }
    for module, members in stand_ins.items():
        monkeypatch.setitem(sys.modules, module, types.SimpleNamespace(**members))
    # It imports launch.
    monkeypatch.delitem(sys.modules, 'remaster_ros.nodes.launch_actions', raising=False)
    path = ROOT / 'launch' / f'{name}.launch.py'
    *declared, (_, on_exit), start = runpy.run_path(str(path))['generate_launch_description']()
    arguments = dict(declared)
    assert 'namespace' in arguments
    mandatory = {key for key, options in arguments.items() if 'default_value' not in options}
    assert mandatory == ({'cell', 'params'} if name == 'real' else set())
    nodes = start(None)
    expected = {*CORE, *SENSORS} if name == 'real' else {*CORE, *SENSORS, *FAKES}
    assert {node['executable'] for node in nodes} == expected
    for node in nodes:
        assert node['package'] == 'remaster_ros'
        assert node['namespace'] == '/left'
        assert node['respawn']
        assert 0 < node['respawn_max_retries'] < 20
        # An enclave of config/sros2/policy.xml, which has none for the fakes.
        enclave = ['--enclave', f'/remaster/{node["executable"]}']
        assert node['ros_arguments'] == (enclave if name == 'real' else None)
    ended = types.SimpleNamespace(returncode=2, process_name='recorder')
    assert on_exit(ended, None) == [('emit', ('shutdown', 'recorder ended with status 2'))]
    assert not on_exit(types.SimpleNamespace(returncode=-9, process_name='recorder'), None)
    assert not re.search(r'namespace=.?/', path.read_text())


@pytest.mark.skipif(
    shutil.which('ros2') is None or importlib.util.find_spec('launch') is None,
    reason='no ros2 launch here',
)
@pytest.mark.parametrize(
    ('arguments', 'words'),
    [((), 'cell'), ((f'cell:={CELL}', 'params:=/nowhere.yaml'), 'there is no such file')],
)
def test_the_real_ros2_launch_ends(arguments, words):
    done = subprocess.run(
        ['ros2', 'launch', str(ROOT / 'launch' / 'real.launch.py'), *arguments],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode != 0
    assert words in done.stdout + done.stderr
