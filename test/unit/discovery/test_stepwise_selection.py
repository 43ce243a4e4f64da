"""Steps of the search that only larger sessions come to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calibration_scenes import CHAIN, MARKERS, URDF, sensors
from discovery_scenes import residuals_of, session_with

from remaster_ros.calibration.estimate import Problem, estimate
from remaster_ros.calibration.priors import STEP_STD
from remaster_ros.discovery import proposals, stepwise_selection
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.evidence import solve
from remaster_ros.discovery.families import FAMILIES
from remaster_ros.discovery.proposals import SIGNIFICANCE
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.screening import screen
from remaster_ros.discovery.stepwise_selection import (
    DRAWS,
    EVIDENT,
    HYSTERESIS,
    LEAST_GAIN,
    Search,
)
from remaster_ros.discovery.substitutes import named_instead, regrown
from remaster_ros.discovery.undetected import natural_parameters
from remaster_ros.simulation.session_simulator import simulate_session
from remaster_ros.types import FloatArray, Session

SCALE = 50e-6
ECCENTRICITY_RAD = np.radians(0.03)


def searching(data: Residuals) -> Search:
    cells = tuple(
        cell
        for name, effect in EFFECTS.items()
        if name not in ('marker_offset', 'gear_periodic') and not effect.needs(data.context)
        for cell in effect.cells(data.context)
    )
    return Search(
        data, cells, np.random.default_rng(7), lambda data, solution: data, lambda share: None
    )


def proposed_by(search: Search, solution, screening):
    return proposals.propose(solution, screening, search.catalogue, search.fit, search.grown)


@pytest.mark.qualify
def test_curves_that_stand_in_for_a_weak_cause_give_way_to_it():
    """An eccentric encoder and a scale: curves of three joints explain both, and the scale better.

    It saves less than a cause has to that comes on top; in the place of two curves it need not.
    """
    rng = np.random.default_rng(1)
    middle, half = 0.5 * (CHAIN.lower + CHAIN.upper), 0.35 * (CHAIN.upper - CHAIN.lower)
    q = middle + half * rng.uniform(-1.0, 1.0, (2000, len(CHAIN)))
    session, _ = simulate_session(
        CHAIN,
        URDF,
        rng,
        poses=np.array_split(q, 400),
        sensors=sensors(rng, sigma_m=0.1e-3, pose_sigma_m=0.2e-3),
        markers={'sir': MARKERS['sir']},
    )
    m = session.measurements
    reported = m.q.copy()
    reported[:, 2] -= ECCENTRICITY_RAD * np.sin(m.q[:, 2])
    data = residuals_of(
        replace(session, measurements=replace(m, q=reported, position=(1 + SCALE) * m.position))
    )
    search = searching(data)
    cells = search.cells
    curves = [c for c in cells if c.name == 'joint_error_curve' and c.joints[0] in (2, 3, 6)]
    found = search.run(search.fit(curves))
    assert {(cell.name, cell.joints) for cell in found.solution.cells} == {
        ('encoder_eccentricity', (3,)),
        ('sensor_scale', ()),
    }
    assert 0.0 < found.steps[0].held_out_share < LEAST_GAIN


def waves_of_three_joints(session: Session) -> FloatArray:
    q = session.measurements.q
    angles = np.zeros_like(q)
    for joint, waves in ((1, 3), (3, 2), (5, 3)):
        angles[:, joint] = 0.6e-3 * np.sin(waves * q[:, joint])
    return angles


def bent(session: Session) -> FloatArray:
    place = session.measurements.position - session.measurements.position.mean(axis=0)
    return 2e-3 * np.sin(6.0 * place[:, [0]]) * np.array([0.6, 0.0, 0.8])


@pytest.mark.parametrize('where', ['joints', 'sensor'])
def test_a_field_gives_way_to_named_causes_that_together_explain_more_and_stays_otherwise(where):
    hidden = {'angles': waves_of_three_joints} if where == 'joints' else {'sensor': bent}
    search = searching(residuals_of(session_with(5, **hidden)))
    field = next(cell for cell in search.cells if cell.name == 'sensor_field')
    first = next(c for c in search.cells if c.name == 'joint_error_curve' and c.joints == (2,))
    begun = search.fit((first, field))
    found = named_instead(begun, search.fit, search.grown, HYSTERESIS)
    if where == 'sensor':
        assert found is begun
    else:
        assert found.log_evidence > begun.log_evidence
        assert {cell.name for cell in found.cells} == {'joint_error_curve'}
        assert {2, 4, 6} <= {cell.joints[0] for cell in found.cells}


def wound_up(session: Session) -> FloatArray:
    """Joint 2 turns by up to 0.1 degrees under what it carries."""
    context = residuals_of(session).context
    torque = next(
        cell.columns(context).values[:, 0]
        for cell in EFFECTS['joint_compliance'].cells(context)
        if cell.joints == (2,)
    )
    angles = np.zeros_like(session.measurements.q)
    angles[:, 1] = np.radians(0.1) * torque / np.abs(torque).max()
    return angles


def test_a_family_that_stands_in_for_a_member_of_another_gives_way_to_it():
    search = searching(residuals_of(session_with(6, angles=wound_up)))
    begun = search.with_all(search.fit(()), ('link_length', 'joint_axis_tilt'))
    few = replace(begun, cells=begun.cells[:2])
    assert regrown(few, search.with_all, search.prune) is few
    found = regrown(begun, search.with_all, search.prune)
    assert search.prune(begun).log_evidence < found.log_evidence - 10.0
    assert [(cell.name, cell.joints) for cell in found.cells] == [('joint_compliance', (2,))]


def test_steps_of_zero_offsets_have_a_prior_and_nothing_else_of_the_base_has():
    found = estimate(Problem.of(session_with(6)))
    data = Residuals.of(found)
    empty = solve(data, ())
    rng, joints = np.random.default_rng(3), found.model.joints
    for data_or_part in (data, data.only(data.rows.source[::2])):
        base = 1e-3 * rng.standard_normal(len(empty.base))
        step = natural_parameters(found, data_or_part, empty, replace(empty, base=base))
        square = base @ data_or_part.base_precision @ base
        assert square == pytest.approx(np.sum((step[:joints] / STEP_STD) ** 2), rel=1e-6)


def test_an_offset_that_the_readings_hardly_determine_stays_where_the_tangent_holds():
    data = residuals_of(session_with(6))
    values, axes = np.linalg.eigh(data.base_precision)
    degree, axis = 1.0 / np.sqrt(values[-1]), data.base @ axes[:, -1]
    noise = np.random.default_rng(4).standard_normal(axis.shape)
    # By these readings alone the step is 10 +- 3 degrees.
    errors = 10.0 * degree * axis + 3.0 * degree * noise
    for precision, least, most in (
        (data.base_precision, 0.0, 3.0),
        (0.0 * data.base_precision, 4.0, 16.0),
    ):
        found = solve(replace(data, errors=errors, base_precision=precision), ())
        assert least < axes[:, -1] @ found.base / degree < most


def test_chance_is_on_the_side_of_clear_evidence_only(monkeypatch):
    search = searching(residuals_of(session_with(6)))
    smaller = search.fit(())
    clear = replace(smaller, log_evidence=smaller.log_evidence + EVIDENT)
    doubtful = replace(smaller, log_evidence=smaller.log_evidence + 0.9 * EVIDENT)
    for share, error, expected in (
        (0.02, 0.0, (True, True)),
        (0.004, 0.007, (True, False)),
        (-0.004, 0.02, (True, False)),
        (0.004, 0.005, (False, False)),
        (-0.05, 0.01, (False, False)),
    ):
        monkeypatch.setattr(search._left_out, 'saved', lambda *_, values=(share, error): values)
        predicts = tuple(search.predicts(one, smaller, LEAST_GAIN) for one in (clear, doubtful))
        assert predicts == expected, (share, error)


def test_no_set_explains_eleven_readings_with_as_many_parameters():
    """Its noise would be nothing, and its evidence without bound."""
    session = session_with(5, poses=6, validation=0)
    m = session.measurements
    session = replace(session, measurements=m.select(np.unique(m.pose, return_index=True)[1]))
    data = residuals_of(session)
    assert len(data) < 12
    search = searching(data)
    assert search.fit(()) is not None
    links = [cell for cell in search.cells if cell.name == 'link_length']
    assert search.fit(links) is None


def test_a_round_is_not_repeated_from_a_set_it_began_with(monkeypatch):
    """What joins in a round and leaves at its end was added and dropped in every further round."""
    search = searching(residuals_of(session_with(6)))
    rounds = []

    def counted(*args, **options):
        rounds.append(options.get('draws') == DRAWS)
        return screen(*args, **options)

    def better(solution, *_):
        return replace(solution, log_evidence=solution.log_evidence + 10.0)

    monkeypatch.setattr(stepwise_selection, 'screen', counted)
    monkeypatch.setattr(stepwise_selection, 'regrown', better)
    monkeypatch.setattr(search, 'predicts', lambda *_: True)
    found = search.run()
    assert found.solution.cells == ()
    assert found.steps == ()
    assert sum(rounds) == 1


def test_a_cell_alone_that_chance_explains_is_not_proposed_and_a_family_is_tried():
    search = searching(residuals_of(session_with(5, angles=waves_of_three_joints)))
    empty = search.fit(())
    rng = np.random.default_rng(8)
    screening = screen(search.data, search.catalogue, empty, rng=rng, draws=DRAWS)
    sizes = {len(one.solution.cells) for one in proposed_by(search, empty, screening)}
    assert 1 in sizes
    assert max(sizes) > 1
    # As if surrogates scored as high as the best cell, but not as a family.
    higher = replace(screening, null=np.full_like(screening.null, screening.score.max()))
    for one in proposed_by(search, empty, higher):
        assert len(one.solution.cells) > 1 or one.p_value <= SIGNIFICANCE
        assert one.solution.log_evidence > empty.log_evidence


def test_what_waits_for_others_to_fail_is_proposed_after_them(monkeypatch):
    search = searching(residuals_of(session_with(5, angles=waves_of_three_joints)))
    empty = search.fit(())
    rng = np.random.default_rng(8)
    screening = screen(search.data, search.catalogue, empty, rng=rng, draws=DRAWS)
    fitted = []

    def counted(*args, **options):
        fitted.append(args[1])
        return solve(*args, **options)

    monkeypatch.setattr(stepwise_selection, 'solve', counted)
    # As if a fit never gained more than the screening shows.
    monkeypatch.setattr(proposals, 'SHOWN', 1.0)
    best = next(proposed_by(search, empty, screening))
    first = len(fitted)
    proposed = [one.solution.cells for one in proposed_by(search, empty, screening)]
    assert best.solution.cells == proposed[0]
    assert len(fitted) > first
    # All fitted before the first is proposed.
    for further in ('FURTHER', 'FURTHER_STRUCTURE', 'FURTHER_FAMILY'):
        monkeypatch.setattr(proposals, further, np.inf)
    ordered = list(proposed_by(search, empty, screening))
    assert ordered[0].solution.cells == proposed[0]
    assert {one.solution.cells for one in ordered} == set(proposed)
    gains = [one.solution.log_evidence for one in ordered]
    assert gains == sorted(gains, reverse=True)


def test_families_that_cannot_come_near_the_best_are_grown_once_that_has_failed():
    search = searching(residuals_of(session_with(5, angles=waves_of_three_joints)))
    empty = search.fit(())
    rng = np.random.default_rng(8)
    screening = screen(search.data, search.catalogue, empty, rng=rng, draws=DRAWS)
    tried = []

    def grown(solution, family):
        tried.append(family)
        return search.grown(solution, family)

    found = proposals.propose(empty, screening, search.catalogue, search.fit, grown)
    best = next(found).solution
    assert {cell.name for cell in best.cells} == {'joint_error_curve'}
    first = len(tried)
    assert first < len(FAMILIES)
    rest = list(found)
    assert sorted(tried) == sorted(FAMILIES)
    # What had to wait is nothing that would have been proposed first.
    assert all(one.solution.log_evidence < best.log_evidence for one in rest)


def test_chance_is_asked_once_whether_a_member_of_a_set_stays(monkeypatch):
    search = searching(residuals_of(session_with(5, angles=waves_of_three_joints)))
    found = search.fit([cell for cell in search.cells if cell.name == 'joint_error_curve'])
    asked = []

    def passes(cell, without, solution):
        asked.append((cell, frozenset(solution.cells)))
        return len(asked) % 2 == 0

    monkeypatch.setattr(search, '_passes', passes)
    left = search.backward_elimination(found)
    assert 0 < len(asked) == len(set(asked))
    count = len(asked)
    assert search.backward_elimination(found).cells == left.cells
    assert len(asked) == count
    # On other rows it is another question.
    search._look_at(search.data.only(search.data.rows.source[1:]))
    search.backward_elimination(search.fit(found.cells))
    assert len(asked) > count


def test_named_causes_in_place_of_structure_are_tried_once_and_again_where_they_gained(
    monkeypatch,
):
    search = searching(residuals_of(session_with(5, sensor=bent)))
    begun = search.fit([cell for cell in search.cells if cell.name == 'sensor_field'][:1])
    better = search.fit([cell for cell in search.cells if cell.name == 'joint_error_curve'][:1])
    answers = [begun, better]
    monkeypatch.setattr(stepwise_selection, 'named_instead', lambda solution, *_: answers.pop(0))
    assert search._named_instead(begun) is begun
    assert search._named_instead(begun) is begun
    assert len(answers) == 1
    search._look_at(search.data)
    assert search._named_instead(begun) is better


def test_what_was_fitted_is_not_fitted_again(monkeypatch):
    search = searching(residuals_of(session_with(5, angles=waves_of_three_joints)))
    curves = [cell for cell in search.cells if cell.name == 'joint_error_curve']
    found = search.fit(curves)

    def again(*_, **__):
        raise AssertionError('computed again')

    monkeypatch.setattr(stepwise_selection, 'solve', again)
    assert search.fit(curves[::-1]) is found
    # Other rows are another matter.
    search._look_at(search.data.only(search.data.rows.source[1:]))
    with pytest.raises(AssertionError, match='computed again'):
        search.fit(curves)


@pytest.mark.parametrize(('behind', 'tried'), [(200.0, 1), (40.0, 3)])
def test_families_that_cannot_make_up_for_structure_are_not_tried_beside_the_best(behind, tried):
    search = searching(residuals_of(session_with(5, sensor=bent)))
    named = search.fit([cell for cell in search.cells if cell.name == 'joint_error_curve'][:1])
    field = next(cell for cell in search.cells if cell.name == 'sensor_field')
    begun = replace(named, cells=(*named.cells, field), log_evidence=named.log_evidence + behind)
    passes = []

    def grown(solution, family):
        if family is FAMILIES[0]:
            passes.append(family)
        # Two families that gain something, in the first two passes.
        if family not in FAMILIES[:2] or len(passes) > 2:
            return None
        return replace(solution, log_evidence=solution.log_evidence + 15.0 / len(passes))

    assert named_instead(begun, lambda cells, start: named, grown, HYSTERESIS) is begun
    assert len(passes) == tried
