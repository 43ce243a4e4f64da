# SPDX-License-Identifier: Apache-2.0
"""Errors of a sensor are looked for only in sensors that can have them."""

from dataclasses import replace

import pytest
from worlds.calibration_scenes import scene

from remaster_ros.calibration.estimate import Problem, estimate
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.errors import InputError
from remaster_ros.session.records.reader import read_session, write_session


def session_of(kind):
    session, _ = scene(21, poses=14)
    return replace(session, sensor_kinds={name: kind for name in session.sensors if kind})


def tried(kind):
    """Names of the causes that are tried, and of their variants, of the sensors alone."""
    session = session_of(kind)
    context = Residuals.of(estimate(Problem.of(session))).context
    return {
        (candidate.name, candidate.variant, candidate.driver)
        for effect in EFFECTS.values()
        for candidate in effect.candidates(context)
        if candidate.subject in session.sensors
    }


def test_what_a_sensor_is_decides_what_may_be_wrong_with_it():
    unknown, camera = tried(''), tried('camera')
    tracker, controller = tried('tracker'), tried('controller')
    assert unknown == camera
    assert {name for name, *_ in camera} >= {'sensor_distortion', 'sensor_scale', 'sensor_field'}
    # It has no lens, and one measure for all directions.
    assert tracker < camera
    assert 'sensor_distortion' not in {name for name, *_ in tracker}
    assert {variant for name, variant, _ in tracker if name == 'sensor_scale'} == {''}
    assert controller == set()


def test_the_kind_is_kept_in_the_session(tmp_path):
    session = session_of('tracker')
    write_session(tmp_path / 'session', session)
    assert read_session(tmp_path / 'session').sensor_kinds == session.sensor_kinds
    # Nothing is written of what is not known.
    write_session(tmp_path / 'unknown', session_of(''))
    assert 'kind' not in (tmp_path / 'unknown' / 'session.yaml').read_text()
    header = tmp_path / 'session' / 'session.yaml'
    header.write_text(header.read_text().replace('kind: tracker', 'kind: theodolite'))
    with pytest.raises(InputError, match='theodolite'):
        read_session(tmp_path / 'session')
