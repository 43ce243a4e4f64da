"""What `remaster discover` prints."""

import types

from remaster_ros.cli.discover import summary
from remaster_ros.discovery.confirmation import Confirmation
from remaster_ros.discovery.explain import FoundEffect, LookAlike
from remaster_ros.discovery.gain import Gain
from remaster_ros.discovery.thinning import Thinning

EFFECT = FoundEffect(
    name='joint_compliance',
    joints=(2, 4),
    place='joint_angle',
    driver='gravity_torque',
    form='linear',
    parameters=(),
    p_value=0.002,
    log_evidence_gain=50.0,
    confusable_with=(LookAlike('encoder_scale', (2,), 48.0, 'a payload'),),
    cause='The weight it carries winds up joints 2 and 4.',
    size_m=0.5e-3,
    share=1.0,
)


def found(effects, gain, untestable, thinning=None):
    verdict = 'effects' if effects else 'none'
    return types.SimpleNamespace(
        verdict=verdict,
        effects=effects,
        gain=gain,
        untestable=untestable,
        thinning=thinning,
        unexplained=(),
    )


def test_causes_look_alikes_and_gain_are_said():
    text = summary(found((EFFECT,), Gain(1e-3, 0.3e-3, 0.28e-3, {}), {}))
    assert 'verdict: effects' in text
    assert 'joint_compliance [2, 4]: 0.500 mm, 100 % of the gain' in text
    assert 'could be encoder_scale [2]; to distinguish: a payload' in text
    assert '1.000 mm RMS before, 0.300 mm after; the noise alone is 0.280 mm' in text


def test_nothing_found_and_what_cannot_be_tested_are_said():
    text = summary(found((), Gain(None, None, 0.1e-3, {}), {'backlash': 'no from_q'}))
    assert 'nothing beyond the zero-offsets' in text
    assert 'not testable: backlash: no from_q' in text
    assert 'held out' not in text


def test_what_was_searched_of_a_large_session_is_said():
    part = Thinning(10_000, 80_000, 0.42e-3, 0.39e-3)
    text = summary(found((), Gain(None, None, 0.1e-3, {}), {}, part))
    assert 'searched: 10000 of 80000 rows; the others fall from 0.420 to 0.390 mm RMS' in text


def test_a_cause_that_was_cured_is_not_confirmed():
    session = found((EFFECT,), Gain(1e-3, 0.3e-3, 0.28e-3, {}), {})
    text = summary(session, Confirmation(0.3e-3, 0.9e-3, -0.9, (-0.9,), False, 0.2e-3, True))
    assert '-90 % of the gain carries over' in text
    assert 'Not there any more' in text
