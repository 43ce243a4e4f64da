"""Standard deviations hold where stretches of a session differ, and stay where they do not."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from discovery_scenes import session_with
from scipy.stats import binom

from remaster_ros.calibration.estimate import Estimate, Problem, estimate
from remaster_ros.discovery.evidence import solve
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.discovery.stretches import STRETCHES, compare_stretches, stretch_of_row
from remaster_ros.discovery.undetected import fitted_columns
from remaster_ros.types import FloatArray

NOISE_M = 0.1e-3
JOINT = 2


@dataclass(frozen=True, eq=False)
class Scene:
    """A session whose noise can be drawn again, with the derivative of all its parameters."""

    found: Estimate
    data: Residuals

    @classmethod
    def of(cls, seed: int) -> Scene:
        found = estimate(Problem.of(session_with(seed, poses=50)))
        return cls(found, Residuals.of(found))

    def noise(self, rng: np.random.Generator) -> FloatArray:
        return NOISE_M * rng.standard_normal((len(self.data), 3))

    def with_errors(self, errors: FloatArray) -> tuple[Residuals, Solution]:
        """Return the residuals with errors (n, 3), and their solution without cells."""
        full = self.data.full_errors.copy()
        full[self.data.rows.source] = errors
        data = replace(self.data, errors=errors, full_errors=full)
        solution = solve(data, ())
        assert solution is not None
        return data, solution

    def offset(self, data: Residuals, solution: Solution) -> tuple[float, float]:
        """Return by how much the joint's offset is off, and its standard deviation, rad."""
        columns, precision, where = fitted_columns(self.found, data, solution)
        flat = data.noise_model.whitened(columns, solution.noise).reshape(3 * len(data), -1)
        errors = data.noise_model.whitened(data.errors, solution.noise).ravel()
        covariance = np.linalg.inv(flat.T @ flat + precision)
        place = int(np.flatnonzero(where == JOINT)[0])
        return float((covariance @ flat.T @ errors)[place]), float(covariance[place, place] ** 0.5)


def test_noise_alone_widens_nothing():
    scene, rng = Scene.of(61), np.random.default_rng(1)
    found = []
    for _ in range(40):
        data, solution = scene.with_errors(scene.noise(rng))
        found.append(compare_stretches(scene.found, data, solution))
    print([(round(one.ratio, 2), one.p_value) for one in found])
    assert np.mean([one.ratio for one in found]) == pytest.approx(1.0, abs=0.15)
    assert sum(one.p_value < 0.2 for one in found) <= binom.ppf(0.999, 40, 0.2)
    assert sum(one.widened for one in found) <= binom.ppf(0.999, 40, 0.01)
    assert all(one.moves.shape[1] == 0 for one in found if not one.widened)
    assert 1.0 <= np.median([one.widening for one in found]) < 1.05


def test_a_joint_that_wanders_from_stretch_to_stretch_widens_its_offset():
    """Its mean stays as it is: without the moves the offset is far too sure of itself."""
    scene, rng = Scene.of(62), np.random.default_rng(2)
    data = scene.data
    lever = data.full_jacobian[data.rows.source][:, :, JOINT]
    stretch = stretch_of_row(data)
    by_model, widened, told = [], [], 0
    for _ in range(40):
        wandering = 3e-4 * rng.standard_normal(STRETCHES)[stretch, None] * lever
        other, solution = scene.with_errors(scene.noise(rng) + wandering)
        found = compare_stretches(scene.found, other, solution)
        told += found.widened
        off, std = scene.offset(other, solution)
        by_model.append(off / std)
        widened.append(off / np.hypot(std, np.linalg.norm(found.moves[JOINT])))
        held = np.setdiff1d(np.arange(scene.found.model.size), scene.found.posterior.free)
        assert np.all(found.moves[held] == 0.0)
    rms = [float(np.sqrt(np.mean(np.square(z)))) for z in (by_model, widened)]
    print('RMS of deviation over std: by the model, with the moves', rms)
    assert told >= 36
    assert rms[0] > 3.0
    # Ten stretches, of which some count more, give a standard deviation to a third.
    assert 0.6 < rms[1] < rms[0] / 3.0


def test_stretches_are_of_whole_poses_and_follow_time():
    data = Scene.of(63).data
    stretch = stretch_of_row(data)
    poses = [set(data.pose_of_row[stretch == index]) for index in range(STRETCHES)]
    assert sum(map(len, poses)) == data.poses == len(set.union(*poses))
    time = data.context.elapsed_s[data.rows.source]
    mean = [time[stretch == index].mean() for index in range(STRETCHES)]
    assert np.all(np.diff(mean) > 0.0)


def test_too_few_poses_are_not_compared():
    found = estimate(Problem.of(session_with(64, poses=15)))
    data = Residuals.of(found)
    solution = solve(data, ())
    assert solution is not None
    compared = compare_stretches(found, data, solution)
    assert (compared.count, compared.widening, compared.widened) == (0, None, False)


def test_nothing_is_compared_where_rows_determine_no_parameter(monkeypatch):
    monkeypatch.setattr('remaster_ros.discovery.stretches.SHOWN', np.inf)
    scene = Scene.of(61)
    data, solution = scene.with_errors(scene.noise(np.random.default_rng(1)))
    found = compare_stretches(scene.found, data, solution)
    assert (found.count, found.widening, found.widened) == (0, None, False)
