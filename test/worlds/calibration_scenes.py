# SPDX-License-Identifier: Apache-2.0
"""Sessions simulated for the tests of the fit: an LWR 4+ seen by one or two sensors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from remaster_ros.calibration.extension import Extension, Term
from remaster_ros.kinematics.inverse_kinematics import InverseKinematics
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import rotation_vector_to_matrix, transform
from remaster_ros.simulation.simulated_session import simulate_session
from remaster_ros.simulation.truth import SessionTruth, SimulatedSensor
from remaster_ros.types import Session

ROOT = Path(__file__).parents[2]
URDF = (ROOT / 'config/robots/lwr4plus.urdf').read_text(encoding='utf-8')
CHAIN = SerialChain.from_urdf(URDF)
MARKERS = {'sir': np.array([0.1, 0.0, 0.02]), 'smr': np.array([-0.1, 0.0, 0.02])}
# Third joint held at these angles: several solutions for each pose, as the paper has them.
HELD = {2: (-0.6, 0.0, 0.6)}
_INVERSE = InverseKinematics(CHAIN, held=HELD)


def random_poses(count: int, rng: np.random.Generator, solutions: int = 5) -> list[np.ndarray]:
    """Return joint solutions of poses in the dexterous workspace, (m, 7) each, m >= 2."""
    poses: list[np.ndarray] = []
    while len(poses) < count:
        q = 0.7 * rng.uniform(CHAIN.lower, CHAIN.upper)
        q[2] = rng.choice(HELD[2])
        T = CHAIN.forward(q)
        if not (0.2 < np.hypot(*T[:2, 3]) < 0.6 and 0.3 < T[2, 3] < 0.9):
            continue
        found = _INVERSE.usable(_INVERSE.solutions_of_each(T[None])[0])
        if len(found) > 1:
            poses.append(found[rng.permutation(len(found))[:solutions]])
    return poses


def sensors(
    rng: np.random.Generator,
    count: int = 1,
    sigma_m: float = 0.23e-3,
    pose_sigma_m: float = 0.5e-3,
) -> dict[str, SimulatedSensor]:
    """Return one or two sensors in front of the robot, turned at random."""
    places = {'mocap': ('sir', (1.5, 0.3, 1.0)), 'tracker': ('smr', (3.0, -1.0, 0.2))}
    return {
        name: SimulatedSensor(
            marker,
            transform(rotation_vector_to_matrix(rng.standard_normal(3)), place),
            sigma_m,
            pose_sigma_m,
        )
        for name, (marker, place) in list(places.items())[:count]
    }


def scene(
    seed: int,
    *,
    poses: int = 30,
    validation: int = 0,
    sensor_count: int = 1,
    sigma_m: float = 0.23e-3,
    pose_sigma_m: float = 0.5e-3,
    **options: object,
) -> tuple[Session, SessionTruth]:
    """Simulate a session; the seed is printed, so that a failure can be repeated."""
    print(f'scene seed {seed}')
    rng = np.random.default_rng(seed)
    return simulate_session(
        CHAIN,
        URDF,
        rng,
        poses=random_poses(poses, rng),
        validation_poses=random_poses(validation, rng),
        sensors=sensors(rng, sensor_count, sigma_m, pose_sigma_m),
        markers=MARKERS,
        **options,  # type: ignore[arg-type]
    )


def one_tool_direction(seed: int, turned: float = 0.01, noise_m: float = 1e-3) -> Session:
    """Poses in a small cube, the tool always turned the same way, its marker unknown."""
    print('seed', seed)
    rng = np.random.default_rng(seed)
    inverse = InverseKinematics(CHAIN, held={2: (0.0,)})
    start = np.array([0.3, 0.6, 0.0, -1.2, 0.2, 0.9, 0.4])
    poses = []
    while len(poses) < 40:
        T = CHAIN.forward(start)
        T[:3, 3] += rng.uniform(-0.1, 0.1, 3)
        found = inverse.usable(inverse.solutions_of_each(T[None])[0])
        if len(found):
            nearest = found[np.argmin(np.linalg.norm(found - start, axis=1))]
            poses.append(nearest + turned * rng.standard_normal((2, 7)))
    session, _ = simulate_session(
        CHAIN,
        URDF,
        rng,
        poses=poses,
        validation_poses=[],
        sensors=sensors(rng, 1, noise_m, noise_m),
        markers={**MARKERS, 'sir': np.array([0.002, 0.0, 0.1])},
    )
    return replace(session, marker_std_m=0.2)


def extension(
    names: tuple[str, ...],
    units: tuple[str, ...],
    joint: np.ndarray,
    displacement: np.ndarray,
    displacement0: np.ndarray,
    theta0: np.ndarray,
    prior_precision: np.ndarray,
) -> Extension:
    """Return an extension of dense arrays: (n, k, m) at all joints, (n, 3, m) beside them."""
    every = slice(0, len(names))
    turning = [Term(every, at, joint[:, at]) for at in range(joint.shape[1])]
    terms = (*turning, Term(every, None, displacement))
    return Extension(names, units, terms, displacement0, theta0, prior_precision)
