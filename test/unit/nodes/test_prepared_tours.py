# SPDX-License-Identifier: Apache-2.0
"""Who asks for curves while they are prepared waits for them, and does not choose them again."""

import threading

import pytest

pytest.importorskip('rclpy')

from worlds.simple_cells import four_markers

from remaster_ros.nodes.planner.parameters import Parameters
from remaster_ros.planning.tour_planner import TourPlanner
from remaster_ros.session.cells.workcell import read_cell


def test_a_tour_that_is_asked_for_waits_for_what_is_prepared(tmp_path, monkeypatch):
    cell = read_cell(four_markers(tmp_path / 'cell.yaml'))
    tours = Parameters(moving_s=24.0).tour_planner(cell, cell.chain(), ())
    began, may_end, done = threading.Event(), threading.Event(), []

    def prepare(self):
        began.set()
        assert may_end.wait(30.0)
        done.append('prepared')

    monkeypatch.setattr(TourPlanner, 'prepare', prepare)
    monkeypatch.setattr(TourPlanner, 'moving', lambda self, T: done.append('asked'))
    preparing = threading.Thread(target=tours.prepare)
    preparing.start()
    assert began.wait(30.0)
    asking = threading.Thread(target=tours.collection, args=(tours.rough_places,))
    asking.start()
    asking.join(0.2)
    assert done == []
    may_end.set()
    for thread in (preparing, asking):
        thread.join(30.0)
    assert done == ['prepared', 'asked']
