"""`python -m remaster_ros.nodes` lists the nodes, and names the one that was meant."""

from __future__ import annotations

from pathlib import Path

from remaster_ros.nodes.__main__ import NODES, main

ROOT = Path(__file__).parents[3]


def test_every_executable_and_no_other_is_listed(capsys):
    assert main([]) == 0
    out = capsys.readouterr().out
    assert set(NODES) == {path.name for path in (ROOT / 'scripts').iterdir()}
    assert all(f'  {name} ' in out for name in NODES)


def test_an_unknown_node_is_refused_with_the_one_that_was_meant(capsys):
    assert main(['recoder']) == 2
    assert "there is no node 'recoder'; did you mean 'recorder'?" in capsys.readouterr().err
    assert main(['xyz']) == 2
    assert 'there are pose_planner, robot_bridge' in capsys.readouterr().err
