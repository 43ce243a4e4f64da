"""Expected standard deviations while a session grows."""

from __future__ import annotations

import numpy as np
import pytest

from remaster_ros.collection.live_precision import expected_precision
from remaster_ros.planning.candidates import PlannedPose
from remaster_ros.planning.design_information import DesignInformation
from remaster_ros.session.workcell import read_cell

CELL = read_cell('demo')
CHAIN, SETTINGS = CELL.chain(), CELL.design_settings()


def configurations(rng, poses):
    return {i: list(rng.uniform(CHAIN.lower, CHAIN.upper, (2, len(CHAIN)))) for i in range(poses)}


def test_it_falls_with_every_configuration_and_has_the_same_joints():
    measured = configurations(np.random.default_rng(5), 12)
    found = [
        expected_precision(
            CHAIN, SETTINGS, dict(list(measured.items())[:n]), np.random.default_rng(0)
        )
        for n in (1, 3, 12)
    ]
    assert [one.configurations for one in found] == [2, 6, 24]
    known = [{name for name, std in one.joint_std.items() if std} for one in found]
    # The first joint turns with the registration, the last one with the markers.
    assert known == [{f'joint_{i}' for i in range(2, 7)}] * 3
    for name in known[0]:
        std = [one.joint_std[name] for one in found]
        assert std[0] > std[1] > std[2] > 0.0


def test_at_the_end_it_is_what_the_plan_states():
    measured = configurations(np.random.default_rng(6), 40)
    found = expected_precision(CHAIN, SETTINGS, measured, np.random.default_rng(0))
    poses = [PlannedPose(CHAIN.forward(q[0]), np.array(q)) for q in measured.values()]
    plan = DesignInformation.of(CHAIN, poses, SETTINGS.sensors, SETTINGS.marker_std_m)
    for name, std in plan.joint_std(range(80)).items():
        assert found.joint_std[name] == (None if std is None else pytest.approx(std, rel=1e-3))
