# SPDX-License-Identifier: Apache-2.0
"""Node parameters: every config file fits; wrong values are refused with one line."""

import importlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')

from remaster_ros.errors import InputError
from remaster_ros.parameters import check, parameter_fields
from remaster_ros.sensors.driver import SensorParameters
from remaster_ros.sensors.registry import DRIVERS, load_driver

pytestmark = pytest.mark.ros

CONFIG = Path(__file__).parents[3] / 'config'
SCRIPTS = Path(__file__).parents[3] / 'scripts'
NODES = sorted({path.name for path in SCRIPTS.iterdir()} - {'demo'})


def fields_of(node):
    return parameter_fields(importlib.import_module(f'remaster_ros.nodes.{node}').Parameters)


def test_every_module_with_a_main_is_an_executable_with_parameters():
    """So are the drivers of sensors: each has those of every sensor, and its own."""
    nodes = (Path(__file__).parents[3] / 'remaster_ros' / 'nodes').glob('[!_]*.py')
    assert sorted(path.stem for path in nodes if '\ndef main(' in path.read_text()) == NODES
    for node in NODES:
        assert fields_of(node)
    for kind in DRIVERS:
        driver_type = load_driver(kind).parameters_type
        assert list(parameter_fields(driver_type))[:3] == list(parameter_fields(SensorParameters))


@pytest.mark.parametrize('node', NODES)
def test_defaults_are_within_their_own_ranges_and_described(node):
    for field in fields_of(node).values():
        assert check(node, field, field.default) == field.default
        assert field.metadata['description']
        if isinstance(field.default, float) and field.name.endswith(('_s', '_m')):
            assert field.metadata['unit']


@pytest.mark.parametrize('name', ['fake.yaml', 'real.yaml'])
def test_config_files_fit_the_dataclasses(name):
    """Every value in config/*.yaml names a parameter of its node and lies in its range."""
    data = yaml.safe_load((CONFIG / name).read_text())
    for node, section in data.items():
        parameters = dict(section['ros__parameters'])
        parameters.pop('use_sim_time', None)
        # In any namespace: a bare name would match the node in the root namespace alone, and one
        # elsewhere would run on its defaults without a word.
        assert node.startswith('/**/')
        node = node.removeprefix('/**/')
        fields = fields_of(node)
        for key, value in parameters.items():
            assert key in fields, f'{name}: {node} has no parameter {key}'
            check(node, fields[key], value)


@pytest.mark.parametrize(
    ('file', 'node', 'namespace', 'key', 'value'),
    [
        # Each stands in the file with a good value, so that the refused one is that of `-p`.
        ('fake.yaml', 'optimizer', '', 'sampler', 'neither'),
        ('fake.yaml', 'robot_bridge', '/left', 'speed_share', '7.5'),
        ('fake.yaml', 'fake_robot', '', 'joint_state_rate', '-3.25'),
        ('real.yaml', 'optimizer', '/left', 'sampler', 'neither'),
    ],
)
def test_a_value_of_the_command_line_is_taken_before_that_of_a_shipped_file(
    file, node, namespace, key, value
):
    """By the command that a user types; by the same executable where there is no `ros2`."""
    ros2 = shutil.which('ros2')
    run = [ros2, 'run', 'remaster_ros', node] if ros2 else [sys.executable, SCRIPTS / node]
    remap = ['-r', f'__ns:={namespace}'] if namespace else []
    ended = subprocess.run(
        [*run, '--ros-args', *remap, '--params-file', CONFIG / file, '-p', f'{key}:={value}'],
        env={**os.environ, 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', 'ROS_DOMAIN_ID': '91'},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert ended.returncode == 2, ended.stderr
    assert key in ended.stderr
    assert value in ended.stderr


def test_a_wrong_type_a_wrong_range_and_a_wrong_word_are_one_line_each():
    fields = fields_of('robot_bridge')
    for value in ('fast', True, [0.3]):
        with pytest.raises(InputError, match=r'robot_bridge: parameter speed_share .*float'):
            check('robot_bridge', fields['speed_share'], value)
    for value in (1.5, float('nan'), -1):
        with pytest.raises(InputError, match=r'must lie in 0.01 to 1.0'):
            check('robot_bridge', fields['speed_share'], value)
    field = fields_of('optitrack_markers')['transport']
    with pytest.raises(InputError, match='one of multicast, unicast'):
        check('optitrack_markers', field, 'broadcast')


def test_whole_numbers_are_welcome_where_a_real_one_is_wanted():
    assert check('robot_bridge', fields_of('robot_bridge')['settle_s'], 3) == 3.0
