"""First registration of the sensors: three points each, then ``/remaster/registration``."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import TransformStamped
from rclpy.node import Node

from remaster_ros.calibration.registration import register_ransac
from remaster_ros.collection.pairing import PairedReading
from remaster_ros.errors import InsufficientDataError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.nodes.messages import transform_message
from remaster_ros.nodes.status import LATCHED
from remaster_ros.session.workcell import Workcell
from remaster_ros.types import FloatArray

POINTS = 3


class Registrar:
    """Collect points per sensor and publish T_R_N, latched, when there are three.

    Parameters
    ----------
    node
        The node that publishes.
    cell, chain
        The sensors and their markers, and the arm.
    allowed_m
        A point that is off by more is not used, m.
    """

    def __init__(self, node: Node, cell: Workcell, chain: SerialChain, allowed_m: float) -> None:
        self._node, self._cell, self._chain = node, cell, chain
        self._allowed_m = allowed_m
        self._points: dict[str, list[tuple[FloatArray, FloatArray]]] = {
            n: [] for n in cell.sensors
        }
        self.T_R_N: dict[str, FloatArray] = {}
        self._notes: dict[str, str] = {}
        self._publisher = node.create_publisher(TransformStamped, 'remaster/registration', LATCHED)

    @property
    def complete(self) -> bool:
        """Whether every sensor is registered."""
        return len(self.T_R_N) == len(self._points)

    def add(self, readings: list[PairedReading]) -> None:
        """Take the readings of one registration pose; points beyond the third refine the fit."""
        for reading in readings:
            marker_T = np.asarray(self._cell.markers[reading.marker], float)
            marker_R = self._chain.positions(reading.q, marker_T)
            points = self._points[reading.sensor]
            points.append((marker_R, reading.position))
            if len(points) < POINTS:
                continue
            robot, measured = (np.array(side) for side in zip(*points))
            try:
                T_R_N, agree = register_ransac(robot, measured, self._allowed_m)
            except InsufficientDataError as error:
                self._notes[reading.sensor] = f'{reading.sensor}: {error}'
                self._node.get_logger().warning(self._notes[reading.sensor])
                continue
            self._notes.pop(reading.sensor, None)
            self.T_R_N[reading.sensor] = T_R_N
            message = transform_message(self._chain.base_link, reading.sensor, T_R_N)
            message.header.stamp = self._node.get_clock().now().to_msg()
            self._publisher.publish(message)
            self._node.get_logger().info(
                f'{reading.sensor} registered by {np.sum(agree)} of {len(points)} points'
            )

    def describe(self) -> str:
        """Say how far the registration is."""
        parts = [
            f'{name}: point {len(points)} of {POINTS}' for name, points in self._points.items()
        ]
        return '; '.join([*parts, *self._notes.values()])
