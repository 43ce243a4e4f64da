# SPDX-License-Identifier: Apache-2.0
"""Metropolis–Hastings on any log density: independent proposals in one batch, or a random walk.

Both work in logarithms, run several chains at once and repeat the state on rejection.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple, Protocol

import numpy as np

from remaster_ros.types import FloatArray

# Proposals evaluated between two reports of progress.
REPORTED = 2000
LogDensity = Callable[[FloatArray], FloatArray]
Method = Literal['metropolis', 'laplace']


class Chains(NamedTuple):
    """What a sampler returns."""

    draws: FloatArray  # (chains, draws, d)
    acceptance_rate: float  # Share of proposals taken, over all chains
    # A thinned record from the first state on, warm-up included, (chains, records, d)
    trace: FloatArray
    # 'metropolis', or 'laplace' for draws of the Gaussian about the mode, which are no chains
    method: Method = 'metropolis'
    # Where chains of an adapted proposal were given up: the shape of the tail of the importance
    # weights of its draws, and how many independent draws they are worth. NaN for chains.
    pareto_k: float = float('nan')
    effective: float = float('nan')
    # R-hat and effective draws of bulk and tails of the quantities that the length of chains was
    # judged by, (p,) each; None where it was not
    figures: tuple[FloatArray, FloatArray, FloatArray] | None = None


class Proposal(Protocol):
    """A density that can be sampled and evaluated: the independence sampler proposes from it."""

    def sample(self, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Return points (count, d) and their log density (count,), normalised or not."""
        ...

    def log_density(self, points: FloatArray) -> FloatArray:
        """Return the same log density of points (n, d), (n,)."""
        ...


def independence_sampler(
    log_density: LogDensity,
    proposal: Proposal,
    *,
    draws: int,
    warm_up: int,
    rng: np.random.Generator,
    start: FloatArray,
    progress: Callable[[float], None] | None = None,
) -> Chains:
    """Sample exactly with proposals that do not depend on the state.

    All proposals are evaluated in batches beforehand; the chains then walk over their importance
    weights (Hastings 1970; Tierney 1994): take y from x with probability min(1, w(y) / w(x)).

    ``log_density``: points (n, d) to log density (n,), up to a constant; -inf where there is none;
    ``proposal``: heavier in the tails than the target; ``draws, warm_up``: draws kept per chain,
    after ``warm_up`` that are not; ``start``: first states of the chains, dispersed, (chains, d);
    ``progress``: called with the share done.
    """
    chains, length = len(start), warm_up + draws
    points, log_proposal = proposal.sample(chains * length, rng)
    blocks = np.array_split(points, max(1, len(points) // REPORTED))
    log_target = []
    for done, block in enumerate(blocks, start=1):
        log_target.append(log_density(block))
        if progress is not None:
            progress(done / len(blocks))
    log_weight = (np.concatenate(log_target) - log_proposal).reshape(chains, length)
    log_uniform = np.log(rng.random((chains, length)))
    current = log_density(start) - proposal.log_density(start)
    index = np.array([_walk(*chain) for chain in zip(log_weight, log_uniform, current)])
    accepted = np.diff(index, axis=1, prepend=-1) != 0
    # The index -1 stands for the start: it picks the last point, which is the start here.
    points = np.concatenate((points.reshape(chains, length, -1), start[:, None]), axis=1)
    path = np.stack([of_chain[at] for of_chain, at in zip(points, index)])
    return Chains(path[:, warm_up:], float(accepted[:, warm_up:].mean()), path)


def _walk(log_weight: FloatArray, log_uniform: FloatArray, current: float) -> list[int]:
    """Return which proposal a chain is at after each step, n indices; -1 is the start."""
    path, here = [], -1
    for step, (weight, limit) in enumerate(zip(log_weight.tolist(), log_uniform.tolist())):
        # Both weights may be -inf: their difference is NaN, and the step is not taken.
        if limit < weight - current:
            here, current = step, weight
        path.append(here)
    return path


def random_walk_sampler(
    log_density: LogDensity,
    step: Callable[[np.random.Generator], FloatArray],
    *,
    start: FloatArray,
    steps: int,
    burn_in: int,
    rng: np.random.Generator,
    thin: int = 1,
    trace_every: int = 100,
    progress: Callable[[float], None] | None = None,
) -> Chains:
    """Sample with Metropolis' random walk (Metropolis et al. 1953), all chains side by side.

    ``log_density``: points (chains, d) to log density (chains,), up to a constant; -inf where
    there is none; ``step``: draws the proposed moves of all chains, (chains, d), from a symmetric
    distribution; ``start``: first states, (chains, d); ``steps, burn_in``: steps of every chain in
    all, and how many of them are not kept; ``thin``: every how many steps a draw is kept;
    ``trace_every``: every how many steps a state is recorded in the trace, from the start;
    ``progress``: called with the share done.
    """
    state, log_state = start.copy(), log_density(start)
    kept, trace = [], [state]
    taken = 0
    for count in range(1, steps + 1):
        candidate = state + step(rng)
        log_candidate = log_density(candidate)
        take = np.log(rng.random(len(state))) < log_candidate - log_state
        taken += int(take.sum())
        state = np.where(take[:, None], candidate, state)
        log_state = np.where(take, log_candidate, log_state)
        if count > burn_in and (count - burn_in) % thin == 0:
            kept.append(state)
        if count % trace_every == 0:
            trace.append(state)
            if progress is not None:
                progress(count / steps)
    return Chains(np.stack(kept, axis=1), taken / (steps * len(start)), np.stack(trace, axis=1))
