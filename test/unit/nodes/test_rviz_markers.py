# SPDX-License-Identifier: Apache-2.0
"""Markers for RViz: what the live page shows, in base_link."""

from __future__ import annotations

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')

import sys
import types
from collections import Counter

import numpy as np
from builtin_interfaces.msg import Time
from visualization_msgs.msg import Marker
from worlds.played_collection import CELL, CHAIN, T_R_N, PlayedCollection

from remaster_ros.nodes import rviz_markers
from remaster_ros.nodes.messages import transform_array
from remaster_ros.nodes.rviz_markers import RvizMarkers
from remaster_ros.reports.robot_scene import robot_scene


class Publisher(list):
    publish = list.append

    def get_subscription_count(self):
        return 1


class Node:
    """Keeps what would be published."""

    def __init__(self):
        self.topics = {}

    def create_publisher(self, kind, topic, qos):
        return self.topics.setdefault(topic, Publisher())

    def get_clock(self):
        return types.SimpleNamespace(now=lambda: types.SimpleNamespace(to_msg=Time))


SCENE = robot_scene(CELL, CELL.planning_scene(CHAIN))


@pytest.fixture
def node():
    return Node()


def test_the_arm_stands_where_its_links_are_and_points_where_they_were_measured(node):
    played = PlayedCollection()
    played.state = 'running'
    for second in range(8):
        played.step(now=float(second))
    RvizMarkers(node, SCENE, publish_tf=False).publish(played.view.view(8.0)['scene'])
    markers = node.topics['remaster/markers'][-1].markers
    assert Counter(m.ns for m in markers) == {
        'arm': len(SCENE.surfaces),
        'way': 1,
        'target': 3,
        'measured': 2,
    }
    assert len({(m.ns, m.id) for m in markers}) == len(markers)
    assert {m.header.frame_id for m in markers} == {'base_link'}
    # Each corner of the drawn arm is one of the scene, carried by its link.
    frames = SCENE.transforms(played.q)
    for marker, surface in zip(markers, SCENE.surfaces):
        assert marker.type == Marker.TRIANGLE_LIST
        assert 0 < len(marker.points) <= 3 * 2 * rviz_markers.MOST_TRIANGLES
        place = marker.pose.position
        assert np.allclose([place.x, place.y, place.z], frames[surface.link][:3, 3], atol=1e-4)
    mocap, tracker = (m for m in markers if m.ns == 'measured')
    expected = played.view.residuals.points_R('mocap')
    assert np.allclose([[p.x, p.y, p.z] for p in mocap.points], expected, atol=1e-4)
    assert (mocap.action, tracker.action) == (Marker.ADD, Marker.DELETE)


def test_before_the_arm_is_heard_it_is_not_drawn(node):
    RvizMarkers(node, SCENE, publish_tf=False).publish(PlayedCollection().view.view(0.0)['scene'])
    assert {m.ns for m in node.topics['remaster/markers'][-1].markers} == {'way', 'measured'}


def test_where_sensors_stand_goes_to_tf_static_where_its_message_is_there(node, monkeypatch):
    sent = types.SimpleNamespace
    stand_in = types.ModuleType('tf2_msgs.msg')
    stand_in.TFMessage = lambda transforms: sent(transforms=transforms)
    monkeypatch.setitem(sys.modules, 'tf2_msgs.msg', stand_in)
    for there, allowed, topics in ((object(), True, 2), (object(), False, 1), (None, True, 1)):
        node.topics.clear()
        monkeypatch.setattr(rviz_markers.util, 'find_spec', lambda name, found=there: found)
        markers = RvizMarkers(node, SCENE, publish_tf=allowed)
        markers.place_sensors({'mocap': T_R_N})
        assert len(node.topics) == topics
        if topics == 2:
            (transform,) = node.topics['/tf_static'][-1].transforms
            assert (transform.header.frame_id, transform.child_frame_id) == ('base_link', 'mocap')
            assert np.allclose(transform_array(transform), T_R_N)


def test_of_a_camera_on_the_tool_the_frame_that_stands_is_its_board(node, monkeypatch):
    stand_in = types.ModuleType('tf2_msgs.msg')
    stand_in.TFMessage = lambda transforms: types.SimpleNamespace(transforms=transforms)
    monkeypatch.setitem(sys.modules, 'tf2_msgs.msg', stand_in)
    monkeypatch.setattr(rviz_markers.util, 'find_spec', lambda name: object())
    markers = RvizMarkers(node, SCENE, publish_tf=True, on_tool=['camera'])
    markers.place_sensors({'mocap': T_R_N, 'camera': T_R_N})
    sent = node.topics['/tf_static'][-1].transforms
    assert [transform.child_frame_id for transform in sent] == ['mocap', 'camera_board']
