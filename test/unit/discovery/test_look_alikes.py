# SPDX-License-Identifier: Apache-2.0
"""Look-alikes: other causes in the place of one, with their probabilities."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from msgspec import structs
from worlds.discovery_scenes import at_joint, discovered, residuals_of, session_with

from remaster_ros.discovery import discover
from remaster_ros.discovery.effects.base import Candidate
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.explain import describe
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.walk import Walk
from remaster_ros.types import Session

ARC_MINUTE = np.radians(1.0 / 60.0)


def wavy(seed: int, minutes: float = 3.0) -> Session:
    """Return a session with an eccentric encoder of joint 2, by so many minutes of arc."""
    return session_with(
        seed, lambda s: at_joint(2, minutes * ARC_MINUTE * np.sin(s.measurements.q[:, 1]))
    )


@cache
def eccentric() -> Residuals:
    """Return what an eccentric encoder of joint 2 leaves."""
    return residuals_of(wavy(41))


def candidates_of(data: Residuals, name: str, *joints: int) -> list[Candidate]:
    return [
        candidate
        for candidate in EFFECTS[name].candidates(data.context)
        if candidate.joints in [(j,) for j in joints]
    ]


def walked(data: Residuals, candidates: list[Candidate]) -> Walk:
    return Walk(data, candidates, np.random.default_rng(0))


def test_the_shapes_that_a_curve_can_have_are_special_cases_of_it():
    data = eccentric()
    named = [
        *candidates_of(data, 'encoder_eccentricity', 2, 4),
        *candidates_of(data, 'joint_compliance', 2),
    ]
    (curve,) = candidates_of(data, 'joint_error_curve', 2)
    assert [candidate.is_shape_of(curve) for candidate in named] == [
        (candidate.name, candidate.joints) == ('encoder_eccentricity', (2,)) for candidate in named
    ]
    assert not curve.is_shape_of(named[0])


def test_a_wave_is_named_by_its_shape_and_not_as_a_curve():
    data = eccentric()
    candidates = [
        *candidates_of(data, 'encoder_eccentricity', 2),
        *candidates_of(data, 'joint_error_curve', 2),
    ]
    _, (effect,) = describe(walked(data, candidates), lambda share: None)
    assert (effect.name, effect.joints) == ('encoder_eccentricity', (2,))
    # The free form has this shape, too, and leaves it in no doubt.
    assert not effect.tied


def test_two_names_of_one_displacement_share_the_probability_and_leave_no_doubt():
    data = eccentric()
    candidate = candidates_of(data, 'encoder_eccentricity', 2)[0]
    names = tuple(f'{name} of another name' for name in candidate.parameters)
    twin = replace(candidate, name='encoder_scale', parameters=names)
    _, (effect,) = describe(walked(data, [candidate, twin]), lambda share: None)
    (other,) = effect.confusable_with
    assert other.same
    assert other.probability == pytest.approx(0.5, abs=0.4)
    assert effect.probability == pytest.approx(1.0, abs=0.01)
    assert not effect.tied
    assert 'Exactly the same errors come from' in effect.cause


@pytest.mark.qualify
@pytest.mark.parametrize(('tied', 'verdict'), [(False, 'effects'), (True, 'undetermined')])
def test_the_largest_cause_is_in_doubt_also_where_held_out_poses_gain_nothing(
    monkeypatch, tied, verdict
):
    found = discover.describe

    def described(*args):
        groups, effects = found(*args)
        assert effects
        return groups, (structs.replace(effects[0], tied=tied, share=0.0), *effects[1:])

    monkeypatch.setattr(discover, 'describe', described)
    # Of one minute of arc, a fourteenth of the noise at the marker, no cause is named.
    assert discovered(wavy(41)).verdict == verdict
