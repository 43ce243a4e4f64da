# SPDX-License-Identifier: Apache-2.0
"""Simulated experiments of the source paper's size, in the demo cell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from itertools import pairwise

import numpy as np

from remaster_ros.kinematics.transforms import looking_at, transform
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.simulation.simulated_session import simulate_session
from remaster_ros.simulation.truth import SessionTruth, SimulatedSensor
from remaster_ros.types import FloatArray, Session

CELL = read_cell('demo')
CHAIN = CELL.chain()
MARKERS = {name: np.array(position) for name, position in CELL.markers.items()}
MARKER_OF = {name: sensor.marker for name, sensor in CELL.sensors.items()}

# Sizes of the paper's two data sets: poses and joint configurations.
OPTIMIZATION = (36, 173)
VALIDATION = (32, 156)


def sensor_frames() -> dict[str, FloatArray]:
    """Return T_R_N of the cell's sensors, at their places, looking at the workspace's middle."""
    middle = (0.0, 0.0, sum(CELL.poses.height_m) / 2)
    return {
        name: transform(
            looking_at(np.array(sensor.rough_position_m), middle, 0.0),
            np.array(sensor.rough_position_m),
        )
        for name, sensor in CELL.sensors.items()
    }


@cache
def pose_pool(candidates: int = 600, seed: int = 0) -> tuple[FloatArray, ...]:
    """Return joint solutions (m, k), m >= 2, of poses planned as in section III of the paper."""
    rng = np.random.default_rng(seed)
    places = {name: frame[:3, 3] for name, frame in sensor_frames().items()}
    plan = CELL.planning_scene(CHAIN).plan(candidates, places, rng)
    return tuple(pose.solutions for pose in plan.poses if len(pose.solutions) > 1)


def choose_poses(
    sizes: Sequence[tuple[int, int]], rng: np.random.Generator
) -> list[list[FloatArray]]:
    """Draw disjoint sets of poses from the pool, each with the wanted (poses, configurations)."""
    pool = pose_pool()
    counts = np.array([len(solutions) for solutions in pool])
    edges = np.cumsum([0, *(poses for poses, _ in sizes)])
    for _ in range(100_000):
        order = rng.permutation(len(pool))[: edges[-1]]
        parts = [order[a:b] for a, b in pairwise(edges)]
        if all(0 <= counts[p].sum() - n <= 3 for p, (_, n) in zip(parts, sizes)):
            chosen = [[pool[i] for i in part] for part in parts]
            for solutions, (_, wanted) in zip(chosen, sizes):
                _trim(solutions, wanted)
            return chosen
    raise RuntimeError(f'no choice of poses has the sizes {sizes}')


def _trim(solutions: list[FloatArray], wanted: int) -> None:
    """Drop solutions of the richest poses, as collisions do, until the total is right."""
    while sum(map(len, solutions)) > wanted:
        richest = max(range(len(solutions)), key=lambda i: len(solutions[i]))
        solutions[richest] = solutions[richest][:-1]


def experiment(
    rng: np.random.Generator,
    noise_m: Mapping[str, tuple[float, float]],
    *,
    joint_offsets: FloatArray | None = None,
    marker_std_m: float = CELL.marker_std_m,
    sizes: Sequence[tuple[int, int]] = (OPTIMIZATION, VALIDATION),
) -> tuple[Session, SessionTruth]:
    """Simulate an experiment of the paper's size.

    Parameters
    ----------
    rng
        Source of all randomness.
    noise_m
        Sensor -> (sigma, pose_sigma) per axis, m; only these sensors measure.
    joint_offsets
        The truth, rad; None draws it with 0.3 degrees std.
    marker_std_m
        How far the true markers lie from nominal, and how well the session knows them, per axis.
    sizes
        (poses, configurations) to fit and, if there is a second, to validate.
    """
    poses, *validation = choose_poses(sizes, rng)
    frames = sensor_frames()
    session, truth = simulate_session(
        CHAIN,
        CELL.urdf_text,
        rng,
        poses=poses,
        validation_poses=validation[0] if validation else (),
        sensors={
            name: SimulatedSensor(MARKER_OF[name], frames[name], *noise)
            for name, noise in noise_m.items()
        },
        markers={MARKER_OF[name]: MARKERS[MARKER_OF[name]] for name in noise_m},
        joint_offsets=joint_offsets,
        marker_std_m=marker_std_m,
    )
    return session, truth
