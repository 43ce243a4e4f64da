# SPDX-License-Identifier: Apache-2.0
"""Is what a world of its own hides found: its name, its joint, its size; and nothing else?

Effect, joint, size and sign are drawn; sizes are eight times what the best possible test needs to
find the effect in 90 % of sessions. benchmarks/bench_discovery.py does the same with hundreds of
sessions, and small sizes too. Seeds are fixed, so that a failure is the same for everyone.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip('pinocchio', reason='needs the judge: pip install pin')

from judges.hidden_effects import judge
from worlds.hidden_sessions import (
    NOISES,
    Recipe,
    another_session,
    held_out_noise_m,
    hidden_session,
    third_visits,
)
from worlds.hidden_third import predicted_by, predicted_by_offsets, third_errors

from remaster_ros import discover, simulate
from remaster_ros.discovery.confirmation import confirm
from remaster_ros.discovery.discover import Discovery, discover_session
from remaster_ros.simulation.hidden_effects import NAMED

# Half a minute on a quiet machine.
pytestmark = pytest.mark.timeout(1200)

CLEAR = 8.0
SEED = 20


def discovered(recipe: Recipe) -> tuple[Discovery, object]:
    """Hide, discover; print what a failure needs."""
    hidden = hidden_session(recipe)
    found = discover_session(hidden.session, rng=np.random.default_rng(recipe.seed))
    print(recipe)
    print('hidden:', *(str(effect) for effect in hidden.truth.effects), sep='\n  ')
    for effect in found.effects:
        print('found:', effect.name, effect.joints, effect.parameters, effect.confusable_with)
    return found, hidden


@pytest.mark.parametrize(
    'recipe',
    [
        pytest.param(
            Recipe(4125604570, ('encoder_eccentricity', 'marker_offset'), 4.58, noise='range'),
            id='a free form explains no more than a shape of it',
        ),
        pytest.param(
            Recipe(818186293, ('encoder_eccentricity', 'sensor_scale'), 4.466, noise='depth'),
            id='a link length imitates it until the scale is there',
            marks=pytest.mark.qualify,
        ),
        pytest.param(
            Recipe(2240630357, ('gear_periodic', 'joint_compliance'), 6.469, noise='pose_common'),
            id='two free forms stand for two soft joints',
            marks=pytest.mark.qualify,
        ),
    ],
)
def test_what_explains_more_takes_the_place_of_what_was_found_first(recipe: Recipe) -> None:
    robot = 'six' if 'gear_periodic' in recipe.kinds else 'iiwa7'
    recipe = replace(recipe, robot=robot, sensors=('mocap', 'tracker'), outliers=True)
    found, hidden = discovered(recipe)
    assert judge(hidden.world, hidden.truth, found).named_right


@pytest.mark.qualify
def test_single_effects_are_named_with_joint_and_size() -> None:
    """Eight of the sixteen, drawn with everything else.

    Of sessions like these the benchmark has 95 % right, names and sizes: two misses or more in
    eight would come with 6 % of seeds.
    """
    print(f'seed {SEED}')
    rng = np.random.default_rng(SEED)
    misses, excess = [], []
    for i, kind in enumerate(rng.permutation(list(NAMED))[:8]):
        recipe = Recipe(
            seed=SEED + i,
            kinds=(str(kind),),
            multiple=CLEAR,
            robot=('iiwa7', 'six')[i % 2],
            sensors=(('mocap',), ('mocap', 'tracker'))[i // 2 % 2],
            noise=tuple(NOISES)[i // 2 % 4],
            outliers=i % 3 == 0,
        )
        found, hidden = discovered(recipe)
        judgement = judge(hidden.world, hidden.truth, found)
        print(judgement)
        if not judgement.named_right or judgement.size_right is False:
            misses.append((kind, judgement))
        excess.append(found.gain.held_out_rms_after_m / held_out_noise_m(hidden))
    assert len(misses) <= 1, misses
    # What is left is the noise; a drift has to be extrapolated to the poses held out, which come
    # last, and costs some more.
    print('held-out error / noise:', np.round(excess, 3))
    assert np.median(excess) < 1.05
    assert np.max(excess) < 1.2


@pytest.mark.parametrize(
    'noise',
    [pytest.param(n, marks=() if n == 'depth' else pytest.mark.qualify) for n in NOISES],
)
def test_nothing_is_named_where_nothing_is(noise: str) -> None:
    """Outliers and two sensors in every second session. Of these 2 % may claim something."""
    i = list(NOISES).index(noise)
    recipe = Recipe(
        seed=SEED + i,
        robot=('iiwa7', 'six')[i % 2],
        sensors=(('mocap', 'tracker'), ('mocap',))[i % 2],
        noise=noise,
        outliers=i % 2 == 0,
        held_out_outliers=i % 2 == 0,
    )
    found, _ = discovered(recipe)
    assert found.verdict == 'none'
    assert not found.effects


@pytest.mark.qualify
def test_two_effects_at_once() -> None:
    """Two joints that sag, where the greedy choice is a coupling, and backlash beside."""
    found, hidden = discovered(
        Recipe(SEED, ('joint_compliance', 'backlash'), CLEAR, sensors=('mocap', 'tracker'))
    )
    judgement = judge(hidden.world, hidden.truth, found)
    assert judgement.named_right, judgement
    assert judgement.size_right, judgement


@pytest.mark.qualify
def test_causes_carry_over_to_a_session_of_the_same_arm_until_they_are_removed() -> None:
    recipe = Recipe(SEED, ('encoder_eccentricity',), CLEAR)
    found, first = discovered(recipe)
    assert found.effects
    other = Recipe(SEED + 1)
    same = confirm(
        found, another_session(first, other, first.truth.effects).session, np.random.default_rng(0)
    )
    repaired = confirm(found, another_session(first, other, ()).session, np.random.default_rng(0))
    print(same, repaired, sep='\n')
    assert same.confirmed
    assert same.rms_after_m < same.rms_before_m
    assert not repaired.confirmed
    # Frozen causes of an arm that no longer has them make its errors worse.
    assert repaired.rms_after_m > repaired.rms_before_m


@pytest.mark.qualify
def test_what_was_found_predicts_a_third_set_better_than_the_offsets() -> None:
    """Causes at a joint, in the sensor, over time: all that a prediction is made of."""
    recipe = Recipe(SEED, ('registration_drift', 'backlash', 'sensor_scale'), CLEAR)
    found, hidden = discovered(recipe)
    rows = hidden.session.measurements
    np.testing.assert_allclose(
        predicted_by(found, hidden.session), rows.position - found.fit.residuals_after, atol=1e-9
    )
    offsets = rows.position - predicted_by_offsets(hidden.session, hidden.session)
    fitted = ~rows.is_validation
    # A mode without causes is no sampled mean, but near it.
    assert np.std(offsets[fitted]) > np.std(found.fit.residuals_after[fitted])
    third = third_errors(hidden.world, hidden.truth.effects, third_visits(recipe), found)
    print(third)
    assert third.returned_m < 0.5 * third.offsets_m
    assert not third.harm


def _of_25_poses(seed: int, effects: tuple[str, ...]) -> tuple[set, Discovery]:
    """Hide effects in a session of 25 poses and 15 held out; return them, and what is found."""
    simulated = simulate(poses=25, validation_poses=15, effects=effects, seed=seed)
    found = discover(simulated.session)
    hidden = {(effect.kind, effect.joints) for effect in simulated.truth.effects}
    print(hidden, [(effect.name, effect.joints, effect.probability) for effect in found.effects])
    return hidden, found


@pytest.mark.qualify
@pytest.mark.parametrize(
    ('seed', 'other'), [(24, 'joint_compliance@2:0.45'), (25, 'joint_axis_tilt@6:0.45')]
)
def test_a_wave_of_half_a_millimetre_is_no_noise(seed: int, other: str) -> None:
    """With another cause of that size, 25 poses: both are named."""
    hidden, found = _of_25_poses(seed, ('gear_periodic@1:0.45', other))
    assert {(effect.name, effect.joints) for effect in found.effects} == hidden


@pytest.mark.qualify
@pytest.mark.parametrize(
    'effects',
    [
        pytest.param(('joint_compliance@2:0.45', 'thermal_growth:0.45'), id='each imitated'),
        pytest.param(('base_compliance:0.45', 'joint_compliance@2:0.45'), id='each other'),
    ],
)
def test_what_25_poses_do_not_tell_is_not_certain(effects: tuple[str, ...]) -> None:
    """Scales of encoders imitate what gives way.

    Each is named, as are their imitations, with a probability that says how much it may be
    relied on: of those that are certain one in twenty may be none. The models with what is
    hidden are as likely in the first session, and 2.5 nats less likely in the second.
    """
    hidden, found = _of_25_poses(10, effects)
    named = {(effect.name, effect.joints) for effect in found.effects}
    certain = {(effect.name, effect.joints) for effect in found.effects if effect.is_certain}
    assert named & hidden
    assert certain <= hidden
    for effect in found.effects:
        assert ('Not certain' in effect.cause) == ((effect.name, effect.joints) not in certain)
    if not certain:
        # Neither is told from its rival: both stand there.
        beside = {(e.name, e.joints) for cause in found.effects for e in cause.confusable_with}
        assert hidden <= named | beside
        assert beside - named
        assert found.verdict == 'undetermined'
