# SPDX-License-Identifier: Apache-2.0
"""What people are told of a cause: its heading, its sentence, and what to do, for every effect."""

import re
from dataclasses import replace

import numpy as np
import pytest
from worlds.calibration_scenes import scene
from worlds.discovery_scenes import residuals_of

from remaster_ros.calibration.gauge_words import the
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.explain import FoundEffect, in_words
from remaster_ros.discovery.guard import suggested
from remaster_ros.discovery.words import titled


@pytest.fixture(scope='module')
def context():
    """Return the rows of a session whose sensor and marker have the names that imports give."""
    session, _ = scene(3, poses=14)
    names = {'sir': 'marker', 'smr': 'marker_2'}
    markers = {names[name]: place for name, place in session.markers.items()}
    sensors = {'sensor': 'marker'}
    session = replace(session, sensors=sensors, markers=markers)
    return residuals_of(session).part


def one_each(context):
    """Return a cell of each place, driver and form of every effect."""
    found = {}
    for effect in EFFECTS.values():
        if not effect.needs(context):
            for candidate in effect.candidates(context):
                found.setdefault(
                    (candidate.name, candidate.place, candidate.driver, candidate.form), candidate
                )
    return list(found.values())


def groups(context):
    """Return every cause that may be found: one cell, or those of two joints together."""
    for candidate in one_each(context):
        yield (candidate,)
        if len(candidate.joints) == 1 and EFFECTS[candidate.name].cause_per == 'effect':
            other = 1 + candidate.joints[0] % context.joints
            yield (candidate, replace(candidate, joints=(other,)))


def test_no_sentence_names_a_thing_twice_or_has_a_plural_with_a_singular_verb(context):
    candidates = one_each(context)
    assert {candidate.place for candidate in candidates} >= {
        'sensor_frame',
        'marker',
        'joint_angle',
    }
    for group in groups(context):
        joints = tuple(sorted({joint for candidate in group for joint in candidate.joints}))
        draws = np.full((2, group[0].size), 1e-4)
        sentences = [
            in_words(group, context),
            titled(group[0], joints),
            EFFECTS[group[0].name].size(context, group[0], draws),
        ]
        for text in sentences:
            assert not re.search(r'\b(sensor|marker) \1\b', text, re.IGNORECASE), text
            assert not re.search(r'(?<!of )joints \d and \d (still )?(\w+s|is|has)\b', text), text
            assert '{' not in text
            assert 'unnamed' not in text


def test_names_that_tell_the_kind_are_not_preceded_by_it():
    assert the('sensor', 'sensor') == 'the sensor'
    assert the('sensor', 'sensor_2') == 'sensor_2'
    assert the('sensor', 'mocap') == 'the sensor mocap'


def test_headings_say_what_happened_and_where(context):
    titles = {titled(candidate, candidate.joints) for candidate in one_each(context)}
    for title in (
        'Joint 1 slipped',
        'The sensor moved',
        'The marker moved',
        'Link length of joint 1',
        'Sensor scale',
        'Base rotation: an error that follows time',
    ):
        assert title in titles, titles


def test_what_a_remedy_calls_for_is_named_in_it(context):
    """No remedy refers to measurements, or to a file, that nothing names."""
    for candidate in one_each(context):
        remedy = EFFECTS[candidate.name].remedy.format(driver=candidate.driver.replace('_', ' '))
        assert 'measurements named' not in remedy
        assert '{' not in remedy
        if candidate.name == 'unnamed':
            assert f'poses in which {candidate.driver.replace("_", " ")} changes' in remedy
        if candidate.name == 'base_compliance':
            # Two arms of one type are equally soft: then bolts are not the remedy.
            assert 'another arm of the type' in remedy
            assert 'dial gauge' in remedy


def test_a_guard_names_joint_place_and_minute():
    slip = FoundEffect(
        name='unnamed',
        joints=(3,),
        place='joint_angle',
        driver='time',
        form='step',
        parameters=(),
        p_value=0.003,
        log_evidence_gain=40.0,
        confusable_with=(),
        cause='The joint angle of joint 3 jumped.',
        size_m=1e-3,
        title='Joint 3 slipped',
        moment_s=455.0,
    )
    assert suggested([slip]) == 'joint 3 slipped 7.6 min after the first reading'
