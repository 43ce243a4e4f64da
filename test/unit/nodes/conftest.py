# SPDX-License-Identifier: Apache-2.0
"""The robot bridge of most tests here, and plain nodes; other nodes have a rig of their own."""

import pytest


@pytest.fixture
def rig(monkeypatch, tmp_path):
    """Return a function that makes a rig with these parameters."""
    from bridge_rig import Rig

    made = []

    def make(ready=True, **options):
        made.append(Rig(monkeypatch, tmp_path, **options))
        return made[-1].ready() if ready else made[-1]

    yield make
    for made_rig in made:
        made_rig.close()


@pytest.fixture
def own_nodes(monkeypatch):
    """Return what makes nodes in this process."""
    from own_nodes import OwnNodes

    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    made = OwnNodes()
    yield made
    made.close()


@pytest.fixture
def start_sensor(own_nodes, monkeypatch, tmp_path):
    """Return a function that starts the node of a sensor, and a peer that is spun with it."""
    import rclpy
    from own_nodes import SensorBench

    monkeypatch.setenv('ROS_HOME', str(tmp_path))
    made = []

    def start(name, own_name, **parameters):
        made.append(SensorBench(own_nodes, name, own_name, parameters))
        return made[-1]

    yield start
    for bench in made:
        bench.node.close()
        bench.node.destroy_node()
    rclpy.try_shutdown()


@pytest.fixture
def compensator(monkeypatch, tmp_path):
    """Return a function that makes a compensator's rig of an arm and parameters."""
    import rclpy
    from compensator_rig import Rig, erring

    monkeypatch.setenv('ROS_HOME', str(tmp_path))
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    made = []

    def make(model=None, **options):
        made.append(Rig(tmp_path, erring() if model is None else model, **options))
        return made[-1]

    yield make
    try:
        for made_rig in made:
            made_rig.close()
    finally:
        rclpy.try_shutdown()
