"""Noise that remembers is measured, set aside where fitting it may do harm, and names no cause."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
import pytest
from discovery_scenes import session_with

pytest.importorskip('pinocchio', reason='needs the judge: pip install pin')

from hidden_sessions import Recipe, hidden_session

from remaster_ros.calibration.estimate import Estimate, Problem, estimate
from remaster_ros.discovery.beside_memory import withstanding_memory
from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.evidence import solve
from remaster_ros.discovery.findings import Findings
from remaster_ros.discovery.marker_offsets import moved_markers
from remaster_ros.discovery.memory import Memory
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.selection import Selection
from remaster_ros.discovery.set_aside import harm_and_gain, is_memory, moved_by_memory, set_aside
from remaster_ros.discovery.solution import Solution
from remaster_ros.discovery.stepwise_selection import Search
from remaster_ros.discovery.undetected import fitted_columns
from remaster_ros.types import FloatArray

NOISE_M = 0.1e-3


@dataclass(frozen=True, eq=False)
class Scene:
    """A session whose errors can be drawn again."""

    found: Estimate
    data: Residuals

    @classmethod
    def of(cls, seed: int) -> Scene:
        found = estimate(Problem.of(session_with(seed, poses=60)))
        return cls(found, Residuals.of(found))

    def memory(self, length: float, process_m: float, own_m: float = NOISE_M) -> Memory:
        channels = len(self.data.noise_model.channels)
        sensors = self.data.noise_model.sensors
        none = np.zeros(channels)
        return Memory(
            self.data,
            np.full(channels, own_m),
            none,
            none,
            np.full(sensors, process_m),
            np.full(sensors, length),
        )

    def with_errors(self, errors: FloatArray) -> Residuals:
        full = self.data.full_errors.copy()
        full[self.data.rows.source] = errors
        return replace(self.data, errors=errors, full_errors=full)

    @cached_property
    def wander(self) -> dict[str, Cell]:
        return {cell.variant: cell for cell in EFFECTS['sensor_wander'].cells(self.data.context)}


@pytest.fixture(scope='module')
def scene() -> Scene:
    return Scene.of(71)


def solved(data: Residuals, *cells: Cell) -> Solution:
    solution = solve(data, cells)
    assert solution is not None
    return solution


@pytest.mark.parametrize('length', [2.8, 9.5, 32.8])
def test_a_memory_is_measured(scene, length):
    """Correlations of .7, .9 and .97 from one reading to the next."""
    rng = np.random.default_rng(1)
    true = scene.memory(length, 2.0 * NOISE_M)
    rhos, processes = [], []
    for errors in np.moveaxis(true.draw(8, rng), 2, 0):
        data = scene.with_errors(errors)
        found = Memory.of(data, solved(data), [0])
        rhos.append(np.exp(-1.0 / found.length[0]))
        processes.append(1e3 * found.process[0])
    print(length, np.round(rhos, 2), np.round(processes, 3))
    assert np.median(rhos) == pytest.approx(np.exp(-1.0 / length), abs=0.08)
    # What registration and offsets absorb of a slow one is no error any more.
    assert 0.12 < np.median(processes) < 0.25


def test_without_memory_hardly_any_is_measured(scene):
    rng = np.random.default_rng(2)
    data = scene.with_errors(NOISE_M * rng.standard_normal((len(scene.data), 3)))
    found = Memory.of(data, solved(data), [0])
    print(found.process, found.own)
    together = np.hypot(found.own[0], found.process[0])
    assert np.hypot(together, found.shared[0]) == pytest.approx(NOISE_M, rel=0.1)
    assert found.process[0] * np.exp(-0.5 / found.length[0]) < 0.6 * NOISE_M


def test_a_short_memory_is_set_aside(scene):
    rng = np.random.default_rng(3)
    data = scene.with_errors(scene.memory(2.8, 1.5 * NOISE_M).draw(1, rng)[:, :, 0])
    solution = solved(data, scene.wander['fast'])
    aside = set_aside(data, solution, partial(solve, data))
    assert aside is not None
    assert aside.searched is solution
    assert not any(is_memory(cell) for cell in aside.solution.cells)
    plain = solved(data)
    np.testing.assert_allclose(aside.solution.base, plain.base, rtol=1e-3, atol=1e-7)


def test_harm_and_gain_are_as_frequent_as_stated(scene):
    """With what the errors were drawn from, which sessions show in `Memory.of`."""
    rng = np.random.default_rng(4)
    memory = scene.memory(12.0, 3.0 * NOISE_M)
    columns = scene.data.base.reshape(3 * len(scene.data), -1)
    stated, seen = [], []
    for errors in np.moveaxis(memory.draw(20, rng), 2, 0):
        data = scene.with_errors(errors)
        solution, without = solved(data, scene.wander['middling']), solved(data)
        stated.append(harm_and_gain(data, solution, without, replace(memory, data=data)))
        # Nothing but noise is left of these residuals: all that is fitted is wrong.
        after, before = (np.linalg.norm(columns @ fit.base) for fit in (solution, without))
        seen.append((after > 1.05 * before, before > 1.05 * after))
    stated, seen = np.mean(stated, axis=0), np.mean(seen, axis=0)
    print('stated', stated, 'seen', seen)
    assert np.all(np.abs(stated - seen) < 3.0 * np.sqrt(stated * (1.0 - stated) / 20) + 0.02)
    assert stated[1] > stated[0]


def test_harm_and_gain_do_not_depend_on_the_order_of_the_causes(scene):
    rng = np.random.default_rng(6)
    memory = scene.memory(12.0, 3.0 * NOISE_M)
    causes = list(EFFECTS['joint_compliance'].cells(scene.data.context))[1:3]
    shift = scene.data.displaced(causes, np.array([2e-5, 4e-5]))
    data = scene.with_errors(memory.draw(1, rng)[:, :, 0]).less(-shift)
    memory = replace(memory, data=data)
    solution = solved(data, *causes, scene.wander['middling'])
    one, other = (
        harm_and_gain(data, solution, solved(data, *order), memory)
        for order in (causes, causes[::-1])
    )
    print('harm and gain', one)
    assert one == pytest.approx(other, abs=0.02)


def test_without_a_wander_nothing_changes(scene):
    data = scene.data
    solution = solved(data)
    search = Search(data, (), np.random.default_rng(0), lambda data, _: data, lambda _: None)
    before = search.rng.bit_generator.state
    assert set_aside(data, solution, search.fit) is None
    assert withstanding_memory(search, solution) is solution
    assert search.rng.bit_generator.state == before


def test_intervals_hold_with_a_memory_set_aside(scene):
    """The stated covariance of the ordinary estimate is too small, the widened one is not."""
    rng = np.random.default_rng(5)
    true = scene.memory(9.5, 3.0 * NOISE_M, 0.3 * NOISE_M)
    data = scene.with_errors(true.draw(1, rng)[:, :, 0])
    solution = solved(data)
    columns, precision, where = fitted_columns(scene.found, data, solution)
    white = data.noise_model.whitened(columns, solution.noise).reshape(3 * len(data), -1)
    covariance = np.linalg.inv(white.T @ white + precision)
    drawn = data.noise_model.whitened(true.draw(400, rng), solution.noise)
    spread = (covariance @ white.T @ drawn.reshape(3 * len(data), -1)).std(axis=1)
    stated = np.sqrt(np.diag(covariance))
    memory = Memory.of(data, solution, [0])
    moves = moved_by_memory(scene.found, data, solution, memory)[where]
    widened = np.hypot(stated, np.linalg.norm(moves, axis=1))
    print(np.round(spread / stated, 2), np.round(spread / widened, 2))
    assert np.max(spread / stated) > 1.5
    assert np.max(spread / widened) < 1.25
    assert np.median(spread / widened) > 0.6


def test_a_cause_that_memory_suggests_is_dropped_and_a_true_one_stays():
    """A session in which the search takes noise of correlation .9 for an eccentric encoder."""
    recipe = Recipe(seed=zlib.crc32(b'noise-memory_0.9-68'), noise='memory_0.9')
    found = estimate(Problem.of(hidden_session(recipe).session))
    data = Residuals.of(found)
    wander = [c for c in EFFECTS['sensor_wander'].cells(data.context) if c.variant == 'fast']
    eccentric = list(EFFECTS['encoder_eccentricity'].cells(data.context))
    couplings = list(EFFECTS['joint_coupling'].cells(data.context))
    waves = list(EFFECTS['gear_periodic'].cells(data.context))
    cells = (*wander, *eccentric, *couplings, *waves)
    for planted in ((), (couplings[0],)):
        shift = data.displaced(planted, np.full(sum(c.size for c in planted), 1e-3))
        search = Search(
            data.less(-shift),
            cells,
            np.random.default_rng(0),
            lambda data, _: data,
            lambda _: None,
        )
        without = search.fit(wander)
        fits = [search.fit((*wander, cell)) for cell in planted or eccentric]
        given = max((fit for fit in fits if fit), key=lambda fit: fit.log_evidence)
        assert without is not None
        print(planted, given.log_evidence - without.log_evidence)
        assert given.log_evidence > without.log_evidence + 1.0
        left = withstanding_memory(search, given)
        assert left.cells == (given.cells if planted else tuple(wander))


def test_a_pull_on_a_marker_counts_for_less_where_errors_remember():
    """A session in which noise of correlation .7 pulls a marker that is where it is stated."""
    recipe = Recipe(seed=zlib.crc32(b'noise-memory_0.7-25'), robot='six', noise='memory_0.7')
    found = estimate(Problem.of(hidden_session(recipe).session))
    data = Residuals.of(found)
    plain = solved(data)
    wander = [c for c in EFFECTS['sensor_wander'].cells(data.context) if c.variant == 'fast']
    assert moved_markers(found, data, solved(data, *wander))
    assert not moved_markers(found, data, plain, Memory.of(data, plain, [0]))


def test_where_causes_are_refused_the_memory_still_widens(scene):
    rng = np.random.default_rng(8)
    data = scene.with_errors(scene.memory(2.8, 1.5 * NOISE_M).draw(1, rng)[:, :, 0])
    empty, solution = solved(data), solved(data, scene.wander['fast'])
    found = Findings(
        before=scene.found,
        found=scene.found,
        residuals=data,
        selection=Selection(empty, solution, (), None),
        groups=(),
        effects=(),
        structure=(),
        untestable={},
        thinning=None,
        aside=set_aside(data, solution, partial(solve, data)),
        repeated=None,
    )
    refused = found.without_causes()
    assert refused.aside is not None
    assert refused.aside.memory.data is refused.residuals
    assert refused.selection.solution.cells == refused.searched.cells == ()
    bare = replace(found, selection=Selection(empty, empty, (), None), aside=None)
    assert bare.without_causes().aside is None
