# SPDX-License-Identifier: Apache-2.0
"""The decision between look-alikes: of two cells, of one of them, and of a free form."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from worlds.discovery_scenes import at_joint, discovered, residuals_of, session_with

from remaster_ros.discovery import discover
from remaster_ros.discovery.causes import Search, is_special_case
from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.explain import describe
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.screening import screen
from remaster_ros.discovery.solution import Solution
from remaster_ros.types import Session

ARC_MINUTE = np.radians(1.0 / 60.0)


def wavy(seed: int, minutes: float = 3.0) -> Session:
    """Return a session with an eccentric encoder of joint 2, by so many minutes of arc."""
    return session_with(
        seed, lambda s: at_joint(2, minutes * ARC_MINUTE * np.sin(s.measurements.q[:, 1]))
    )


@cache
def eccentric() -> Residuals:
    """Return what an eccentric encoder of joint 2 leaves."""
    return residuals_of(wavy(41))


def cells_of(data: Residuals, name: str, *joints: int) -> list[Cell]:
    return [
        cell for cell in EFFECTS[name].cells(data.context) if cell.joints in [(j,) for j in joints]
    ]


def fitted(search: Search, cells: list[Cell]) -> Solution:
    found = search.fit(cells)
    assert found is not None
    return found


def described(search: Search, solution: Solution):
    return describe(search, solution, lambda share: None)


def test_the_shapes_that_a_curve_can_have_are_special_cases_of_it():
    data = eccentric()
    named = [*cells_of(data, 'encoder_eccentricity', 2, 4), *cells_of(data, 'joint_compliance', 2)]
    (curve,) = cells_of(data, 'joint_error_curve', 2)
    assert [is_special_case(cell, curve) for cell in named] == [
        (cell.name, cell.joints) == ('encoder_eccentricity', (2,)) for cell in named
    ]
    assert not is_special_case(curve, named[0])


def test_a_wave_is_named_by_its_shape_and_not_as_a_curve():
    data = eccentric()
    cells = [*cells_of(data, 'encoder_eccentricity', 2), *cells_of(data, 'joint_error_curve', 2)]
    found = Search(data, cells).run()
    assert {cell.name for cell in found.cells} == {'encoder_eccentricity'}


def test_a_free_form_leaves_the_shape_that_was_found_in_no_doubt():
    data = eccentric()
    (curve,) = cells_of(data, 'joint_error_curve', 2)
    shapes = cells_of(data, 'encoder_eccentricity', 2)
    search = Search(data, [*shapes, curve])
    _, (effect,) = described(search, fitted(search, shapes[:1]))
    listed = {other.name: other for other in effect.confusable_with}
    if curve.name in listed:
        assert listed[curve.name].general
    assert not effect.tied


def test_what_two_cells_explain_may_be_one_other_or_one_of_them():
    """A link's length that two scales imitate, the second of which is there by chance alone."""
    data = eccentric()
    both = cells_of(data, 'encoder_scale', 2, 6)
    search = Search(data, [*both, *cells_of(data, 'encoder_eccentricity', 2)])
    _, (effect,) = described(search, fitted(search, both))
    assert effect.joints == (2, 6)
    listed = {(other.name, other.joints) for other in effect.confusable_with}
    assert ('encoder_eccentricity', (2,)) in listed
    assert effect.tied


def test_what_is_taken_out_of_a_set_is_promised_as_much_as_it_brings():
    """Else strong causes are never exchanged for what explains more in their place."""
    data = residuals_of(wavy(41, 30.0))
    cells = [
        *cells_of(data, 'encoder_eccentricity', 2)[:1],
        *cells_of(data, 'encoder_scale', 4, 6),
    ]
    search = Search(data, cells)
    whole = fitted(search, cells)
    scores = []
    for cell in cells:
        rest = search.without(whole, cell)
        scores.append(screen(data, search.catalogue, rest, known_noise=True))
        assert rest.log_evidence + scores[-1][cells.index(cell)] == pytest.approx(
            whole.log_evidence, abs=1.0
        )
    # It is strong: with the noise estimated again without it the score would be too low by far.
    rest = search.without(whole, cells[0])
    assert screen(data, search.catalogue, rest)[0] < scores[0][0] - 20.0


def test_a_curve_is_not_fitted_beside_a_family_that_has_it():
    """Its parameters would be there twice, and `discover` ended in a traceback."""
    data = eccentric()
    curves = cells_of(data, 'joint_error_curve', 2, 3, 4)
    search = Search(data, curves)
    (family,) = search.families
    assert search.fit([family.cell]) is not None
    assert search.fit([family.cell, curves[0]]) is None


@pytest.mark.qualify
def test_the_largest_cause_is_in_doubt_also_where_held_out_poses_gain_nothing(monkeypatch):
    session = session_with(41, lambda s: at_joint(2, ARC_MINUTE * np.sin(s.measurements.q[:, 1])))
    found = discover.describe

    def tied(*args):
        groups, effects = found(*args)
        assert effects
        return groups, (replace(effects[0], tied=True, share=0.0), *effects[1:])

    monkeypatch.setattr(discover, 'describe', tied)
    assert discovered(session).verdict == 'undetermined'
