# SPDX-License-Identifier: Apache-2.0
"""Sessions with something hidden in them, or nothing: for tests and benchmarks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from judges.hidden_oracle import Oracle
from worlds.hidden_tours import CANDIDATES, visits, world
from worlds.hidden_world import MARKER_STD_M, HiddenTruth, HiddenWorld, Noise, Visits

from remaster_ros.simulation.effect_sampling import draw_effect
from remaster_ros.simulation.hidden_effect import HiddenEffect
from remaster_ros.types import Session

NOISES = {
    'independent': Noise(0.15e-3),
    'pose_common': Noise(0.08e-3, 0.15e-3),
    'range': Noise(0.12e-3, 0.05e-3, range_power=3.0),
    'depth': Noise(0.12e-3, 0.08e-3, depth_ratio=3.0),
}
# What the noise model of the fit has not.
WRONG_NOISES = {
    **{f'memory_{m}': Noise(0.15e-3, memory=m) for m in (0.7, 0.9, 0.97)},
    **{f'student_{dof}': Noise(0.15e-3, degrees_of_freedom=dof) for dof in (3, 5)},
    'mispaired': Noise(0.1e-3, 0.1e-3, mispaired_share=0.05),
}
PLAIN = {'plain': Noise(0.1e-3)}
OUTLIER_SHARE = 0.03
# An effect is drawn as one that plausibly leaves this much, then scaled.
VISIBLE_M = 0.2e-3


@dataclass(frozen=True)
class Recipe:
    """What to hide, and in what.

    Attributes
    ----------
    seed
        Of everything.
    kinds
        Of the effects; none for a session without.
    multiple
        Size of each effect, as a multiple of the size at which the best possible test, which
        knows what to look for, finds it in 90 % of sessions.
    size_m
        Size instead, where not None (see `HiddenWorld.size_m`).
    robot, sensors, noise
        See `hidden_tours.world` and `NOISES`.
    outliers, held_out_outliers
        Whether 3 % of the rows to fit, and of those held out, are gross errors.
    candidates
        Poses drawn, of which about half can be reached; None for some 350 observations to fit.
    where
        See `hidden_tours.visits`.
    marker_std_m
        See `hidden_tours.world`.
    further, further_multiple
        Kinds hidden beside these, and their size as `multiple`.
    """

    seed: int
    kinds: tuple[str, ...] = ()
    multiple: float = 4.0
    size_m: float | None = None
    robot: str = 'iiwa7'
    sensors: tuple[str, ...] = ('mocap',)
    noise: str = 'independent'
    outliers: bool = False
    held_out_outliers: bool = False
    candidates: int | None = None
    where: str = 'all'
    marker_std_m: float = MARKER_STD_M
    further: tuple[str, ...] = ()
    further_multiple: float = 0.7


@dataclass(frozen=True, eq=False)
class HiddenSession:
    """A session, the world it was made in, and the truth, which is for the judges alone.

    ``best_size_m`` is the size at which the best possible test finds each effect in 90 %.
    """

    session: Session
    world: HiddenWorld
    truth: HiddenTruth
    best_size_m: tuple[float, ...]


def hidden_session(recipe: Recipe) -> HiddenSession:
    """Make the session of a recipe; the same recipe gives the same session."""
    rng = np.random.default_rng([recipe.seed, 7])
    hidden = _world(recipe, rng)
    noise = replace(
        {**NOISES, **WRONG_NOISES, **PLAIN}[recipe.noise],
        outlier_share=OUTLIER_SHARE if recipe.outliers else 0.0,
        held_out_outliers=recipe.held_out_outliers,
    )
    noise_seed = [recipe.seed, 8]
    # The noise of the session itself, so that the oracle leaves out the gross errors.
    _, plain = hidden.measure((), noise, np.random.default_rng(noise_seed))
    oracle = Oracle(hidden, plain)
    effects, best = [], []
    multiples = [(kind, recipe.multiple) for kind in recipe.kinds]
    multiples += [(kind, recipe.further_multiple) for kind in recipe.further]
    for kind, multiple in multiples:
        effect = draw_effect(hidden, kind, rng, recipe.size_m or VISIBLE_M)
        now = hidden.size_m(effect)
        best.append(now * oracle.size_for_power(effect))
        effects.append(effect if recipe.size_m else hidden.of_size(effect, multiple * best[-1]))
    session, truth = hidden.measure(effects, noise, np.random.default_rng(noise_seed))
    return HiddenSession(session, hidden, truth, tuple(best))


def _world(recipe: Recipe, rng: np.random.Generator) -> HiddenWorld:
    """Draw a world; as a rule its sessions have some 350 observations to fit, whatever sees."""
    rounds = 2 // len(recipe.sensors)
    candidates = recipe.candidates or rounds * CANDIDATES[recipe.robot]
    tour = visits(recipe.robot, int(rng.integers(8)), candidates, where=recipe.where)
    return world(
        recipe.robot,
        rng,
        sensors=recipe.sensors,
        tour=tour,
        marker_std_m=recipe.marker_std_m,
    )


def third_visits(recipe: Recipe) -> Visits:
    """Plan a tour like that of the session, which the session has no pose of."""
    candidates = CANDIDATES[recipe.robot] // 2
    return visits(recipe.robot, 100 + recipe.seed % 4, candidates, where=recipe.where)


def another_session(
    first: HiddenSession, recipe: Recipe, effects: Sequence[HiddenEffect]
) -> HiddenSession:
    """Measure the arm of a session again, on another tour before sensors set up anew.

    Parameters
    ----------
    first
        Whose zero-offsets the arm still has.
    recipe
        Its seed, robot, sensors and noise count.
    effects
        What else is wrong with the arm now.
    """
    rng = np.random.default_rng([recipe.seed, 9])
    hidden = _world(recipe, rng)
    hidden.joint_offsets = first.world.joint_offsets
    session, truth = hidden.measure(effects, NOISES[recipe.noise], rng)
    return HiddenSession(session, hidden, truth, ())


def held_out_noise_m(hidden: HiddenSession) -> float:
    """RMS of the noise on the rows held out: what a perfect model would leave, m."""
    rows = hidden.session.measurements
    error = (rows.position - hidden.truth.clean)[rows.is_validation]
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))
