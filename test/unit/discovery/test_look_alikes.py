"""The decision between look-alikes: of two cells, of one of them, and of a free form."""

from dataclasses import replace
from functools import cache, partial

import numpy as np
from discovery_scenes import at_joint, residuals_of, session_with

from remaster_ros.calibration.estimate import Problem, estimate
from remaster_ros.discovery import discover
from remaster_ros.discovery.catalogue import Catalogue
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.evidence import Solution, solve
from remaster_ros.discovery.explain import TIED, LookAlike, describe
from remaster_ros.discovery.model_averaging import moved_by_look_alikes
from remaster_ros.discovery.plain_forms import is_special_case, plainest
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.selection import Selection, Step
from remaster_ros.types import Session

ARC_MINUTE = np.radians(1.0 / 60.0)


def wavy(seed: int) -> Session:
    """Return a session with an eccentric encoder of joint 2."""
    return session_with(
        seed, lambda s: at_joint(2, 3 * ARC_MINUTE * np.sin(s.measurements.q[:, 1]))
    )


@cache
def eccentric() -> Residuals:
    """Return what an eccentric encoder of joint 2 leaves."""
    return residuals_of(wavy(41))


def cells_of(data: Residuals, name: str, *joints: int):
    return [
        cell for cell in EFFECTS[name].cells(data.context) if cell.joints in [(j,) for j in joints]
    ]


def fitted(data: Residuals, cells) -> Solution:
    found = solve(data, tuple(cells))
    assert found is not None
    return found


def described(data: Residuals, selection: Selection, cells):
    catalogue = Catalogue.of(data, cells)
    return describe(data, selection, catalogue, partial(solve, data), lambda share: None)


def plain(data: Residuals, cells, before: Solution) -> Solution:
    return plainest(before, data, Catalogue.of(data, cells), partial(solve, data))


def selected(data: Residuals, cells) -> Selection:
    solution = fitted(data, cells)
    gain = solution.log_evidence - fitted(data, ()).log_evidence
    return Selection(fitted(data, ()), solution, (Step(tuple(cells), 0.003, 0.5, gain),), None)


def test_a_free_form_gives_way_to_the_shape_that_explains_as_much():
    data = eccentric()
    named = [*cells_of(data, 'encoder_eccentricity', 2, 4), *cells_of(data, 'joint_compliance', 2)]
    (curve,) = cells_of(data, 'joint_error_curve', 2)
    cells = [*named, curve]
    assert [is_special_case(cell, curve) for cell in named] == [
        (cell.name, cell.joints) == ('encoder_eccentricity', (2,)) for cell in named
    ]
    assert not is_special_case(curve, named[0])
    before = fitted(data, [curve])
    found = plain(data, cells, before)
    assert [(cell.name, cell.joints) for cell in found.cells] == [('encoder_eccentricity', (2,))]
    assert found.log_evidence > before.log_evidence - TIED


def test_a_free_form_that_is_better_stays():
    data = residuals_of(
        session_with(
            42, lambda s: at_joint(2, 3 * ARC_MINUTE * np.cos(7 * s.measurements.q[:, 1]))
        )
    )
    cells = [*cells_of(data, 'encoder_eccentricity', 2), *cells_of(data, 'joint_error_curve', 2)]
    before = fitted(data, cells[-1:])
    assert plain(data, cells, before) is before

    def hopeless(*_: object) -> Solution:
        raise AssertionError('a shape was fitted that explains next to nothing')

    assert plainest(before, data, Catalogue.of(data, cells), hopeless) is before


def test_a_free_form_leaves_the_shape_that_was_found_in_no_doubt():
    data = eccentric()
    (curve,) = cells_of(data, 'joint_error_curve', 2)
    shapes = cells_of(data, 'encoder_eccentricity', 2)
    _, (effect,) = described(data, selected(data, shapes[:1]), [*shapes, curve])
    listed = {other.name: other for other in effect.confusable_with}
    if curve.name in listed:
        assert listed[curve.name].general
    assert not effect.tied


def test_what_two_cells_explain_may_be_one_other_or_one_of_them():
    """A link's length that two scales imitate, the second of which is there by chance alone."""
    data = eccentric()
    both = cells_of(data, 'encoder_scale', 2, 6)
    others = [*both, *cells_of(data, 'encoder_eccentricity', 2)]
    _, (effect,) = described(data, selected(data, both), others)
    assert effect.joints == (2, 6)
    listed = {(other.name, other.joints) for other in effect.confusable_with}
    assert ('encoder_scale', (2,)) in listed
    assert ('encoder_eccentricity', (2,)) in listed
    assert effect.tied


def test_the_largest_cause_is_in_doubt_also_where_held_out_poses_gain_nothing(monkeypatch):
    session = session_with(41, lambda s: at_joint(2, ARC_MINUTE * np.sin(s.measurements.q[:, 1])))
    find = discover.find_causes

    def tied(*args, **options):
        found = find(*args, **options)
        assert found.effects
        first = replace(found.effects[0], tied=True, share=0.0)
        return replace(found, effects=(first, *found.effects[1:]))

    monkeypatch.setattr(discover, 'find_causes', tied)
    found = discover.discover_session(session, rng=np.random.default_rng(0))
    assert found.verdict == 'undetermined'


def test_a_look_alike_widens_the_posterior_by_how_likely_it_is():
    session = session_with(
        42, lambda s: at_joint(2, 3 * ARC_MINUTE * np.sin(s.measurements.q[:, 1]))
    )
    found = estimate(Problem.of(session))
    data = Residuals.of(found)
    selection = selected(data, cells_of(data, 'encoder_eccentricity', 2)[:1])
    solution = selection.solution
    groups, (effect,) = described(data, selection, solution.cells)
    assert effect.confusable_with == ()
    gain = effect.log_evidence_gain
    alike = LookAlike('joint_compliance', (3,), gain - 1.0, '')
    others = (replace(alike, same=True), replace(alike, general=True))
    either = replace(effect, confusable_with=(alike, *others))
    none = replace(effect, confusable_with=others)
    assert moved_by_look_alikes(found, data, selection, [none], groups).shape[1] == 0
    moves = moved_by_look_alikes(found, data, selection, [either], groups)
    weight = 1.0 / (1.0 + np.e)
    own = slice(found.model.size, None)
    np.testing.assert_allclose(moves[own, 0], -np.sqrt(weight) * solution.parameters, rtol=1e-9)
    # The zero-offsets of the other set are others, by what its own cell does not take.
    other = fitted(data, cells_of(data, 'joint_compliance', 3))
    columns = data.full_jacobian[data.rows.source] @ moves[: found.model.size, 0]
    expected = np.sqrt(weight) * data.base @ (other.base - solution.base)
    np.testing.assert_allclose(columns, expected, atol=1e-3 * np.abs(expected).max())
