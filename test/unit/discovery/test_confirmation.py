"""Causes of one session in another: their share of what it could gain, side by side."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from calibration_scenes import CHAIN
from discovery_scenes import at_joint, residuals_of, session_with

from remaster_ros.discovery.common_range import split
from remaster_ros.discovery.confirmation import (
    confirm,
    require_other_session,
    share_of_gain,
)
from remaster_ros.discovery.confirmation_words import in_words
from remaster_ros.discovery.discover import Discovery, discover_session
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.words import p_value_text, percent
from remaster_ros.errors import InputError
from remaster_ros.types import Session


def sagging(session: Session) -> np.ndarray:
    tau = CHAIN.gravity_torque(session.measurements.q)
    return at_joint(2, 4e-5 * tau[:, 1]) + at_joint(4, 6e-5 * tau[:, 3])


@cache
def sagging_arm() -> Discovery:
    return discover_session(session_with(21, sagging), rng=np.random.default_rng(0))


def test_causes_are_confirmed_in_another_session_of_the_arm():
    # The same offsets and markers: the seed makes the arm.
    found = sagging_arm()
    same = confirm(found, session_with(21, sagging, pose_sigma_m=0.3e-3))
    assert same.confirmed
    assert same.same_offsets
    assert 0.8 < same.carried_over <= 1.0
    assert same.rms_after_m < same.rms_before_m
    (cause,) = same.effects
    assert 0.8 < cause.carried_over <= 1.0
    assert [row.name for row in cause.parameters] == ['compliance_2', 'compliance_4']
    # Three values of the same arm, each within its standard deviations.
    assert same.parameters_rms_sigmas < 3.0
    assert same.offsets_rms_sigmas < 3.0
    first, second = in_words(found, same)[1:]
    assert 'it is the same arm' in first
    assert 'Confirmed: ' in second


def test_a_cause_that_was_cured_is_missed():
    found = sagging_arm()
    cured = confirm(found, session_with(21, pose_sigma_m=0.3e-3))
    assert not cured.confirmed
    assert cured.rms_after_m > cured.rms_before_m
    # There is nothing to gain: no share of it, however large the errors that it makes.
    assert np.isnan(cured.carried_over)
    assert 'Not there any more' in in_words(found, cured)[-1]
    for row in cured.effects[0].parameters:
        assert abs(row.sigmas) > 3.0
        assert abs(row.other_value) < 4.0 * row.other_std


def test_another_arm_of_the_same_model_is_not_taken_for_this_one():
    found = sagging_arm()
    # The seed makes the arm: other zero-offsets, healthy joints.
    other = confirm(found, session_with(27))
    assert not other.same_offsets
    assert not other.confirmed
    assert other.offsets_rms_sigmas > 3.0
    assert other.rms_frozen_offsets_m > 3.0 * other.rms_own_m
    (line,) = in_words(found, other)
    assert 'another arm, or it was mastered anew' in line
    # With the same joints giving way the causes hold, but not the zero-offsets.
    alike = confirm(found, session_with(27, sagging))
    assert alike.carried_over > 0.8
    assert not alike.same_offsets
    assert not alike.confirmed
    assert 'another arm of this kind' in in_words(found, alike)[1]


@pytest.mark.qualify
def test_a_cause_counts_where_it_was_seen():
    """The arm errs differently where joint 2 was not in the first session: that is no matter."""

    def bent(session: Session) -> np.ndarray:
        q = session.measurements.q[:, 1]
        seen = 2e-3 * np.sin(3.0 * q)
        return at_joint(2, np.where(q < limit, seen, 6e-3))

    every = session_with(23)
    limit = float(np.quantile(every.measurements.q[:, 1], 0.6))
    session = session_with(23, bent, poses=60)
    few = session.select(session.measurements.q[:, 1] < limit)
    found = discover_session(few, rng=np.random.default_rng(0))
    assert found.effects
    other = confirm(found, session_with(23, bent, poses=60, sigma_m=0.12e-3))
    assert 0.3 * other.rows < other.rows_common < 0.9 * other.rows
    assert other.carried_over > 0.8
    assert f'{other.rows_common} of its {other.rows} rows' in in_words(found, other)[0]


def test_a_session_cannot_confirm_itself():
    session = session_with(21, poses=20, validation=5)
    order = np.random.default_rng(3).permutation(len(session.measurements))
    for other in (session, replace(session, measurements=session.measurements.select(order[5:]))):
        with pytest.raises(InputError, match='a session cannot confirm itself'):
            require_other_session(session, other)
    require_other_session(session, session_with(21, poses=20, validation=5, sigma_m=0.2e-3))


def test_another_robot_cannot_confirm():
    session = session_with(21)
    other = replace(session, urdf=session.urdf.replace('joint_1"', 'shoulder"'))
    with pytest.raises(InputError, match='another robot'):
        require_other_session(session, other)


@pytest.mark.parametrize(
    ('before', 'frozen', 'own', 'share'),
    [
        (1.0, 0.5, 0.5, 1.0),
        (1.0, 0.8, 0.6, (1.0 - 0.64) / (1.0 - 0.36)),
        # Frozen causes that do better than fitted ones gain all that there is.
        (1.0, 0.4, 0.5, 1.0),
        (1.0, 1.2, 0.5, (1.0 - 1.44) / 0.75),
        (1.0, 9.0, 0.999, np.nan),
        (1.0, 1.0, 1.1, np.nan),
    ],
)
def test_the_share_is_of_what_the_other_session_could_gain(before, frozen, own, share):
    np.testing.assert_allclose(share_of_gain(before, frozen, own), share)


@pytest.mark.parametrize('turns', [0, 1, -2])
def test_a_joint_a_turn_further_is_the_same_where_it_turns_over(turns):
    context = residuals_of(session_with(26, poses=20, validation=0)).context
    chain = replace(CHAIN, lower=np.full(7, -7.0), upper=np.full(7, 7.0))
    context = replace(context, chain=chain)
    cell = next(c for c in EFFECTS['joint_error_curve'].cells(context) if c.joints == (2,))
    m = context.measurements
    q = m.q.copy()
    q[:, 1] += 2.0 * np.pi * turns
    other = replace(context, measurements=replace(m, q=q))
    part = split(cell, context, other)
    assert part.beyond is None
    assert part.inside(other).all()
    np.testing.assert_allclose(
        part.within.columns(other).values, cell.columns(context).values, atol=1e-9
    )
    # Half a turn further nothing was seen of this joint, which has a range of less than that.
    q[:, 1] += np.pi
    apart = split(cell, context, replace(context, measurements=replace(m, q=q)))
    beyond = replace(context, measurements=replace(m, q=q))
    inside = apart.inside(beyond)
    assert inside.mean() < 0.3
    assert apart.beyond is not None
    assert not apart.within.columns(beyond).values[~inside].any()
    assert not apart.beyond.columns(beyond).values[inside].any()
    np.testing.assert_allclose(
        apart.beyond.columns(beyond).values[~inside].sum(axis=1), 1.0, atol=1e-9
    )


def test_numbers_in_sentences():
    assert [percent(x) for x in (-0.004, 0.0, 0.3512, 1.0)] == ['0 %', '0 %', '35 %', '100 %']
    assert p_value_text(2e-5) == 'p < 0.0001'
    assert p_value_text(0.012) == 'p = 0.012'
    assert p_value_text(np.nan) == 'p unknown'
