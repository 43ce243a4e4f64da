# SPDX-License-Identifier: Apache-2.0
"""Nodes in the test's process, each in a context of its own as a process has one."""

import time

import rclpy
from bridge_rig import PATIENCE_S
from rclpy.executors import MultiThreadedExecutor, SingleThreadedExecutor
from rigs.ros_rig import OWN_DOMAIN, node_arguments

from remaster_ros.nodes.sensor_markers import SensorNode


class OwnNodes:
    """Nodes of a test, on this machine alone; those of `make` are spun by hand."""

    def __init__(self):
        self._made, self._executors = [], []

    def make(self, name, namespace='', is_spun=True, beside=None):
        """Return a node, in the context of another one where that is given."""
        context = rclpy.Context() if beside is None else beside.context
        if beside is None:
            rclpy.init(context=context, domain_id=OWN_DOMAIN)
        node = rclpy.create_node(name, context=context, namespace=namespace)
        self._made.append(node)
        if is_spun:
            executor = SingleThreadedExecutor(context=context)
            executor.add_node(node)
            self._executors.append(executor)
        return node

    def spin(self, seconds):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            for executor in self._executors:
                executor.spin_once(timeout_sec=0.01)

    def until(self, condition, what='something'):
        end = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < end, f'waited in vain for {what}'
            self.spin(0.01)

    def close(self):
        for executor in self._executors:
            executor.shutdown()
        for node in self._made:
            node.destroy_node()
        for context in {node.context for node in self._made}:
            rclpy.shutdown(context=context)


class SensorBench:
    """The node of a sensor, and a peer."""

    def __init__(self, own_nodes, name, own_name, parameters):
        args = [*node_arguments(**parameters), '--log-level', 'fatal', '-r', f'__node:={name}']
        rclpy.init(args=args, domain_id=OWN_DOMAIN)
        self._nodes, self.peer = own_nodes, own_nodes.make('peer')
        self.node = SensorNode(own_name)
        self._executor = MultiThreadedExecutor(3)
        self._executor.add_node(self.node)

    def wait(self, condition, what, act=lambda: None):
        def spun():
            act()
            self._executor.spin_once(timeout_sec=0.01)
            return condition()

        if not condition():
            self._nodes.until(spun, what)

    def summary(self):
        return self.node._summary()
