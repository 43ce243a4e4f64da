# SPDX-License-Identifier: Apache-2.0
"""`python -m remaster_ros.nodes` lists the nodes, and names the one that was meant."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from remaster_ros.nodes.__main__ import NODES, main

ROOT = Path(__file__).parents[3]


def test_every_executable_and_no_other_is_listed(capsys):
    assert main([]) == 0
    out = capsys.readouterr().out
    assert {*NODES, 'demo'} == {path.name for path in (ROOT / 'scripts').iterdir()}
    assert all(f'  {name} ' in out for name in NODES)


def test_an_unknown_node_is_refused_with_the_one_that_was_meant(capsys):
    assert main(['recoder']) == 2
    assert "there is no node 'recoder'; did you mean 'recorder'?" in capsys.readouterr().err
    assert main(['xyz']) == 2
    assert 'there are pose_planner, robot_bridge' in capsys.readouterr().err


@pytest.mark.parametrize(
    ('excluded_nodes', 'late'),
    [
        # A third of the time until nine nodes are there went into libraries for fits and figures.
        (('watch',), ('scipy.stats', 'scipy.optimize', 'scipy.interpolate', 'matplotlib')),
        # Nodes that measure and move need neither fit nor search.
        (
            ('pose_planner', 'optimizer', 'watch'),
            [
                f'remaster_ros.{name}'
                for name in ('calibration.estimate', 'discovery.walk', 'planning.pose_design')
            ],
        ),
    ],
)
def test_what_a_node_may_never_need_is_not_loaded_when_it_starts(excluded_nodes, late):
    pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')
    code = (
        'import importlib, sys\n'
        f'for name in {[name for name in NODES if name not in excluded_nodes]}: '
        'importlib.import_module(f"remaster_ros.nodes.{name}")\n'
        f'print([name for name in {late} if name in sys.modules])'
    )
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == '[]'
