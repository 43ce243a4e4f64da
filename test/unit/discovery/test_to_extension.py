"""From a search to the model that is sampled: where the zero-offsets may go beside its effects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from discovery_scenes import session_with

from remaster_ros.calibration.estimate import Problem, estimate
from remaster_ros.calibration.priors import OFFSET_STD, STEP_STD
from remaster_ros.discovery.evidence import solve
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.to_extension import extension_of, offsets_of


@pytest.mark.parametrize('marker_std_m', [0.5e-3, 5e-3])
def test_offsets_stay_near_those_of_the_search_unless_they_were_hardly_known(marker_std_m):
    session = replace(session_with(7, poses=15), marker_std_m=marker_std_m)
    found = estimate(Problem.of(session))
    residuals = Residuals.of(found)
    nothing = solve(residuals, ())
    assert nothing is not None
    extension = extension_of(residuals, nothing, found)
    offsets, std = offsets_of(found)
    np.testing.assert_array_equal(extension.joint_offsets, offsets)
    allowed = extension.joint_offsets_std
    assert allowed is not None
    # Joint 1 is held; the last one is known as well as the marker, 100 mm beside its axis.
    assert np.isnan(std[0])
    assert allowed[0] == OFFSET_STD
    np.testing.assert_allclose(allowed[1:6], STEP_STD)
    assert std[6] == pytest.approx(marker_std_m / 0.1, rel=0.3)
    assert allowed[6] == pytest.approx(max(STEP_STD, 3.0 * std[6]))
