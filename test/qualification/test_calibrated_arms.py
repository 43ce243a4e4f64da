# SPDX-License-Identifier: Apache-2.0
"""Ten makers' arms as calibrations describe them, each joint elsewhere, can be planned."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from rigs.command_line import remaster
from worlds.robot_descriptions import iiwa14, panda, xarm6, xarm7

CASES = Path(__file__).parents[2].parent / 'shared' / 'cases'
OF_CASES = ('ur5e', 'irb120', 'kr6', 'fer', 'meca500', 'fanuc_lrmate')
# Errors of lengths (m) and tilts (rad) per axis, as calibrations of delivered arms have them.
LENGTH_M, TILT_RAD = 2e-4, 1.5e-3


@pytest.mark.qualify
@pytest.mark.parametrize(
    'arm', [*OF_CASES, iiwa14, panda, xarm6, xarm7], ids=lambda arm: getattr(arm, '__name__', arm)
)
def test_arms_with_calibrated_parameters_are_prepared_and_planned(arm, tmp_path):
    pytest.importorskip('pinocchio', reason='needs the judge: pip install pin')
    from judges.inverse_kinematics import with_errors

    seed = 5
    print(f'seed {seed}')
    if callable(arm):
        urdf = arm().urdf
    elif (CASES / f'{arm}.urdf').exists():
        urdf = (CASES / f'{arm}.urdf').read_text()
    else:
        pytest.skip(f'{CASES} is not here')
    description, cell = tmp_path / 'arm.urdf', tmp_path / 'cell.yaml'
    description.write_text(with_errors(urdf, LENGTH_M, TILT_RAD, np.random.default_rng(seed)))
    assert "by Newton's method" in remaster('init', description, '--out', cell).stdout
    plan = json.loads(remaster('plan', cell, '--json').stdout)
    assert plan['splits']['optimization']['poses'] >= 12
    assert plan['goal']['reached']
