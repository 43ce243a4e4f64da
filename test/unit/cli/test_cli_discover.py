# SPDX-License-Identifier: Apache-2.0
"""What `remaster discover` prints."""

import json
import re
import types

import msgspec
from msgspec.structs import replace
from rigs.command_line import refusal, remaster

from remaster_ros.discovery.confirmation import Compared, Confirmation, ConfirmedCause, in_words
from remaster_ros.discovery.explain import FoundEffect, LookAlike
from remaster_ros.discovery.gain import Gain
from remaster_ros.discovery.thinning import Thinning
from remaster_ros.reports.result_lines import discovery_lines
from remaster_ros.reports.schemas import Discovered, Judgement, Loadable
from remaster_ros.session.json_records import checked

EFFECT = FoundEffect(
    name='joint_compliance',
    joints=(2, 4),
    place='joint_angle',
    driver='gravity_torque',
    form='linear',
    parameters=(),
    p_value=0.002,
    log_evidence_gain=50.0,
    confusable_with=(
        LookAlike('encoder_scale', (2,), 48.0, 'a payload', title='Encoder scale of joint 2'),
        LookAlike('joint_compliance', (4,), 47.0, 'another payload'),
    ),
    cause='The weight it carries winds up joints 2 and 4.',
    size_m=0.5e-3,
    share=1.0,
    remedy='Stiffen it.',
    title='Joint compliance of joints 2 and 4',
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
        fit=types.SimpleNamespace(sampler=types.SimpleNamespace(converged=True)),
    )


TO_LOAD = (
    Loadable('offsets', 1.4, True, 'apply/robot_calibrated.urdf'),
    Loadable('geometry', 1.5, False, ''),
    Loadable('everything', 0.3, True, 'apply/compensation.json'),
)


def summary(session, confirmation=None, to_load=()):
    return '\n'.join(discovery_lines(content_of(session, confirmation, to_load)))


def content_of(session, confirmation=None, to_load=()):
    points = in_words(session, confirmation) if confirmation else []
    content = {
        'format': 'remaster-discovery/1',
        'verdict': session.verdict,
        'effects': session.effects,
        'gain': session.gain,
        'noise': {'pose_common_fraction': 0.0, 'outliers': (), 'heteroscedastic': {}},
        'joint_offsets_after': (),
        'untestable': session.untestable,
        'loadable': to_load,
        'judgement': Judgement('good', 'The headline.', points),
    }
    if session.thinning is not None:
        content['rows_searched'] = session.thinning
    if confirmation is not None:
        content['confirmation'] = confirmation
    return checked(content, Discovered)


def test_causes_look_alikes_and_gain_are_said():
    text = summary(found((EFFECT,), Gain(1e-3, 0.3e-3, 0.28e-3), {}), to_load=TO_LOAD)
    assert 'alone, mean error on held-out poses 1.400 mm: apply/robot_calibrated.urdf, ' in text
    assert 'together, mean error on held-out poses 1.500 mm: leave it: not clearly better' in text
    assert 'can correct, mean error on held-out poses 0.300 mm: apply/compensation.json' in text
    assert 'verdict: effects' in text
    assert (
        'Joint compliance of joints 2 and 4: 0.500 mm RMS at the marker, without it 100 % of the '
        'gain is lost' in text
    )
    assert 'to do: Stiffen it.' in text
    nothing = summary(found((replace(EFFECT, share=-0.004),), Gain(None, None, 1e-4), {}))
    assert ', without it 0 % of the gain is lost' in nothing
    assert 'could be encoder scale of joint 2; to decide: a payload' in text
    assert 'could be joint 4 alone; to decide: another payload' in text


def test_nothing_found_and_what_cannot_be_tested_are_said():
    text = summary(found((), Gain(None, None, 0.1e-3), {'backlash': 'no from_q'}))
    assert 'verdict: none\nThe headline.' in text
    assert 'not testable: backlash: no from_q' in text


def test_what_was_searched_of_a_large_session_is_said():
    part = Thinning(10_000, 80_000, 0.42e-3, 0.39e-3)
    text = summary(found((), Gain(None, None, 0.1e-3), {}, part))
    assert 'searched: 10000 of 80000 rows; the others fall from 0.420 to 0.390 mm RMS' in text


def compared(name, value, other, sigmas, unit='rad/(N m)'):
    return Compared(name, unit, value, 1e-6, other, 1e-6, sigmas)


def confirmation(share, frozen, parameters, **more):
    answer = 'absent' if share is None else 'confirmed'
    evidence = {'shared': 0.0, 'own': -3.0, 'absent': -9.0}
    cause = ConfirmedCause(
        *('joint_compliance', (2, 4), share, 180, 0.9e-3, frozen, tuple(parameters)),
        *(answer, evidence),
    )
    given = {
        'rows': 200,
        'rows_common': 150,
        'rms_before_m': 0.9e-3,
        'rms_after_m': frozen,
        'rms_own_m': 0.3e-3,
        'rms_frozen_offsets_m': 0.31e-3,
        'carried_over': share,
        'effects': (cause,),
        'joint_offsets': (compared('joint_2', 0.1, 0.11, 1.0, 'deg'),),
        'confirmed': True,
        'same_offsets': True,
    }
    return Confirmation(**{**given, **more})


def test_an_offset_that_no_session_determines_is_no_other_one():
    session = found((EFFECT,), Gain(1e-3, 0.3e-3, 0.28e-3), {})
    rows = [compared('compliance_2', 2e-5, 2.1e-5, 0.7)]
    text = summary(session, confirmation(0.93, 0.35e-3, rows, open_joints=(5,)))
    assert 'it is the same arm' in text
    assert 'The zero-offset of joint 5 fits better as another one there, but the sessions' in text


def test_the_other_session_is_shown_side_by_side():
    session = found((EFFECT,), Gain(1e-3, 0.3e-3, 0.28e-3), {})
    rows = [compared('compliance_2', 2e-5, 2.1e-5, 0.7)]
    text = summary(session, confirmation(0.93, 0.35e-3, rows))
    assert '0.900 mm RMS without the causes, 0.350 mm with them as found' in text
    assert '93 % of what they could gain there' in text
    assert '150 of its 200 rows' in text
    assert 'Confirmed: both sessions share it (93 % of what it could gain from it' in text
    assert re.search(
        r'compliance_2 +\+0\.069 ± 0\.003 +\+0\.072 ± 0\.003 ′/\(N m\) +\+0\.7 σ', text
    )
    assert 'joint_2' in text
    values = [compared(f'curve_2_at_{i}', 1e-4, 2e-4, 2.0) for i in range(30)]
    text = summary(session, confirmation(0.93, 0.35e-3, values))
    assert (
        'Joint compliance of joints 2 and 4: 30 values, which differ by 2.0 standard deviations'
        in text
    )


def test_a_cause_that_was_cured_is_not_confirmed():
    session = found((EFFECT,), Gain(1e-3, 0.3e-3, 0.28e-3), {})
    text = summary(session, confirmation(None, 3.3e-3, [], confirmed=False))
    assert 'the causes could gain next to nothing there' in text
    assert 'does not show it (as found here it goes from 0.900 to 3.300 mm RMS)' in text
    assert 'nan' not in text


def test_why_nothing_can_be_compared_is_said():
    session = found((EFFECT,), Gain(1e-3, 0.3e-3, 0.28e-3), {})
    errors = (0.9e-3, 0.8e-3, 0.3e-3, 0.4e-3)
    nothing = Confirmation(*errors, None, (), False, False, rows=9, why='Too few rows.')
    text = summary(session, nothing)
    assert text.endswith('other session: Too few rows.')
    assert 'nan' not in text


def test_what_was_left_open_before_is_decided(tmp_path):
    simulated, out = tmp_path / 'session', tmp_path / 'causes'
    rival = LookAlike('base_compliance', (), 1.0, 'poses', title='Base compliance')
    open_one = replace(EFFECT, joints=(2,), confusable_with=(rival,))
    earlier = tmp_path / 'earlier.json'
    content = content_of(found((open_one,), Gain(None, None, 1e-4), {}))
    earlier.write_bytes(msgspec.json.encode(content))
    options = ('--poses', 20, '--validation', 6, '--sensors', 'mocap', '--seed', 1, '--quiet')
    remaster('simulate', simulated, *options, '--effect', 'joint_compliance@2:1')
    quick = ('--no-figures', '--seed', 1)
    said = remaster('discover', simulated, '--out', out, *quick, '--decide', earlier).stdout
    (decided,) = json.loads((out / 'discovery.json').read_text())['decided']
    assert decided['answer'] == 'cause'
    assert decided['sentence'] in said
    assert f'not base compliance; {decided["sigma"]:.1f} sigma' in decided['sentence']
    refusal('discover', simulated, '--out', out, '--decide', tmp_path / 'none')
