# SPDX-License-Identifier: Apache-2.0
"""For RViz and Foxglove: the arm, its way and the measured points in base_link, and static tf.

``remaster/markers`` (visualization_msgs/MarkerArray) has the same as the live page. Where the
sensors stand goes to /tf_static, for their own points to be shown in base_link, where tf2_msgs is
installed: it comes with ROS 2, but there is no pip wheel of it.
"""

from __future__ import annotations

from collections.abc import Container, Mapping
from importlib import import_module, util
from typing import Any

import numpy as np
from geometry_msgs.msg import Point, TransformStamped
from rclpy.node import Node
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from remaster_ros.compensation.static_transforms import BOARD
from remaster_ros.nodes.messages import transform_message, write_place
from remaster_ros.nodes.status import LATCHED, RELIABLE
from remaster_ros.reports.robot_scene import RobotScene, Surface, coarser
from remaster_ros.types import FloatArray

TOPIC = 'remaster/markers'
TF_STATIC = '/tf_static'
MOST_TRIANGLES = 300
"""Of each surface: every message holds them all."""
COLORS = {'link': '#9aa7b5', 'tool': '#d98e32', 'marker': '#2f9e78', 'obstacle': '#b06a5a'}
SENSOR_COLORS = ('#3b82c4', '#e07b39', '#2f9e78', '#a86bc0')


class RvizMarkers:
    """Publishes the markers and, with `publish_tf`, the sensors' frames on /tf_static."""

    def __init__(
        self, node: Node, scene: RobotScene, *, publish_tf: bool, on_tool: Container[str] = ()
    ) -> None:
        self._node, self._scene, self._base = node, scene, scene.chain.base_link
        self._on_tool = on_tool
        self._publisher = node.create_publisher(MarkerArray, TOPIC, RELIABLE)
        self._surfaces = [self._surface(i, s) for i, s in enumerate(scene.surfaces)]
        self._tf = None
        if publish_tf and util.find_spec('tf2_msgs') is not None:
            message = import_module('tf2_msgs.msg').TFMessage
            self._tf = message, node.create_publisher(message, TF_STATIC, LATCHED)

    def _surface(self, number: int, surface: Surface) -> Marker:
        """Triangle marker of a surface of the arm, coarsened to `MOST_TRIANGLES`.

        ``number``: id of the marker.
        """
        points, faces = coarser(surface.vertices, surface.faces, MOST_TRIANGLES)
        marker = self._marker('arm', number, Marker.TRIANGLE_LIST, COLORS[surface.role], 1.0)
        if surface.color is not None:
            marker.color = _color(*surface.color)
        marker.points = _points(points[faces].reshape(-1, 3))
        return marker

    def _marker(self, space: str, number: int, kind: int, color: str, size: float) -> Marker:
        """Marker in the base frame at the origin, of one `kind` of visualization_msgs/Marker.

        ``space, number``: namespace and id; ``color``: ``#rrggbb``; ``size``: scale along all
        axes, m.
        """
        marker = Marker(ns=space, id=number, type=kind, action=Marker.ADD)
        marker.header.frame_id = self._base
        marker.pose.orientation.w = 1.0
        marker.scale.x = marker.scale.y = marker.scale.z = size
        marker.color = _color(*(int(color[i : i + 2], 16) / 255.0 for i in (1, 3, 5)))
        return marker

    @property
    def wanted(self) -> bool:
        """Whether somebody subscribes to the markers."""
        return bool(self._publisher.get_subscription_count())

    def publish(self, scene: Mapping[str, Any]) -> None:
        """Publish the markers of a scene, all with the present time as their stamp.

        ``scene``: that of `LiveView.view`. The arm is left out without its positions, the axes
        of the target without a target; a path or measured points that are empty are deleted in
        RViz.
        """
        markers = []
        if scene['q'] is not None:
            frames = self._scene.transforms(np.array(scene['q']))
            for marker, surface in zip(self._surfaces, self._scene.surfaces, strict=True):
                write_place(frames[surface.link], marker.pose.position, marker.pose.orientation)
                markers.append(marker)
        way = self._marker('way', 0, Marker.LINE_STRIP, '#e0a83c', 0.006)
        way.points = _points(np.reshape(scene['way'], (-1, 3)))
        markers.append(way)
        if scene['target'] is not None:
            markers += self._axes(np.reshape(scene['target'], (4, 4)))
        for number, points in enumerate(scene['points'].values()):
            color = SENSOR_COLORS[number % len(SENSOR_COLORS)]
            spheres = self._marker('measured', number, Marker.SPHERE_LIST, color, 0.012)
            spheres.points = _points(np.reshape(points, (-1, 3)))
            markers.append(spheres)
        stamp = self._node.get_clock().now().to_msg()
        for marker in markers:
            # RViz complains of lists without points.
            listed = marker.type in (Marker.LINE_STRIP, Marker.SPHERE_LIST)
            marker.action = Marker.DELETE if listed and not marker.points else Marker.ADD
            marker.header.stamp = stamp
        self._publisher.publish(MarkerArray(markers=markers))

    def _axes(self, T: FloatArray) -> list[Marker]:
        """Arrow markers of the axes of a pose T, (4, 4): x red, y green, z blue, 0.12 m long."""
        markers = []
        for axis, color in enumerate(('#d62728', '#2ca02c', '#1f77b4')):
            arrow = self._marker('target', axis, Marker.ARROW, color, 0.012)
            arrow.scale.x = 0.006
            arrow.points = _points(np.array([T[:3, 3], T[:3, 3] + 0.12 * T[:3, axis]]))
            markers.append(arrow)
        return markers

    def place_sensors(self, T_R_N: Mapping[str, FloatArray]) -> None:
        """Publish the frames of sensors, T_R_N (4, 4) by name, on /tf_static.

        Nothing without tf2_msgs or `publish_tf`. For a sensor on the tool it is the frame of
        the board that the sensor sees, and is named so, as `remaster export --to tf` does.
        """
        if self._tf is None:
            return
        kind, publisher = self._tf
        stamp = self._node.get_clock().now().to_msg()
        found: list[TransformStamped] = []
        for name, T in T_R_N.items():
            child = f'{name}{BOARD}' if name in self._on_tool else name
            found.append(transform_message(self._base, child, T))
            found[-1].header.stamp = stamp
        publisher.publish(kind(transforms=found))


def _color(red: float, green: float, blue: float) -> ColorRGBA:
    """Return an opaque color; parts 0 to 1."""
    return ColorRGBA(r=float(red), g=float(green), b=float(blue), a=1.0)


def _points(points: FloatArray) -> list[Point]:
    """Return points (n, 3), m, as messages."""
    return [Point(x=x, y=y, z=z) for x, y, z in points.tolist()]
