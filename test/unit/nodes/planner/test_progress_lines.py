# SPDX-License-Identifier: Apache-2.0
"""Lines in the terminal of a launch."""

from __future__ import annotations

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2 Jazzy or its wheels')

import types

from remaster_ros.nodes.planner import progress_lines
from remaster_ros.nodes.planner.progress_lines import ProgressLines


def test_a_line_comes_at_each_change_of_state_and_now_and_then_between(monkeypatch):
    lines, ticks, now = [], [], [0.0]
    node = types.SimpleNamespace(
        get_logger=lambda: types.SimpleNamespace(info=lines.append),
        create_timer=lambda period, callback, clock: ticks.append(callback),
    )
    clock = types.SimpleNamespace(monotonic=lambda: now[0])
    monkeypatch.setattr(progress_lines, 'time', clock)
    counts = {'phase': 'registration', 'configurations_done': 0, 'configurations': 0}
    counts |= {'poses': 5, 'poses_done': 0}
    state = ['idle']
    ProgressLines(node, None, lambda: counts, lambda: state[0])

    def go(seconds, per_s=0):
        for _ in range(seconds):
            now[0] += 1.0
            counts['configurations_done'] += per_s
            ticks[0]()

    go(5)
    state[0] = 'running'
    go(30)
    assert lines == [], 'nothing is planned yet'
    counts.update(phase='collection', configurations=100)
    go(60, per_s=1)
    assert 3 <= len(lines) <= 4
    assert lines[-1].startswith('running: ')
    assert 'about' in lines[-1]
    count = len(lines)
    state[0] = 'paused'
    go(60)
    assert lines[count:] == ['paused: 60 of 100 configurations, 0 of 5 poses']
