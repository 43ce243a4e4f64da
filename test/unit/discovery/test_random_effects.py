# SPDX-License-Identifier: Apache-2.0
"""Kinds of errors in one model: those with a name stay, of the others those that show."""

import numpy as np
import pytest
from worlds.calibration_scenes import CHAIN
from worlds.discovery_scenes import at_joint, residuals_of, session_with

from remaster_ros.discovery import random_effects
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.random_effects import fit_kinds, kinds
from remaster_ros.discovery.residuals import Residuals

SMALL, LARGE = 'every joint_compliance', 'every joint_coupling'


def sagging(session):
    return at_joint(2, 1e-4 * CHAIN.gravity_torque(session.measurements.q)[:, 1])


@pytest.fixture(scope='module', params=[True, False], ids=['sagging', 'clean'])
def scene(request) -> tuple[Residuals, bool]:
    data = residuals_of(session_with(31, sagging if request.param else None, poses=30))
    return data, request.param


@pytest.mark.parametrize('many', [False, True], ids=['all at once', 'large kinds later'])
def test_kinds_with_a_name_stay_and_of_the_others_those_that_show(scene, many, monkeypatch):
    data, sags = scene
    monkeypatch.setattr(random_effects, 'MANY_ROWS', 0.0 if many else np.inf)
    names = 'joint_compliance', 'joint_coupling', 'backlash', 'encoder_scale'
    cells = [
        cell
        for name in names
        if not EFFECTS[name].needs(data.context)
        for cell in EFFECTS[name].cells(data.context)
    ]
    families = {family.cell.name: family for family in kinds(data, cells)}
    assert families[LARGE].cell.size > random_effects.FEW_WEIGHTS > families[SMALL].cell.size
    for named in ((), (LARGE,), (SMALL, LARGE)):
        others = [family for name, family in families.items() if name not in named]
        found = fit_kinds(data, (), [families[name] for name in named], others)
        assert found is not None
        there = {cell.name for cell in found.cells}
        assert there >= set(named), 'what has a name is in the model whatever the data show'
        if sags:
            assert SMALL in there
        if not named:
            # By chance half of all variances have a value: nothing more than that.
            whole = fit_kinds(data, (), list(families.values()))
            assert whole is not None
            assert len(found.cells) < len(whole.cells) == len(families)
            assert found.log_evidence > whole.log_evidence - len(families) * random_effects.GAIN
