# SPDX-License-Identifier: Apache-2.0
"""Metropolis–Hastings on any log density: independent proposals in one batch, or a random walk.

Both samplers run several chains at once and repeat the state of a chain whose proposal is
rejected.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple, Protocol

import numpy as np

from remaster_ros.types import FloatArray

# Number of proposals evaluated between two reports of progress.
REPORTED = 2000
LogDensity = Callable[[FloatArray], FloatArray]
Method = Literal['metropolis', 'laplace']


class Chains(NamedTuple):
    """Draws of several chains of a sampler, with their acceptance rate and a thinned record."""

    draws: FloatArray  # (chains, draws, d)
    acceptance_rate: float  # Share of accepted proposals, over all chains
    # A thinned record from the first state on, warm-up included, (chains, records, d)
    trace: FloatArray
    # 'metropolis', or 'laplace' for draws of the Gaussian about the mode, which are no chains
    method: Method = 'metropolis'
    # If no chain of the adapted proposal was long enough: the shape of the tail of the importance
    # weights of its draws, and their effective number of draws. NaN for chains.
    pareto_k: float = float('nan')
    effective: float = float('nan')
    # R-hat, and effective draws of bulk and of tails, of the p quantities that decided the length
    # of the chains, (p,) each; None if the length was given
    figures: tuple[FloatArray, FloatArray, FloatArray] | None = None


class Proposal(Protocol):
    """Density with draws and values, from which the independence sampler proposes."""

    def sample(self, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Draws (count, d) and their log density (count,), normalised or not."""
        ...

    def log_density(self, points: FloatArray) -> FloatArray:
        """Log density (n,) of points (n, d), up to the same constant as in `sample`."""
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
    """Draws of a density by Metropolis–Hastings with proposals that do not depend on the state.

    All proposals are evaluated in batches beforehand; each chain then accepts y from x with
    probability min(1, w(y) / w(x)) of the importance weights w (Hastings 1970; Tierney 1994).

    ``log_density``: log density (n,) of points (n, d), up to a constant, -inf outside;
    ``proposal``: with heavier tails than the density; ``draws, warm_up``: draws of each chain that
    are kept, and draws before them that are not; ``start``: dispersed first states, (chains, d);
    ``progress``: called with the share that is done.
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
    index = np.array([_states_of_chain(*chain) for chain in zip(log_weight, log_uniform, current)])
    accepted = np.diff(index, axis=1, prepend=-1) != 0
    # The index -1 stands for the start: it picks the last point, which is the start here.
    points = np.concatenate((points.reshape(chains, length, -1), start[:, None]), axis=1)
    path = np.stack([of_chain[at] for of_chain, at in zip(points, index)])
    return Chains(path[:, warm_up:], float(accepted[:, warm_up:].mean()), path)


def _states_of_chain(log_weight: FloatArray, log_uniform: FloatArray, current: float) -> list[int]:
    """Index of the proposal at which the chain is after each step, n indices; -1 is the start.

    ``log_weight``: log importance weights of the n proposals; ``log_uniform``: logs of uniform
    draws, (n,); ``current``: log weight of the start. A step is taken if its log uniform is
    below the difference of the log weights, proposal less present state.
    """
    path, state = [], -1
    for step, (weight, limit) in enumerate(zip(log_weight.tolist(), log_uniform.tolist())):
        # Both weights may be -inf: their difference is NaN, and the step is not taken.
        if limit < weight - current:
            state, current = step, weight
        path.append(state)
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
    """Draws by Metropolis' random walk (Metropolis et al. 1953), all chains at once.

    ``log_density``: log density (chains,) of points (chains, d), up to a constant, -inf outside;
    ``step``: proposed steps of all chains, (chains, d), from a symmetric distribution; ``start``:
    first states, (chains, d); ``steps, burn_in``: number of steps of each chain, and how many of
    the first are not kept; ``thin``: number of steps between kept draws; ``trace_every``: number
    of steps between the states in the trace; ``progress``: called with the share that is done.
    """
    state, log_state = start.copy(), log_density(start)
    kept, trace = [], [state]
    accepted = 0
    for count in range(1, steps + 1):
        candidate = state + step(rng)
        log_candidate = log_density(candidate)
        take = np.log(rng.random(len(state))) < log_candidate - log_state
        accepted += int(take.sum())
        state = np.where(take[:, None], candidate, state)
        log_state = np.where(take, log_candidate, log_state)
        if count > burn_in and (count - burn_in) % thin == 0:
            kept.append(state)
        if count % trace_every == 0:
            trace.append(state)
            if progress is not None:
                progress(count / steps)
    return Chains(np.stack(kept, axis=1), accepted / (steps * len(start)), np.stack(trace, axis=1))
