# SPDX-License-Identifier: Apache-2.0
"""A small two-joint session, and a fit, for the storage tests."""

from __future__ import annotations

import errno
import os
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from remaster_ros.calibration.fit import fit_session
from remaster_ros.calibration.result import FitResult
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.simulation.simulated_session import simulate_session
from remaster_ros.simulation.truth import SimulatedSensor
from remaster_ros.types import BasePrior, Measurements, Session

ROOT = Path(__file__).parents[2]
HOSTILE_NAME = 'tracker<script>&$x_{$'

URDF = """<?xml version="1.0"?>
<robot name="two_joints">
  <link name="base_link"/>
  <joint name="joint_1" type="revolute">
    <parent link="base_link"/><child link="link_1"/>
    <origin xyz="0 0 0.3" rpy="0 0 0"/><axis xyz="0 0 1"/>
    <limit lower="-3.0" upper="3.0" effort="10" velocity="2"/>
  </joint>
  <link name="link_1"/>
  <joint name="joint_2" type="revolute">
    <parent link="link_1"/><child link="tool"/>
    <origin xyz="0 0 0.4" rpy="1.5707963 0 0.3"/><axis xyz="0 0 1"/>
    <limit lower="-2.0" upper="2.0" effort="10" velocity="2"/>
  </joint>
  <link name="tool"/>
</robot>
"""


def make_measurements(rows: int, joints: int, seed: int) -> Measurements:
    rng = np.random.default_rng(seed)
    pose = np.arange(rows) // 4
    from_q = rng.uniform(-1.9, 1.9, (rows, joints))
    from_q[0] = np.nan
    std = rng.uniform(0, 1e-4, (rows, 3))
    std[1] = np.nan
    samples = rng.integers(1, 400, rows)
    samples[2] = -1
    temperature = rng.uniform(20, 25, rows)
    temperature[3] = np.nan
    effort = rng.normal(0, 30, (rows, joints))
    effort[4, 0] = np.nan
    return Measurements(
        observation=np.arange(rows),
        pose=pose,
        configuration=np.arange(rows) // 2,
        is_validation=pose % 2 == 1,
        stamp_s=np.cumsum(rng.uniform(0, 5, rows)),
        sensor=np.arange(rows) % 2,
        marker=np.arange(rows) % 2,
        q=rng.uniform(-1.9, 1.9, (rows, joints)),
        from_q=from_q,
        position=rng.normal(0, 1, (rows, 3)),
        std=std,
        samples=samples,
        temperature_c=temperature,
        effort=effort,
    )


@pytest.fixture
def session() -> Session:
    """Two joints, two sensors, twenty rows, every optional value missing once."""
    return Session(
        urdf=URDF,
        base_link='base_link',
        tip_link='tool',
        markers={'sir': np.array([0.1, 0.0, 0.02]), 'smr': np.array([-0.1, 1e-17, 0.02])},
        sensors={'mocap': 'sir', 'tracker': 'smr'},
        measurements=make_measurements(20, 2, seed=1),
        marker_std_m=5e-4,
        settle_s=2.5,
        base_prior={
            'tracker': BasePrior(
                translation_m=np.array([3.0, 0.1, 1.0]),
                rotation_xyzw=np.array([0.0, 0.0, 0.6, 0.8]),
                std_m=1e-3,
                std_rad=1e-4,
            )
        },
        exit_status='complete',
        notes='1e-3',
        created='2024-05-01T12:00:00Z',
        extra={'cell': {'operator': 'no', 'humidity': 0.4}, 'robot': {'serial': '0123'}},
    )


@pytest.fixture(scope='session')
def fit_result() -> FitResult:
    """A fit of the LWR 4+ with two sensors, gross errors, and a name that is no harmless text."""
    urdf = (ROOT / 'config' / 'robots' / 'lwr4plus.urdf').read_text(encoding='utf-8')
    chain = SerialChain.from_urdf(urdf, 'base_link', 'tool')
    seed = 11
    print('seed', seed)
    rng = np.random.default_rng(seed)
    low, high = np.maximum(chain.lower, -2.5), np.minimum(chain.upper, 2.5)

    def poses(count):
        return [rng.uniform(low, high, (4, len(chain))) for _ in range(count)]

    T_R_N = np.eye(4)
    T_R_N[:3, 3] = 2.0, 0.3, 1.0
    session, _ = simulate_session(
        chain,
        urdf,
        rng,
        poses=poses(24),
        validation_poses=poses(12),
        sensors={
            'mocap': SimulatedSensor('sir', T_R_N, sigma_m=0.2e-3),
            HOSTILE_NAME: SimulatedSensor('smr', T_R_N),
        },
        markers={'sir': np.array([0.1, 0.0, 0.02]), 'smr': np.array([-0.1, 0.0, 0.02])},
        outlier_share=0.02,
    )
    return fit_session(session, rng=rng, draws=500)


@pytest.fixture
def full_disk(monkeypatch):
    """Return a context in which the disk takes `room` bytes, and then no more."""

    @contextmanager
    def full(room=0):
        write, free = os.write, room

        def limited(descriptor, data):
            nonlocal free
            if not free:
                raise OSError(errno.ENOSPC, 'No space left on device')
            written = write(descriptor, bytes(data[:free]))
            free -= written
            return written

        with monkeypatch.context() as patch:
            patch.setattr(os, 'write', limited)
            yield

    return full
