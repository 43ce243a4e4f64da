"""What was wanted, and whether a correction was on: columns and a key that may be left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calibration_scenes import scene

from remaster_ros.errors import InputError
from remaster_ros.session.reader import read_session, write_session
from remaster_ros.session.together import together
from remaster_ros.types import Correction, Session


def corrected() -> Session:
    session, _ = scene(3, poses=4)
    m = session.measurements
    wanted = m.q + 1e-3
    wanted[1] = np.nan
    state = np.arange(len(m)) % 3 - 1
    return replace(
        session,
        measurements=replace(m, wanted=wanted, correction=state),
        correction=Correction('layer', 'abc'),
        accuracy_option='inactive',
    )


def test_they_survive_the_round_trip(tmp_path):
    made = corrected()
    write_session(tmp_path, made)
    read = read_session(tmp_path)
    np.testing.assert_array_equal(read.measurements.wanted, made.measurements.wanted)
    np.testing.assert_array_equal(read.measurements.correction, made.measurements.correction)
    assert read.correction == Correction('layer', 'abc')
    assert read.accuracy_option == 'inactive'
    assert not read.extra
    header, first = (tmp_path / 'observations.csv').read_text().splitlines()[:2]
    assert header.split(',')[-1] == 'correction'
    assert first.endswith(',')
    (both, _) = together([('a', read), ('b', replace(scene(4, poses=4)[0], notes='b'))])
    assert set(both.measurements.correction[len(made.measurements) :].tolist()) == {-1}


@pytest.mark.parametrize(
    ('old', 'new', 'words'),
    [
        (',off\n', ',perhaps\n', "'perhaps' is neither on nor off"),
        ('wanted1_rad', 'wanted9_rad', 'columns wanted…_rad'),
    ],
)
def test_what_is_none_is_refused_with_its_place(tmp_path, old, new, words):
    write_session(tmp_path, corrected())
    path = tmp_path / 'observations.csv'
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=words):
        read_session(tmp_path)
