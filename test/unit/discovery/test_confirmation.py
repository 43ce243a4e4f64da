"""Causes of one session in another: their share of what it could gain, side by side."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from calibration_scenes import CHAIN
from discovery_scenes import at_joint, residuals_of, session_with

from remaster_ros.discovery.confirmation import (
    answer_of,
    confirm,
    in_words,
    require_other_session,
    share_of_gain,
    widened,
)
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
    same = confirm(found, session_with(21, sagging, pose_sigma_m=0.3e-3), np.random.default_rng(0))
    assert same.confirmed
    assert same.same_offsets
    assert 0.8 < same.carried_over <= 1.0
    assert same.rms_after_m < same.rms_before_m
    (cause,) = same.effects
    assert 0.8 < cause.carried_over <= 1.0
    assert cause.answer == 'confirmed'
    assert same.other_joints == ()
    assert [row.name for row in cause.parameters] == ['compliance_2', 'compliance_4']
    # Three values of the same arm, each within its standard deviations.
    assert same.parameters_rms_sigmas < 3.0
    assert same.offsets_rms_sigmas < 3.0
    first, second = in_words(found, same)[1:]
    assert 'it is the same arm' in first
    assert 'Confirmed: ' in second


def test_a_cause_that_was_cured_is_missed():
    found = sagging_arm()
    cured = confirm(found, session_with(21, pose_sigma_m=0.3e-3), np.random.default_rng(0))
    assert not cured.confirmed
    assert cured.rms_after_m > cured.rms_before_m
    # There is nothing to gain: no share of it, however large the errors that it makes.
    assert np.isnan(cured.carried_over)
    assert cured.effects[0].answer == 'absent'
    assert 'Not there any more' in in_words(found, cured)[-1]
    for row in cured.effects[0].parameters:
        assert abs(row.sigmas) > 3.0
        assert abs(row.other_value) < 4.0 * row.other_std


def test_a_cause_of_another_size_is_told_though_more_than_half_of_it_carries_over():
    found = sagging_arm()
    session = session_with(21, lambda s: 1.7 * sagging(s), pose_sigma_m=0.3e-3)
    (cause,) = confirm(found, session, np.random.default_rng(0)).effects
    assert cause.answer == 'changed'
    assert cause.carried_over > 0.5
    for row in cause.parameters:
        assert abs(row.other_value - 1.7 * row.value) < 4.0 * np.hypot(
            row.other_std, 1.7 * row.std
        )


def test_a_session_that_does_not_show_a_cause_leaves_it_open():
    """The arm is measured where gravity hardly turns what gives way."""
    found = sagging_arm()
    session = session_with(21, sagging, pose_sigma_m=0.3e-3)
    torque = np.abs(CHAIN.gravity_torque(session.measurements.q)[:, [1, 3]])
    near = np.argsort(torque[:, 0] / torque[:, 0].std() + torque[:, 1] / torque[:, 1].std())
    still = session.select(np.sort(near[:25]))
    other = confirm(found, still, np.random.default_rng(0))
    (cause,) = other.effects
    assert cause.answer == 'open'
    assert not other.confirmed
    assert 'nothing is confirmed' in in_words(found, other)[0]


def test_a_joint_that_was_mastered_anew_is_named():
    found = sagging_arm()

    def mastered(session: Session) -> np.ndarray:
        return sagging(session) + at_joint(3, np.full(len(session.measurements), 1e-3))

    session = session_with(21, mastered, pose_sigma_m=0.3e-3)
    other = confirm(found, session, np.random.default_rng(0))
    assert other.other_joints == (3,)
    assert other.effects[0].answer == 'confirmed'
    assert any('joint 3' in line for line in in_words(found, other))


def test_another_arm_of_the_same_model_is_not_taken_for_this_one():
    found = sagging_arm()
    # The seed makes the arm: other zero-offsets, healthy joints.
    other = confirm(found, session_with(27), np.random.default_rng(0))
    assert not other.same_offsets
    assert not other.confirmed
    assert other.offsets_rms_sigmas > 3.0
    assert other.rms_frozen_offsets_m > 3.0 * other.rms_own_m
    (line,) = in_words(found, other)
    assert 'another arm, or it was mastered anew' in line
    # With the same joints giving way the causes hold, but not the zero-offsets.
    alike = confirm(found, session_with(27, sagging), np.random.default_rng(0))
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
    other = confirm(
        found, session_with(23, bent, poses=60, sigma_m=0.12e-3), np.random.default_rng(0)
    )
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
    wide = widened(cell, context, other)
    here, there = wide.columns(context).values, wide.columns(other).values
    np.testing.assert_allclose(there, here, atol=1e-9)
    # As many knots, and zero on the average where the cell was found.
    assert abs(wide.size - cell.size) <= 1
    np.testing.assert_allclose(here.mean(axis=0), 0.0, atol=1e-9)


def test_a_curve_reaches_over_both_sessions():
    context = residuals_of(session_with(26, poses=20, validation=0)).context
    cell = next(c for c in EFFECTS['joint_error_curve'].cells(context) if c.joints == (2,))
    m = context.measurements
    beyond = replace(context, measurements=replace(m, q=m.q + 1.0))
    wide = widened(cell, context, beyond)
    assert wide.size > cell.size
    np.testing.assert_allclose(wide.columns(context).values.mean(axis=0), 0.0, atol=1e-9)
    # What the first session shows of it is the same.
    shape = cell.columns(context).values @ np.linspace(-1.0, 1.0, cell.size) ** 2
    values = wide.columns(context).values
    fitted = values @ np.linalg.lstsq(values, shape, rcond=None)[0]
    assert np.std(fitted - shape) < 0.05 * np.std(shape)


@pytest.mark.parametrize(
    ('shared', 'own', 'absent', 'answer'),
    [
        (0.0, -4.0, -30.0, 'confirmed'),
        (-20.0, 0.0, -30.0, 'changed'),
        (-20.0, -2.0, 0.0, 'absent'),
        # Gone, or far smaller: nothing needs the smaller one.
        (-20.0, 0.0, -2.0, 'absent'),
        (0.0, -0.2, -0.5, 'open'),
        (0.0, -0.2, -30.0, 'open'),
    ],
)
def test_the_evidence_answers(shared, own, absent, answer):
    assert answer_of({'shared': shared, 'own': own, 'absent': absent}) == answer


def test_numbers_in_sentences():
    assert [percent(x) for x in (-0.004, 0.0, 0.3512, 1.0)] == ['0 %', '0 %', '35 %', '100 %']
    assert p_value_text(2e-5) == 'p < 0.0001'
    assert p_value_text(0.012) == 'p = 0.012'
    assert p_value_text(np.nan) == 'p unknown'
