# SPDX-License-Identifier: Apache-2.0
"""How much of the gain is lost without each cause."""

from dataclasses import replace

import numpy as np
import pytest
from worlds.discovery_scenes import residuals_of, session_with

from remaster_ros.discovery import evidence
from remaster_ros.discovery.effects.base import Candidate
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.evidence import Solution, solve
from remaster_ros.discovery.explain import shares
from remaster_ros.discovery.gain import rms
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.types import FloatArray, Session

ARC_MINUTE = np.radians(1.0 / 60.0)


def waves(session: Session) -> FloatArray:
    q = session.measurements.q
    angles = np.zeros_like(q)
    angles[:, 1] = 3.0 * ARC_MINUTE * np.sin(q[:, 1])
    angles[:, 3] = 2.0 * ARC_MINUTE * np.sin(3.0 * q[:, 3])
    return angles


def scene(with_held_out: bool) -> tuple[Residuals, list[tuple[Candidate, ...]], Solution]:
    session = session_with(17, angles=waves)
    if not with_held_out:
        session = session.select(~session.measurements.is_validation)
    data = residuals_of(session)

    def candidate(name: str, joint: int) -> Candidate:
        return next(c for c in EFFECTS[name].candidates(data.context) if c.joints == (joint,))

    # A wave of joint 2 and a free curve of it: each can do what the other does.
    groups = [
        (candidate('joint_error_curve', 4),),
        (candidate('encoder_eccentricity', 2), candidate('encoder_scale', 2)),
        (candidate('joint_error_curve', 2),),
    ]
    solution = solve(data, [member for group in groups for member in group])
    assert solution is not None
    return data, groups, solution


@pytest.fixture(scope='module', params=[True, False], ids=['held out', 'fitted'])
def found(
    request: pytest.FixtureRequest,
) -> tuple[Residuals, list[tuple[Candidate, ...]], Solution]:
    return scene(request.param)


def test_shares_are_what_fits_without_each_cause_lose(found, monkeypatch):
    data, groups, solution = found
    # Noise and smoothness as they are.
    monkeypatch.setattr(evidence, 'STEPS', 0)
    held_out = data.context.measurements.is_validation
    rows = held_out if held_out.any() else np.isin(np.arange(len(held_out)), data.rows.source)

    def remaining_square(*causes: int) -> float:
        fit = solve(data, [c for i in causes for c in groups[i]], solution)
        assert fit is not None
        return rms(data.unexplained(fit), rows) ** 2

    every, none = remaining_square(0, 1, 2), remaining_square()
    lost = (
        np.array([remaining_square(1, 2), remaining_square(0, 2), remaining_square(0, 1)]) - every
    )
    expected = lost / (none - every)
    print(np.round(expected, 3))
    assert shares(data, groups, solution) == pytest.approx(expected, abs=1e-4)
    # What two can explain is lost without neither of them.
    assert expected.sum() < 0.5


def test_where_nothing_is_gained_nobody_has_a_share():
    data, groups, solution = scene(with_held_out=True)
    held_out = data.context.measurements.is_validation[:, None]
    opposite = replace(data, full_errors=np.where(held_out, -data.full_errors, data.full_errors))
    assert shares(opposite, groups, solution) == [0.0, 0.0, 0.0]
