"""Gross errors among held-out readings: no fit leaves them out, and no page with them is green."""

from dataclasses import replace

import numpy as np
from worlds.calibration_scenes import scene

from remaster_ros.calibration.fit import fit_session
from remaster_ros.reports.sentences import verdict


def test_held_out_gross_errors_that_make_up_the_error_are_named_and_not_green():
    session, _ = scene(61, poses=30, validation=20, sigma_m=0.1e-3, pose_sigma_m=0.0)
    clean = fit_session(session, rng=np.random.default_rng(0), precision=0.05)
    assert [check.spoilt for check in clean.noise_checks] == ['']
    assert verdict(clean).mood == 'good'
    m = session.measurements
    wrong = np.flatnonzero(m.is_validation)[3::25]
    position = m.position.copy()
    position[wrong] += 0.04
    spoilt = replace(session, measurements=replace(m, position=position))
    result = fit_session(spoilt, rng=np.random.default_rng(0), precision=0.05)
    (check,) = result.noise_checks
    assert check.gross == tuple(m.observation[wrong].tolist())
    assert str(m.observation[wrong[0]]) in check.spoilt
    found = verdict(result)
    assert found.mood == 'caution'
    assert check.spoilt in found.points
