# SPDX-License-Identifier: Apache-2.0
"""Sessions measured with a correction on: what is told of them, and how they are fitted."""

from dataclasses import replace

import numpy as np
import pytest
from rigs.command_line import refusal, remaster
from worlds.calibration_scenes import scene

from remaster_ros.calibration.fit import fit_session
from remaster_ros.errors import InputError
from remaster_ros.session.records.reader import write_session
from remaster_ros.session.records.together import together
from remaster_ros.types import Correction, Session


def layer(seed: int, form: str = 'robot_bridge') -> tuple[Session, np.ndarray]:
    """A session measured with the true zero-offsets taken off beside the controller."""
    session, truth = scene(seed, poses=30, validation=10)
    m = session.measurements
    wanted = m.q + truth.joint_offsets
    on = np.ones(len(m), np.int64)
    rows = replace(m, wanted=wanted, correction=on)
    return replace(session, measurements=rows, correction=Correction(form, 'ab12')), wanted


@pytest.mark.parametrize(
    ('form', 'words'),
    [
        ('robot_bridge', 'the whole ones again, take its place and never come on top of it'),
        ('urdf', 'the whole ones again'),
        ('pad', 'are what remains, and come on top of it'),
        ('something', 'cannot be told; give session.yaml the key correction with form'),
    ],
)
def test_what_the_offsets_found_are_is_told(form, words):
    session, _ = layer(5, form)
    note = session.correction_note
    assert note.startswith(f'Measured with a correction on ({form}, checksum ab12)')
    assert words in note
    m = session.measurements
    off = replace(session, measurements=replace(m, correction=np.zeros(len(m), np.int64)))
    assert off.correction_note == ''
    assert scene(6, poses=4)[0].correction_note == ''


def test_fit_says_so_and_the_rows_through_the_correction_have_none_left(tmp_path):
    """Seeds are fixed: of 7 joints at 99 % each one session in 14 would have one outside."""
    session, wanted = layer(7)
    write_session(tmp_path / 's', session)
    printed = remaster('fit', tmp_path / 's', '--out', tmp_path / 'fit', '--no-figures')
    assert 'the whole ones again' in printed.stdout
    raw = fit_session(session, rng=np.random.default_rng(1), draws=200)
    known = raw.identifiable
    assert np.any(np.abs(raw.joint_offsets / raw.joint_offsets_std)[known] > 10.0)
    through = session.through_correction()
    np.testing.assert_array_equal(through.measurements.q, wanted)
    assert through.correction is None
    fit = fit_session(through, rng=np.random.default_rng(1), draws=200)
    assert np.all(np.abs(fit.joint_offsets / fit.joint_offsets_std)[known] < 2.58)


def test_rows_through_a_correction_need_what_was_wanted():
    session, _ = layer(8)
    m = session.measurements
    with pytest.raises(ValueError, match='does not tell what was wanted'):
        replace(session, measurements=replace(m, wanted=None)).through_correction()
    with pytest.raises(ValueError, match='no row has a correction on'):
        scene(6, poses=4)[0].through_correction()


def test_reported_angles_that_mean_two_things_are_not_fitted(tmp_path):
    session, _ = layer(9, 'pad')
    m = session.measurements
    write_session(tmp_path / 'on', replace(session, notes='on'))
    mixed = replace(m, correction=np.arange(len(m)) % 2)
    write_session(tmp_path / 'mixed', replace(session, measurements=mixed))
    said = refusal('fit', tmp_path / 'mixed', '--out', tmp_path / 'x')
    assert 'reported angles mean two things' in said
    other, _ = scene(10, poses=4)
    with pytest.raises(InputError, match='different corrections in the controller'):
        together([('on', session), ('other', replace(other, notes='b'))])
    # Beside the controller they are the same arm.
    layered, _ = layer(9)
    both, _ = together([('layer', layered), ('other', replace(other, notes='b'))])
    assert set(both.measurements.correction[len(layered.measurements) :].tolist()) == {-1}
