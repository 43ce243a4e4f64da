"""The moves of tours as the planner node plans them, and what that takes."""

from __future__ import annotations

import time
from collections import Counter

import numpy as np

from remaster_ros.planning.tour_planner import TourPlanner
from remaster_ros.session.workcell import Workcell
from remaster_ros.types import FloatArray


def tours(
    cell: Workcell, seeds: range, candidates: int = 60
) -> tuple[list[FloatArray], Counter[str], int, list[float], list[float], float]:
    """Return every move (n, k) of tours of a cell, what was dropped, and the times."""
    chain = cell.chain()
    moves, dropped, no_path = [], Counter[str](), 0
    planning, ways, slowest = [], [], 0.0
    for seed in seeds:
        counts = {'registration': 3, 'optimization': candidates, 'validation': candidates}
        T_R_N = {}
        for name, sensor in cell.sensors.items():
            T_R_N[name] = np.eye(4)
            T_R_N[name][:3, 3] = sensor.rough_position_m
        start = time.thread_time()
        planner = TourPlanner(cell.planning_scene(chain), counts, seed)
        tour = planner.collection(T_R_N)
        planning.append(time.thread_time() - start)
        dropped.update(tour.dropped_solutions)
        here = np.clip(np.zeros(len(chain)), chain.lower, chain.upper)
        if planner.model.trouble(here):
            here = next(iter(tour.plans['optimization'].poses)).solutions[0]
        ways.append(0.0)
        while True:
            start = time.thread_time()
            stop = tour.next(here)
            took = time.thread_time() - start
            ways[-1] += took
            slowest = max(slowest, took)
            if stop is None:
                break
            no_path += len(stop.unreached)
            for way, solution in zip(stop.paths, stop.solutions):
                moves.append(np.vstack((here, way, solution)))
                here = solution
    return moves, dropped, no_path, planning, ways, slowest
