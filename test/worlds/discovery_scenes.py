# SPDX-License-Identifier: Apache-2.0
"""Sessions with something wrong in them, made row by row, for the tests of the discovery."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
from worlds.calibration_scenes import CHAIN, scene

from remaster_ros.calibration.estimate import Problem, estimate
from remaster_ros.discovery.discover import Discovery, discover_session
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.kinematics.transforms import apply, inverse
from remaster_ros.types import FloatArray, Session


def session_with(
    seed: int,
    angles: Callable[[Session], FloatArray] | None = None,
    sensor: Callable[[Session], FloatArray] | None = None,
    **options: object,
) -> Session:
    """Simulate a session whose joints turn by ``angles`` too, or whose sensor errs.

    ``angles`` (n, k): the difference that they make is added to what a faultless arm showed;
    ``sensor`` (n, 3): added to what it measured.
    """
    session, truth = scene(seed, **{'poses': 35, 'validation': 25, 'sigma_m': 0.1e-3, **options})  # type: ignore[arg-type]
    m = session.measurements
    position = m.position.copy()
    if angles is not None:
        markers = np.array([truth.markers[name] for name in session.marker_names])[m.marker]
        places = [truth.sensors[name].T_R_N for name in session.sensor_names]
        shift = CHAIN.positions(
            m.q + angles(session), markers, truth.joint_offsets
        ) - CHAIN.positions(m.q, markers, truth.joint_offsets)
        turn = inverse(np.array(places))[m.sensor]
        position += apply(turn, shift) - turn[:, :3, 3]
    if sensor is not None:
        position += sensor(session)
    return replace(session, measurements=replace(m, position=position))


def residuals_of(session: Session) -> Residuals:
    """Fit the offsets and return what is left."""
    return Residuals.of(estimate(Problem.of(session)))


def at_joint(joint: int, values: FloatArray) -> FloatArray:
    """Return joint angles (n, k) that are zero but for one joint, numbered from 1."""
    angles = np.zeros((len(values), len(CHAIN)))
    angles[:, joint - 1] = values
    return angles


def discovered(session: Session, seed: int = 0) -> Discovery:
    """Search a session for causes."""
    return discover_session(session, rng=np.random.default_rng(seed))


def sagging(session: Session) -> FloatArray:
    """Joints 2 and 4 give way: the pair that a greedy search takes for a coupling."""
    tau = CHAIN.gravity_torque(session.measurements.q)
    return at_joint(2, 4e-5 * tau[:, 1]) + at_joint(4, 6e-5 * tau[:, 3])


@cache
def sagging_arm() -> Discovery:
    """Search the session of an arm that sags, once for all tests of a process."""
    return discovered(session_with(21, sagging))
