# SPDX-License-Identifier: Apache-2.0
"""Sessions of every shape: repeated readings, one sensor or three, no times, few poses, many."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from worlds.calibration_scenes import CHAIN, MARKERS, URDF, random_poses, sensors

from remaster_ros.kinematics.transforms import rotation_vector_to_matrix, transform
from remaster_ros.session.records.reader import read_session
from remaster_ros.simulation.simulated_session import simulate_session
from remaster_ros.simulation.truth import SimulatedSensor
from remaster_ros.types import Observation, Session

SHARED = Path(__file__).parents[3] / 'shared'
LAST_ALONE = 'the first sensor and the first marker measured nothing'


def simulated(
    poses: list[np.ndarray], seed: int, validation: list[np.ndarray] | None = None, count: int = 1
) -> Session:
    """Return a session of these joint solutions, with up to three sensors."""
    print(f'session shape seed {seed}')
    rng = np.random.default_rng(seed)
    placed = sensors(rng, min(count, 2), 0.05e-3, 0.1e-3)
    if count == 3:
        T = transform(rotation_vector_to_matrix(rng.standard_normal(3)), (-1.5, 1.0, 0.5))
        placed['camera'] = SimulatedSensor('sir', T, 0.1e-3, 0.1e-3)
    session, _ = simulate_session(
        CHAIN,
        URDF,
        rng,
        poses=poses,
        validation_poses=validation or [],
        sensors=placed,
        markers=MARKERS,
    )
    return session


def read_again(session: Session, times: int, rng: np.random.Generator) -> Session:
    """Return the session with every configuration read several times in a row."""
    m = session.measurements
    rows = np.repeat(np.arange(len(m)), times)
    again = m.select(rows)
    noise = rng.normal(0.0, 2e-6, again.position.shape)
    count = np.arange(len(rows))
    return replace(
        session,
        measurements=replace(
            again,
            observation=count,
            configuration=count,
            stamp_s=count.astype(float),
            from_q=np.full_like(again.q, np.nan),
            position=again.position + noise,
        ),
    )


def one_solution(count: int, seed: int) -> list[np.ndarray]:
    """Return poses of one joint solution each."""
    return [q[:1] for q in random_poses(count, np.random.default_rng(seed))]


def repeats(seed: int, times: int, validation: int = 4) -> Session:
    """Return twenty poses of one solution, each read several times."""
    rng = np.random.default_rng(seed)
    session = simulated(one_solution(20, seed), seed, one_solution(validation, seed + 1))
    return read_again(session, times, rng)


def repeats_of_some(seed: int) -> Session:
    """Return poses of which every fourth was read twice."""
    session = repeats(seed, 2)
    m = session.measurements
    return session.select(np.flatnonzero((m.observation % 2 == 0) | (m.pose % 4 == 0)))


def own_poses(session: Session) -> Session:
    """Return the session with a pose for every reading, as programs write it that know none."""
    m = session.measurements
    return replace(session, measurements=replace(m, pose=np.arange(len(m))))


def one_pose_held_out(seed: int) -> Session:
    """Return twenty poses of one solution, of which one is held out."""
    return simulated(one_solution(19, seed), seed, one_solution(1, seed + 1))


def one_pose_for_all(seed: int) -> Session:
    """Return forty configurations that the session calls one pose."""
    session = simulated(one_solution(40, seed), seed)
    m = session.measurements
    return replace(session, measurements=replace(m, pose=np.zeros_like(m.pose)))


def without_times(seed: int) -> Session:
    """Return a session whose rows have an order only."""
    session = simulated(one_solution(40, seed), seed, one_solution(10, seed + 1))
    m = session.measurements
    order = np.arange(len(m), dtype=float)
    return replace(session, timed=False, measurements=replace(m, stamp_s=order))


def three_sensors(seed: int) -> Session:
    """Return a session of three sensors, all solutions of every pose."""
    rng = np.random.default_rng(seed)
    return simulated(random_poses(10, rng), seed, random_poses(3, rng), count=3)


def last_alone(seed: int) -> Session:
    """Return a session whose first sensor, with the first marker, measured nothing."""
    session = three_sensors(seed)
    return session.select(np.flatnonzero(session.measurements.sensor == 1))


def many_rows(seed: int, rows: int) -> Session:
    """Return that many configurations, of one solution each."""
    rng = np.random.default_rng(seed)
    q = 0.7 * rng.uniform(CHAIN.lower, CHAIN.upper, (rows, len(CHAIN)))
    poses = list(q[:, None])
    return simulated(poses[rows // 5 :], seed, poses[: rows // 5])


def real(name: str) -> Session | None:
    """Return a real set; None where it is not beside this repository."""
    folder = SHARED / 'data' / name
    return read_session(folder) if folder.is_dir() else None


def every_third(session: Session | None) -> Session | None:
    """Return each third of the poses of a session."""
    if session is None:
        return None
    return session.select(np.flatnonzero(session.measurements.pose % 3 == 0))


def observations(session: Session) -> Iterator[Observation]:
    """Give the rows of a session as a recorder has them."""
    m = session.measurements
    for i in range(len(m)):
        yield Observation(
            observation=int(m.observation[i]),
            pose=int(m.pose[i]),
            configuration=int(m.configuration[i]),
            split='validation' if m.is_validation[i] else 'optimization',
            stamp_s=m.stamp_s[i],
            sensor=session.sensor_names[m.sensor[i]],
            marker=session.marker_names[m.marker[i]],
            q=m.q[i],
            position=m.position[i],
            from_q=None if np.isnan(m.from_q[i]).any() else m.from_q[i],
            std=None if np.isnan(m.std[i]).any() else m.std[i],
            samples=None if m.samples[i] < 0 else int(m.samples[i]),
            temperature_c=None if np.isnan(m.temperature_c[i]) else m.temperature_c[i],
        )


Shape = Callable[[], Session | None]
CHEAP: dict[str, Shape] = {
    'each read twice': lambda: repeats(1, 2),
    'each read three times, none held out': lambda: repeats(2, 3, 0),
    'some read twice': lambda: repeats_of_some(3),
    'read twice, a pose for every reading': lambda: own_poses(repeats(4, 2)),
    'one pose of twenty held out': lambda: one_pose_held_out(5),
    'no times': lambda: without_times(6),
    LAST_ALONE: lambda: last_alone(10),
    'three sensors': lambda: three_sensors(7),
    'a real arm, each read twice': lambda: every_third(real('meca500_repeats')),
}
LARGE: dict[str, Shape] = {
    'a real arm, each read twice, whole': lambda: real('meca500_repeats'),
    'a real arm of three markers': lambda: real('irb120_three_points'),
    'a real arm of seven joints': lambda: real('panda_left'),
    'a real arm in ISO cubes': lambda: real('ur10_iso_cubes'),
    'a real arm, two solutions': lambda: real('ur10_two_solutions'),
    '1,000 rows': lambda: many_rows(8, 1000),
    '20,000 rows': lambda: many_rows(9, 20_000),
}
