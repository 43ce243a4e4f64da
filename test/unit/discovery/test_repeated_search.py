"""What many causes chosen from few rows are worth is seen where the search is repeated."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from discovery_scenes import at_joint, session_with
from scipy.stats import chi2

from remaster_ros.calibration.estimate import Estimate, Problem, estimate
from remaster_ros.calibration.predictions import REGION, squared_distances
from remaster_ros.discovery import discover
from remaster_ros.discovery.discover import discover_session
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.repeated_search import (
    GROUPS,
    RepeatedSearch,
    repeat_search,
    row_covariance,
)
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.discovery.stepwise_selection import Search
from remaster_ros.reports.discovery_json import discovery_content
from remaster_ros.types import FloatArray, Session

TRIED = (
    'joint_error_curve',
    'encoder_eccentricity',
    'link_length',
    'joint_axis_tilt',
    'joint_compliance',
)
SEEDS = (71, 72, 73, 74)
WAVES_RAD = 0.5e-3
# Joint 3 is held at a few angles; the outer two are not identifiable.
OFFSETS = [1, 3, 4, 5]


def waves_of_all_joints(session: Session) -> FloatArray:
    q = session.measurements.q
    return WAVES_RAD * np.sin(4.0 * q + np.arange(q.shape[1]))


def one_row_of_each_pose(session: Session) -> Session:
    first = np.unique(session.measurements.pose, return_index=True)[1]
    return session.select(np.sort(first))


@cache
def searched(seed: int) -> tuple[Estimate, Search, Solution, RepeatedSearch | None]:
    session = session_with(seed, waves_of_all_joints, poses=40, validation=60, pose_sigma_m=0.0)
    found = estimate(Problem.of(one_row_of_each_pose(session)))
    data = Residuals.of(found)
    cells = tuple(cell for name in TRIED for cell in EFFECTS[name].cells(data.context))
    rng = np.random.default_rng(7)
    search = Search(data, cells, rng, lambda data, _: data, lambda _: None)
    solution = search.run().solution
    return found, search, solution, repeat_search(found, search, solution, lambda _: None)


def test_regions_hold_poses_that_the_choice_of_causes_has_not_seen():
    limit, inside = chi2.ppf(REGION, 3), []
    for seed in SEEDS:
        _, search, solution, repeated = searched(seed)
        assert repeated is not None
        assert repeated.widening > 1.0
        data = search.data
        held_out = data.only(np.flatnonzero(data.context.measurements.is_validation))
        errors = data.unexplained(solution)[held_out.rows.source]
        distances = squared_distances(errors, row_covariance(held_out, solution))
        inside += [
            (np.mean(distances <= limit), np.mean(distances <= limit * repeated.widening**2))
        ]
    print('share of held-out rows inside, without and with repeated searches', inside)
    without, with_repeated = np.mean(inside, axis=0)
    assert without < with_repeated
    assert with_repeated > REGION


def test_parameters_contain_how_far_the_searches_differ():
    for seed in SEEDS:
        found, _, solution, repeated = searched(seed)
        assert repeated is not None
        size = found.model.size
        assert repeated.solution.cells[: len(solution.cells)] == solution.cells
        assert repeated.moves.shape == (size + len(repeated.solution.parameters), GROUPS)
        assert 0 <= repeated.same <= repeated.count == GROUPS
        np.testing.assert_allclose(
            repeated.moves.sum(axis=1), 0.0, atol=1e-9 * np.abs(repeated.moves).max()
        )
        held = np.setdiff1d(np.arange(size), found.posterior.free)
        assert np.all(repeated.moves[held] == 0.0)
        std = np.linalg.norm(repeated.moves, axis=1)
        assert np.all(std[OFFSETS] > 0.0)
        # An offset is not known better than to a part of the waves, nor worse than their height.
        assert np.all(std[OFFSETS] < 2.0 * WAVES_RAD)


def test_the_rest_of_the_discovery_has_the_same_random_numbers():
    found, search, solution, _ = searched(SEEDS[0])
    before = search.rng.bit_generator.state
    assert repeat_search(found, search, solution, lambda _: None) is not None
    assert search.rng.bit_generator.state == before


def test_one_cause_of_many_rows_is_not_searched_for_again():
    session = session_with(75, lambda s: at_joint(4, 1e-3 * np.sin(s.measurements.q[:, 3])))
    found = estimate(Problem.of(session))
    data = Residuals.of(found)
    cells = tuple(EFFECTS['encoder_eccentricity'].cells(data.context))
    search = Search(data, cells, np.random.default_rng(8), lambda data, _: data, lambda _: None)
    solution = search.run().solution
    assert solution.cells
    assert repeat_search(found, search, solution, lambda _: None) is None


def test_the_result_says_that_the_search_was_repeated():
    session = session_with(72, waves_of_all_joints, poses=40, validation=20, pose_sigma_m=0.0)
    found = discover_session(one_row_of_each_pose(session), rng=np.random.default_rng(1))
    content = discovery_content(found)
    assert found.repeated is not None
    assert content.repeated_search.count == GROUPS
    assert content.predicted_regions95.widening == found.widening
    assert found.widening == max(found.repeated.widening, found.stretches.widening)
    for same, said in ((1, True), (4, False)):
        repeated = replace(found.repeated, same=same)
        other = replace(found, verdict='effects', repeated=repeated)
        judged = discovery_content(other).judgement
        assert ('depends on the poses: of 5 searches' in judged.headline) == said
        assert judged.mood == 'caution' or not said


def test_the_model_has_what_the_searches_found_and_says_how_many_did():
    session = session_with(72, waves_of_all_joints, poses=40, validation=20, pose_sigma_m=0.0)
    found = discover_session(one_row_of_each_pose(session), rng=np.random.default_rng(1))
    repeated, selection = found.repeated, found.selection
    assert repeated is not None
    listed = discovery_content(found).repeated_search.found
    assert all(1 <= one.searches <= GROUPS + 1 for one in listed)
    named = {(one.name, joint) for one in found.effects for joint in one.joints}
    assert {(one.name, *one.joints) for one in listed if one.named} == named
    assert len(found.fit.theta) == sum(cell.size for cell in selection.solution.cells)
    assert selection.before_combining is not None
    assert selection.solution.cells[: len(selection.chosen.cells)] == selection.chosen.cells


def test_where_the_mean_does_not_hold_the_search_of_all_rows_stands(monkeypatch):
    session = session_with(72, waves_of_all_joints, poses=40, validation=20, pose_sigma_m=0.0)
    monkeypatch.setattr(discover, 'holds', lambda *_: False)
    found = discover_session(one_row_of_each_pose(session), rng=np.random.default_rng(1))
    assert found.repeated is not None
    assert found.selection.before_combining is None
    size = len(found.selection.solution.parameters)
    assert found.repeated.solution is found.selection.solution
    assert len(found.repeated.moves) == found.residuals.full_jacobian.shape[2] + size
    assert len(found.fit.theta) == size
    content = discovery_content(found)
    assert all(one.named for one in content.repeated_search.found)


def test_fifteen_poses_are_searched_again():
    session = session_with(72, waves_of_all_joints, poses=15, validation=5, pose_sigma_m=0.0)
    found = discover_session(session, rng=np.random.default_rng(1))
    assert found.effects
    assert found.repeated is not None
    assert found.repeated.widening >= 1.0
