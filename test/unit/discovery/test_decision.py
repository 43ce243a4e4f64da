"""What is decided between two causes, and how sure that is."""

from functools import cache

import numpy as np
import pytest
from calibration_scenes import CHAIN
from discovery_scenes import at_joint, discovered, session_with
from scipy.stats import norm

from remaster_ros.discovery.decision import Decision, Named, decisions, sigma_of
from remaster_ros.discovery.discover import Discovery

SAG, BASE = Named('joint_compliance', (2,)), Named('base_compliance', ())
WAVE = Named('encoder_eccentricity', (2,))


@cache
def sagging() -> Discovery:
    session = session_with(
        51, lambda s: at_joint(2, 4e-5 * CHAIN.gravity_torque(s.measurements.q)[:, 1])
    )
    found = discovered(session)
    assert [(effect.name, effect.joints) for effect in found.effects] == [SAG]
    return found


def test_the_cause_that_is_there_wins_whichever_way_it_is_asked():
    first, second, third, fourth = decisions(
        sagging(),
        [(SAG, BASE), (BASE, SAG), (WAVE, SAG), (SAG, BASE), (SAG, Named(*SAG[:1], (2, 4)))],
    )
    assert (first.answer, second.answer, third.answer) == ('cause', 'look_alike', 'look_alike')
    assert first.log_evidence == pytest.approx(-second.log_evidence)
    assert first.sigma == pytest.approx(second.sigma)
    assert first.sigma > 3.0
    assert first.describe() == (
        f'decided: joint compliance of joint 2, not base compliance; {first.sigma:.1f} sigma'
    )
    assert second.describe() == first.describe()
    # Of two joints of which one gives way.
    assert fourth.log_evidence > 0.0


def test_what_the_search_has_not_found_is_not_decided():
    (one,) = decisions(sagging(), [(Named('backlash', (3,)), Named('settling', (3,)))])
    assert one.answer == 'neither'
    assert np.isnan(one.log_evidence)
    assert one.describe() == (
        'the search now names neither backlash of joint 3 nor settling of joint 3'
    )


@pytest.mark.parametrize('log_odds', [0.0, 0.5, 3.0, 12.5, -12.5, 50.0])
def test_odds_are_stated_as_the_error_that_is_as_rare(log_odds):
    wrong = 1.0 / (1.0 + np.exp(abs(log_odds)))
    assert sigma_of(log_odds) == pytest.approx(norm.isf(wrong), abs=1e-9)


def test_large_odds_are_finite_and_small_ones_leave_it_open():
    assert 50.0 < sigma_of(2000.0) < 100.0
    one = Decision(SAG, BASE, 'open', -1.0, sigma_of(-1.0))
    assert one.describe() == (
        'still open: base compliance or joint compliance of joint 2; 0.6 sigma for the first'
    )
