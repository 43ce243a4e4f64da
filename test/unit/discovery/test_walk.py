# SPDX-License-Identifier: Apache-2.0
"""The walk over models: its log posterior, its moves, what it finds and what it does not."""

from functools import cache

import numpy as np
import pytest
from worlds.calibration_scenes import CHAIN
from worlds.discovery_scenes import at_joint, residuals_of, session_with

from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.evidence import System
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.surface import LEVELS_M, Pool, State, Surface, Walker, blocks_of
from remaster_ros.discovery.walk import Chain, Walk, evaluated, identity, p_value

ARC_MINUTE = np.radians(1.0 / 60.0)
NAMES = ('joint_compliance', 'encoder_eccentricity', 'backlash', 'joint_error_curve')


def both(session):
    """Joint 2 sags and the encoder of joint 4 is eccentric."""
    q = session.measurements.q
    return at_joint(2, 1e-4 * CHAIN.gravity_torque(q)[:, 1]) + at_joint(
        4, 4.0 * ARC_MINUTE * np.sin(q[:, 3])
    )


@cache
def scene(hidden: bool = True) -> Residuals:
    return residuals_of(session_with(31, both if hidden else None, poses=30))


@cache
def candidates():
    data = scene()
    return [
        candidate
        for name in NAMES
        if not EFFECTS[name].needs(data.context)
        for candidate in EFFECTS[name].candidates(data.context)
    ]


@cache
def pool() -> Pool:
    return Pool(scene(), blocks_of(scene(), candidates()))


@cache
def surface() -> Surface:
    return Surface(pool(), scene().noise, {})


def drawn_models(count):
    rng = np.random.default_rng(5)
    for _ in range(count):
        blocks = rng.choice(len(pool().blocks), 3, replace=False)
        model = []
        for block in blocks.tolist():
            levels = np.flatnonzero(pool().allowed[block])
            if not any(block in pool().excluded[other] for other, _ in model):
                model.append((block, int(rng.choice(levels))))
        yield tuple(model)


def test_the_log_posterior_is_that_of_the_mixed_model_equations():
    """Of models with the same noise, the surface and the equations differ by one constant."""
    data, off = scene(), []
    for model in ((), *drawn_models(6)):
        parts = [pool().blocks[block].weights(level) for block, level in model]
        system = System.of(data, parts)
        shared = data.noise_model.shared(data.noise)
        eta = np.log(np.concatenate((data.noise.sigma, shared)))
        exact = system.marginal(eta) + pool().prior(model)
        off.append(exact - State.of(surface(), model).value)
    # The surface is in single precision.
    assert np.ptp(off) < 0.01


def test_a_block_that_joins_and_leaves_changes_nothing():
    for model in drawn_models(4):
        state = State.of(surface(), model)
        for position, (block, level) in enumerate(model):
            again = state.without(position).with_block(block, level)
            assert again.key == state.key
            assert again.value == pytest.approx(state.value, abs=1e-2)
            np.testing.assert_allclose(
                again.pull, state.pull, atol=1e-2 * np.abs(state.pull).max()
            )


def test_a_model_that_is_refused_costs_no_product_with_all_columns():
    ground = Surface(pool(), scene().noise, {})
    first, *further_blocks = np.flatnonzero(pool().sizes == 1).tolist()
    state = State.of(ground, ((first, 2),))
    known = state.with_block(further_blocks[0], 2).value, state.without(0).value
    fetched = [ground.is_known(block) for block in range(len(pool().blocks))]
    assert np.flatnonzero(fetched).tolist() == [first]
    exact = State.of(ground, ((first, 2), (further_blocks[0], 2))).value
    assert known == (pytest.approx(exact, abs=1e-3), pytest.approx(0.0, abs=1e-3))


def test_a_pool_that_grows_makes_the_surface_grow():
    """What was computed of the columns before stays; the surface takes the room of another."""
    data = scene()
    grown = Pool(data, pool().blocks[:20])
    kinds = {candidates()[0]: 1e-4}
    before = Surface(grown, data.noise, {})
    grown_surface = Surface(grown, data.noise, kinds, before)
    assert grown_surface.room is before.room
    grown.extend(pool().blocks[20:])
    grown_surface.extend()
    fresh_surface = Surface(pool(), data.noise, kinds)
    assert grown_surface.has(data.noise, kinds)
    assert not grown_surface.has(data.noise, {})
    np.testing.assert_allclose(
        grown_surface.columns,
        fresh_surface.columns,
        atol=1e-5 * np.abs(fresh_surface.columns).max(),
    )
    np.testing.assert_allclose(grown_surface.square, fresh_surface.square, rtol=1e-4, atol=1.0)
    for mine, fresh in zip(grown.excluded, pool().excluded, strict=True):
        np.testing.assert_array_equal(mine, fresh)
    np.testing.assert_allclose(grown.log_prior, pool().log_prior)


def test_the_gain_of_a_block_of_one_weight_is_exact():
    state = State.empty(surface())
    single = np.flatnonzero(pool().sizes == 1)[:8].tolist()
    assert single
    for block in single:
        for level in np.flatnonzero(pool().allowed[block])[:2].tolist():
            if np.isfinite(state.gains[block, level]):
                expected = state.gains[block, level]
                assert state.with_block(block, level).value == pytest.approx(expected, abs=1e-3)


def test_a_chain_visits_models_by_their_posterior():
    """Of a pool of four blocks the share of steps with each agrees with the exact one."""
    data = scene()
    few = Pool(data, [pool().blocks[i] for i in np.flatnonzero(pool().sizes <= 2)[:4]])
    ground = Surface(few, data.noise, {})
    walker = Walker(State.empty(ground), np.random.default_rng(8))
    for _ in range(300):
        walker.step(1.0)
    best = max(walker.seen, key=lambda model: walker.seen[model])
    # All models of at most two blocks, at all levels.
    options = [(b, int(a)) for b in range(len(few.blocks)) for a in np.flatnonzero(few.allowed[b])]
    every = [(), *((option,) for option in options)]
    every += [(x, y) for x in options for y in options if x[0] < y[0]]
    values = {
        tuple(sorted(model)): State.of(ground, model).value
        for model in every
        if not (len(model) == 2 and model[1][0] in few.excluded[model[0][0]])
    }
    assert walker.seen[best] > max(values.values()) - 0.1


def test_two_causes_at_once_are_found_with_their_probability():
    data = scene()
    walk = Walk(data, candidates(), np.random.default_rng(1))
    found = {(candidate.name, candidate.joints) for candidate in walk.claimed}
    assert found == {('joint_compliance', (2,)), ('encoder_eccentricity', (4,))}
    for candidate in walk.claimed:
        assert walk.probability[identity(candidate)] > 0.95
        assert walk.log_gain([candidate]) > 5.0
    assert walk.share.sum() == pytest.approx(1.0)
    assert walk.best.log_evidence == walk.models[0].value == max(m.value for m in walk.models)


def test_two_causes_are_exchanged_for_the_two_that_they_stand_for():
    """Each of the two alone is worse than nothing, so that no move of a chain leads there."""
    data = scene()
    walk = Walk(data, candidates(), np.random.default_rng(1))
    of = {
        (c.name, c.joints): index
        for index, c in enumerate(block.candidate for block in walk.pool.blocks)
    }
    model = tuple(sorted((of['backlash', (joint,)], 2) for joint in (3, 5)))
    wrong = evaluated(walk.pool, [], model)
    walk.chains = [Chain(wrong, {model: wrong.value})]
    better = walk._pair_for_pair()
    assert better is not None
    found = {(c.name, c.joints) for c in walk.named(better)}
    assert found == {('joint_compliance', (2,)), ('encoder_eccentricity', (4,))}
    walk.chains.append(Chain(better, {better.model: better.value}))
    assert walk._pair_for_pair() is None


def test_nothing_is_found_where_nothing_is_hidden():
    walk = Walk(scene(False), candidates(), np.random.default_rng(2))
    assert not walk.claimed
    assert walk.models[0].value - walk.bare.value < 6.0


def test_a_kind_that_the_data_do_not_show_leaves_the_background():
    walk = Walk(scene(False), candidates(), np.random.default_rng(3))
    assert len(walk.models[0].families) < len(walk.families)


def test_a_walk_goes_on_from_the_model_of_another():
    data = scene()
    first = Walk(data, candidates(), np.random.default_rng(4))
    rows = data.rows.source[:-3]
    again = Walk(data.only(rows), candidates(), np.random.default_rng(5), start=first.models[0])
    assert {identity(c) for c in again.claimed} == {identity(c) for c in first.claimed}


def test_a_solution_predicts_what_its_model_does():
    data = scene()
    walk = Walk(data, candidates(), np.random.default_rng(6))
    model = walk.models[0]
    mean, _ = model.estimate
    columns = np.concatenate((data.base, data.columns(model.candidates)), axis=2)
    np.testing.assert_allclose(data.left(walk.best), data.errors - columns @ mean, atol=1e-9)
    assert evaluated(walk.pool, model.families, model.model) is not None


def test_the_p_value_is_a_bound_over_all_kinds():
    assert p_value(0.0) == 1.0
    assert p_value(20.0) == pytest.approx(len(EFFECTS) * np.exp(-20.0))


def test_levels_are_half_decades():
    np.testing.assert_allclose(np.diff(np.log10(LEVELS_M)), 0.5, atol=0.03)


def test_the_losses_of_blocks_are_those_of_the_models_without_them():
    sizes = [np.flatnonzero(pool().sizes == size)[:2].tolist() for size in (1, 2)]
    model = tuple((block, 3) for block in [*sizes[0], *sizes[1]])
    state = State.of(surface(), model)
    for position in range(len(model)):
        reduced_state = State.of(surface(), model[:position] + model[position + 1 :])
        assert state.losses[position] == pytest.approx(state.value - reduced_state.value, abs=2e-2)
