"""Nodes in messages have the names that users gave them."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')

from remaster_ros.nodes.endpoints import node_of


@pytest.mark.parametrize(
    ('namespace', 'name', 'called'),
    [
        ('/', 'recorder', '/recorder'),
        ('/cell', 'recorder', '/cell/recorder'),
        (
            '_NODE_NAMESPACE_UNKNOWN_',
            '_NODE_NAME_UNKNOWN_',
            'a node that has just started',
        ),
    ],
)
def test_a_node_is_called_by_its_full_name(namespace, name, called):
    assert node_of(SimpleNamespace(node_namespace=namespace, node_name=name)) == called
