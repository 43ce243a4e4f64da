# SPDX-License-Identifier: Apache-2.0
"""What is hidden is found by name, alone and two at once; where noise alone is hidden, nothing is.

Sessions of the tests' own world (pinocchio; nothing shared with what estimates). Of single effects
at eight times the size that the best possible test needs all of 24 were right, of pairs at four to
eight times 21 of 24 (benchmarks/RESULTS.md); at these rates one miss of ten comes with a third of
seeds, two with 8 %.
"""

import numpy as np
import pytest
from judges.hidden_effects import judge
from worlds.hidden_sessions import Recipe, hidden_session

from remaster_ros.discovery.discover import discover_session

pytestmark = pytest.mark.timeout(600)

SINGLE = (
    'joint_compliance',
    'backlash',
    'encoder_eccentricity',
    'joint_error_curve',
    'base_compliance',
    'thermal_growth',
    'sensor_scale',
    'link_length',
)
PAIRS = (('gear_periodic', 'thermal_growth'), ('settling', 'encoder_eccentricity'))
NOISES = ('pose_common', 'range', 'memory_0.9')
MOST_MISSES = 1


def found_in(recipe):
    hidden = hidden_session(recipe)
    found = discover_session(hidden.session, rng=np.random.default_rng(recipe.seed))
    print(recipe.seed, *map(str, hidden.truth.effects), '->', found.verdict)
    for effect in found.effects:
        print('   ', effect.title, effect.probability)
    # What is likelier there than not is named, or it is said why not.
    assert all(cause.probability < 0.5 or cause.why for cause in found.search.less_likely)
    return hidden, found


def test_eight_single_effects_and_two_pairs_are_named():
    misses = []
    for seed, kinds in enumerate([*((kind,) for kind in SINGLE), *PAIRS], 4100):
        recipe = Recipe(seed, kinds, 8.0, robot=('iiwa7', 'six')[seed % 2], sensors=('mocap',))
        hidden, found = found_in(recipe)
        judged = judge(hidden.world, hidden.truth, found)
        if not (judged.named_right or judged.forgiven):
            misses.append(kinds)
    assert len(misses) <= MOST_MISSES, misses


@pytest.mark.parametrize('noise', NOISES)
def test_where_noise_alone_is_hidden_nothing_is_named(noise):
    """Of 300 empty sessions two had a cause."""
    _, found = found_in(Recipe(4200 + NOISES.index(noise), (), noise=noise, sensors=('mocap',)))
    assert not found.effects


@pytest.mark.qualify
@pytest.mark.parametrize(
    'recipe',
    [
        Recipe(
            806644669, ('base_compliance', 'joint_error_curve', 'thermal_growth'), 5.7,
            robot='iiwa7', noise='range', outliers=True,
        ),
        Recipe(
            3734294646, ('base_compliance', 'encoder_scale', 'sensor_distortion'), 4.74,
            robot='iiwa7', sensors=('mocap',), noise='pose_common', outliers=True,
        ),
    ],
    ids=['waves that are a curve', 'two that stand for two'],
)  # fmt: skip
def test_what_no_single_move_of_a_chain_leaves_is_left(recipe):
    hidden, found = found_in(recipe)
    assert judge(hidden.world, hidden.truth, found).named_right
