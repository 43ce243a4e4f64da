# SPDX-License-Identifier: Apache-2.0
"""The calibration study of benchmarks/bench_calibration.py, small: 27 sessions of 12 poses.

Sessions of all kinds: one and two sensors, both models of the noise and its prior, truths anew
for each. A right posterior fails a test with a probability of at most 1e-3 where seeds are drawn
anew (these are fixed). What is found: intervals that are 1.5 times too narrow hold 81 % and not
95 %, which the first test sees in more than nine of ten runs.
"""

from __future__ import annotations

import os
from functools import partial

import numpy as np
import pytest
from judges.calibration_study import RANKS, Outcome, one_session
from rigs.parallel import in_parallel
from scipy.stats import binom, chi2, kstest

pytestmark = pytest.mark.slow

SEEDS = range(5000, 5027)
POSES = (12, 58)
ERROR_RATE = 1e-3


@pytest.fixture(scope='module')
def outcomes() -> list[Outcome]:
    print(f'session seeds {SEEDS}')
    workers = len(os.sched_getaffinity(0))
    return sorted(
        in_parallel(partial(one_session, poses=POSES), SEEDS, workers),
        key=lambda outcome: outcome.seed,
    )


def one_of_each(outcomes: list[Outcome], per_session: list[list[float]]) -> np.ndarray:
    """Return one value of each session, at random: those of one session hang together."""
    rng = np.random.default_rng(1)
    return np.array([rng.choice(values) for values in per_session])


def test_intervals_hold_as_often_as_they_say(outcomes: list[Outcome]) -> None:
    """Four parameters of each session, as if independent: their bonds only widen the bounds."""
    rng = np.random.default_rng(2)
    hits = [
        bool(value)
        for outcome in outcomes
        for value in rng.choice(list(outcome.inside.values()), 4, replace=False)
    ]
    # 1e-4 in place of 1e-3 for what the four of a session share.
    low, high = binom.ppf((0.5e-4, 1.0 - 0.5e-4), len(hits), 0.95)
    assert low <= sum(hits) <= high, sum(hits) / len(hits)


def test_ranks_of_the_truth_are_uniform(outcomes: list[Outcome]) -> None:
    chosen = [o for o in outcomes if o.noise != 'independent']
    ranks = one_of_each(chosen, [list(o.rank.values()) for o in chosen])
    assert kstest((ranks + 0.5) / (RANKS + 1), 'uniform').pvalue > ERROR_RATE, ranks


def test_offsets_err_as_little_as_the_data_allow(outcomes: list[Outcome]) -> None:
    errors = one_of_each(outcomes, [o.error for o in outcomes])
    low, high = chi2.ppf((0.5 * ERROR_RATE, 1.0 - 0.5 * ERROR_RATE), len(errors))
    # 12 poses leave the size of the noise open: up to 10 % above the bound that knows it.
    assert low <= np.sum(errors**2) <= 1.1**2 * high
