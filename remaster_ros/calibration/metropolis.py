"""Metropolis–Hastings on any log density: independent proposals in one batch, or a random walk.

Both work in logarithms, run several chains at once and repeat the state on rejection. They know
nothing of robots; the densities come from `posterior` and `paper_mode`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from remaster_ros.types import FloatArray, IntArray

# Proposals evaluated between two reports of progress.
REPORTED = 2000
LogDensity = Callable[[FloatArray], FloatArray]


class Chains(NamedTuple):
    """What a sampler returns.

    Attributes
    ----------
    draws
        (chains, draws, d).
    acceptance_rate
        Share of proposals taken, over all chains.
    trace
        A thinned record from the very start, warm-up and all, (chains, records, d).
    log_density_error, checked
        Where an approximate density was sampled: its largest difference from the exact one on so
        many of the draws. NaN and 0 where the exact density was.
    """

    draws: FloatArray
    acceptance_rate: float
    trace: FloatArray
    log_density_error: float = float('nan')
    checked: int = 0


class Proposal(Protocol):
    """A density that can be sampled and evaluated: the independence sampler proposes from it."""

    def sample(self, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Return points (count, d) and their log density (count,), normalised or not."""
        ...

    def log_density(self, points: FloatArray) -> FloatArray:
        """Return the same log density of points (n, d), (n,)."""
        ...


@dataclass(frozen=True, eq=False)
class StudentT:
    """A multivariate Student t distribution.

    Attributes
    ----------
    mean
        (d,).
    factor
        Lower Cholesky factor of the scale matrix, (d, d).
    freedom
        Degrees of freedom; small means heavy tails.
    """

    mean: FloatArray
    factor: FloatArray
    freedom: float

    def sample(self, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Return points (count, d) and their log density (count,)."""
        normal = rng.standard_normal((count, len(self.mean)))
        mixing = rng.chisquare(self.freedom, count) / self.freedom
        points = self.mean + (normal @ self.factor.T) / np.sqrt(mixing)[:, None]
        return points, self.log_density(points)

    def log_density(self, points: FloatArray) -> FloatArray:
        """Return the normalised log density of points (..., d), (...)."""
        shape = points.shape
        flat = (points - self.mean).reshape(-1, shape[-1])
        whitened = np.linalg.solve(self.factor, flat.T).T.reshape(shape)
        log_root = float(np.sum(np.log(np.diag(self.factor))))
        return log_student_t(np.sum(whitened**2, axis=-1), len(self.mean), self.freedom) - log_root


def log_student_t(square: FloatArray, d: int, freedom: float) -> FloatArray:
    """Return the log density of a standard t in d dimensions at squared distances (...)."""
    constant = (
        math.lgamma(0.5 * (freedom + d))
        - math.lgamma(0.5 * freedom)
        - 0.5 * d * math.log(freedom * math.pi)
    )
    return constant - 0.5 * (freedom + d) * np.log1p(square / freedom)


def independence_sampler(
    log_density: LogDensity,
    proposal: Proposal,
    *,
    chains: int,
    draws: int,
    warm_up: int,
    rng: np.random.Generator,
    start: FloatArray,
    progress: Callable[[float], None] | None = None,
) -> Chains:
    """Sample exactly with proposals that do not depend on the state.

    All proposals are evaluated in batches beforehand; the chains then walk over their importance
    weights (Hastings 1970; Tierney 1994): take y from x with probability min(1, w(y) / w(x)).

    Parameters
    ----------
    log_density
        Points (n, d) to log density (n,), up to a constant; -inf where there is none.
    proposal
        Heavier in the tails than the target.
    chains, draws, warm_up
        Draws kept per chain, after ``warm_up`` that are not.
    rng
        Source of all randomness.
    start
        First states of the chains, dispersed, (chains, d).
    progress
        Called with the share done.
    """
    length = warm_up + draws
    points, log_proposal = proposal.sample(chains * length, rng)
    log_target = np.empty(chains * length)
    blocks = np.array_split(np.arange(chains * length), max(1, chains * length // REPORTED))
    for done, block in enumerate(blocks, start=1):
        log_target[block] = log_density(points[block])
        if progress is not None:
            progress(done / len(blocks))
    points = points.reshape(chains, length, -1)
    log_weight = (log_target - log_proposal).reshape(chains, length)
    log_uniform = np.log(rng.random((chains, length)))
    current = log_density(start) - proposal.log_density(start)
    walks = [_walk(*chain) for chain in zip(log_weight, log_uniform, current, strict=True)]
    index = np.array(walks)
    accepted = np.diff(index, axis=1, prepend=-1) != 0
    path = np.take_along_axis(points, np.maximum(index, 0)[..., None], axis=1)
    chain, unmoved = np.nonzero(index < 0)
    path[chain, unmoved] = start[chain]
    return Chains(path[:, warm_up:], float(accepted[:, warm_up:].mean()), path)


def _walk(log_weight: FloatArray, log_uniform: FloatArray, current: float) -> IntArray:
    """Return which proposal the chain is at after each step, (n,); -1 is the start.

    After a step that was taken the next is judged against its neighbour, all of these at once;
    only what follows a refusal is walked through, step by step.
    """
    path = np.arange(len(log_weight))
    with np.errstate(invalid='ignore'):
        # From nowhere to nowhere is no step.
        taken = log_uniform < np.diff(log_weight, prepend=current)
    weight, uniform = log_weight.tolist(), log_uniform.tolist()
    done = 0
    for refused in np.flatnonzero(~taken).tolist():
        if refused < done:
            continue
        held = weight[refused - 1] if refused > 0 else current
        done = refused + 1
        while done < len(weight) and not uniform[done] < weight[done] - held:
            done += 1
        path[refused:done] = refused - 1
        # The step that ended the wait was taken.
        done += 1
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

    Parameters
    ----------
    log_density
        Points (chains, d) to log density (chains,), up to a constant; -inf where there is none.
    step
        Draws the proposed moves of all chains, (chains, d), from a symmetric distribution.
    start
        First states, (chains, d).
    steps, burn_in
        Steps of every chain in all, and how many of them are not kept.
    rng
        Source of all randomness.
    thin
        Every how many steps a draw is kept.
    trace_every
        Every how many steps a state is recorded in the trace, from the start.
    progress
        Called with the share done.
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
