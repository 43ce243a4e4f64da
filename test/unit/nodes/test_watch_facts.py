# SPDX-License-Identifier: Apache-2.0
"""What the live page tells of a fit, and whom a pose waits for while somebody looks on."""

from __future__ import annotations

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')

from types import SimpleNamespace

import numpy as np
from worlds.played_collection import CHAIN

from remaster_ros.calibration.records import Marker
from remaster_ros.errors import InputError
from remaster_ros.nodes import watch
from remaster_ros.nodes.planner.pose_publisher import PosePublisher
from remaster_ros.nodes.watch import fit_facts
from remaster_ros.reports.live_view import FitFacts
from remaster_ros.reports.schemas import Accuracy, JointOffset


def errors(before, after):
    """Return a part of fit.json; what the posterior predicts is ten times as good."""
    return {
        metric: {'before': {'mean_mm': share * before}, 'after': {'mean_mm': share * after}}
        for metric, share in (('post_registration', 1.0), ('theoretical', 0.1))
    }


FIT = SimpleNamespace(
    joint_offsets=[
        JointOffset('joint_1', 0.0, 90.0, None, False, 'nothing tells'),
        JointOffset('joint_2', 1.0, 0.01, None, True, ''),
        JointOffset('slide', None, None, None, True, '', unit='mm', mean_mm=2.0, std_mm=0.1),
    ],
    markers={'sir': Marker((0.1, 0.0, 0.001), (1e-4, 1e-4, 1e-4))},
    accuracy=Accuracy(validation=errors(1.5, 0.1), optimization={'post_registration': None}),
)
OFFSETS = {'joint_1': 0.0, 'joint_2': float(np.deg2rad(1.0)), 'slide': 2e-3}


def test_the_errors_of_the_same_fit_are_told(tmp_path, monkeypatch):
    monkeypatch.setattr(watch, 'read_fit', lambda path: FIT)
    facts = {'mean error, held-out poses': '1.500 mm → 0.100 mm', 'files': str(tmp_path)}
    found = fit_facts(tmp_path, OFFSETS)
    assert found.shown == facts
    assert found.unidentifiable == {'joint_1'}
    assert found.markers['sir'].tolist() == [0.1, 0.0, 0.001]
    (tmp_path / 'report.html').touch()
    assert fit_facts(tmp_path, OFFSETS).shown['files'] == str(tmp_path / 'report.html')
    accuracy = Accuracy(validation=None, optimization=errors(2.0, 0.2))
    without = SimpleNamespace(**{**vars(FIT), 'accuracy': accuracy})
    monkeypatch.setattr(watch, 'read_fit', lambda path: without)
    assert 'mean error, held-out poses' not in fit_facts(tmp_path, OFFSETS).shown


def test_of_another_fit_or_none_nothing_is_told(tmp_path, monkeypatch):
    assert fit_facts(tmp_path, OFFSETS) == FitFacts()
    monkeypatch.setattr(watch, 'read_fit', lambda path: FIT)
    assert fit_facts(tmp_path, OFFSETS | {'joint_2': 0.02}) == FitFacts()
    assert fit_facts(tmp_path, {}) == FitFacts()

    def damaged(path):
        raise InputError('damaged')

    monkeypatch.setattr(watch, 'read_fit', damaged)
    assert fit_facts(tmp_path, OFFSETS) == FitFacts()


@pytest.mark.parametrize(
    ('names', 'count'),
    [
        (('robot_bridge', 'recorder'), 2),
        (('robot_bridge', 'recorder', 'watch', 'rviz'), 2),
        (('robot_bridge', 'watch'), 1),
        (('watch',), 0),
    ],
)
def test_a_pose_waits_for_bridge_and_recorder_and_for_nobody_else(names, count):
    publisher = SimpleNamespace(topic_name='t', get_subscription_count=lambda: len(names))
    node = SimpleNamespace(
        create_publisher=lambda *arguments: publisher,
        get_subscriptions_info_by_topic=lambda topic: [
            SimpleNamespace(node_name=n) for n in names
        ],
    )
    assert PosePublisher(node, CHAIN).subscribers == count
