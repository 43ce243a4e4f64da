# SPDX-License-Identifier: Apache-2.0
"""The scene of tests and benchmark of the stopping rule: an arm before one bar."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.planning.candidates import PlannedPose
from remaster_ros.planning.design_information import DesignInformation
from remaster_ros.planning.expected_sensors import ExpectedSensor
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.types import FloatArray, IntArray

POSES, SOLUTIONS = 30, 2
GOALS_AT = (24, 30, 39, 48)
"""The goals are what these numbers of configurations are expected to reach."""


class World(NamedTuple):
    """Arm, configurations and sensor of the sessions."""

    chain: SerialChain
    urdf: str
    q: FloatArray
    pose: IntArray
    sensors: tuple[ExpectedSensor, ...]
    goals: tuple[float, ...]


@lru_cache
def world(markers: int, frame_sigma_m: float = 0.0) -> World:
    """Return the arm before a bar that sees so many markers, whose frames share noise, m."""
    cell = read_cell('demo')
    chain = cell.chain()
    scene = cell.planning_scene(chain)
    planned = scene.plan(150, scene.rough_R, np.random.default_rng(1)).poses
    rng = np.random.default_rng(2)
    several = [pose for pose in planned if len(pose.solutions) >= SOLUTIONS][:POSES]
    chosen = [
        PlannedPose(pose.T_R_T, pose.solutions[rng.permutation(len(pose.solutions))[:SOLUTIONS]])
        for pose in several
    ]
    places = {
        'a': np.array([0.1, 0.0, 0.0]),
        'b': np.array([-0.05, 0.08, 0.0]),
        'c': np.array([-0.05, -0.08, 0.06]),
    }
    seen = dict(list(places.items())[:markers])
    sensors = (ExpectedSensor('bar', np.array([1.9, 0.0, 1.3]), seen, 1e-4, 2e-4, frame_sigma_m),)
    information = DesignInformation.of(chain, chosen, sensors, 0.5e-3)
    goals = tuple(information.joint_rms(range(count)) for count in GOALS_AT)
    return World(chain, cell.urdf_text, information.q, information.pose, sensors, goals)
