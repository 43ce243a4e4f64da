# SPDX-License-Identifier: Apache-2.0
"""Effective samples per second of CPU: ours, the paper's algorithm, emcee, NumPyro's NUTS.

All sample one density: the paper's model (eq. 8 and 15; joint 1 held) at 173 configurations, 13
parameters. Times are CPU seconds of the process with one thread, the least of three turns each,
which other work on the machine disturbs least; the figure is the smallest
effective sample size over the parameters, per second. How each is tuned:

*The paper's*: a plain NumPy chain, one state at a time over all rows at once, all parameters moved
by U(-0.0125, 0.0125). No burn-in is charged: chains begin in the posterior. Effective samples per
step are posterior variance over N times the variance of the means of many chains of N steps;
chains that never decorrelate count as one effective sample each, so the figure is an upper bound.

*emcee*: 64 walkers, vectorised density, from the Laplace approximation in (theta, log sigma).
Differential evolution with a fifth of snooker moves was better than stretch moves. Effective
samples by emcee's own autocorrelation time; start not charged.

*NUTS*: JAX-compiled density and gradient, double precision, coordinates whitened by the Laplace
covariance, the mass matrix adapted on top. Acceptance target 0.8, which was better than 0.6.
Compilation and warm-up not charged.

*Ours*: `sample_posterior` as `remaster fit` calls it, the same model (marker as known, no common
part of the noise). Printed with and without finding the mode and preparing the proposal.

    OMP_NUM_THREADS=1 python benchmarks/bench_speed.py [--full]
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeVar

import common  # noqa: F401  its folder of helpers
import emcee
import numpy as np
from common import machine, progress, table
from paper_model import DIMENSION, NAMES, PaperModel, product_mode, product_states
from worlds.paper_experiment import OPTIMIZATION, experiment

from remaster_ros.calibration import convergence
from remaster_ros.calibration.laplace import Mode
from remaster_ros.calibration.sampling import sample_posterior
from remaster_ros.types import FloatArray, Session

SIGMA_M = 0.89e-3
HALF_WIDTH = 0.0125
# What the issue asks: ours over each, effective samples per second.
WANTED = {'paper': 1e6, 'emcee': 500.0, 'nuts': 100.0}
WALKERS = 64
WARM_UP = 500
TURNS = 3

T = TypeVar('T')


class Speed(NamedTuple):
    """A sampler's figures.

    Attributes
    ----------
    effective, seconds
        Effective samples of the worst parameter, and the CPU seconds that they took.
    note
        How.
    at_most
        Whether ``effective`` is only known to be no more than that.
    """

    name: str
    effective: float
    seconds: float
    note: str
    at_most: bool = False

    @property
    def rate(self) -> float:
        """Effective samples per second."""
        return self.effective / self.seconds


def fastest(work: Callable[[], T]) -> tuple[float, T]:
    """Return the least CPU seconds of three turns, and what the last one gave."""
    seconds = []
    for _ in range(TURNS):
        began = time.process_time()
        result = work()
        seconds.append(time.process_time() - began)
    return min(seconds), result


def ours(session: Session, mode: Mode, model: PaperModel, draws: int) -> tuple[Speed, Speed]:
    """Return our figures without and with set-up."""
    rng = np.random.default_rng(5)
    sample_posterior(mode, chains=4, draws=200, rng=rng)
    setting_up, fresh = fastest(lambda: product_mode(session))
    sampling, (run, name) = fastest(
        lambda: sample_posterior(fresh, chains=4, draws=draws, rng=rng)
    )
    states = product_states(model, mode, run.draws)
    effective = float(np.min(convergence.ess_bulk(states)))
    note = f'4 x {draws} draws, {100 * run.acceptance_rate:.1f} % taken; {name}'
    with_set_up = f'plus {setting_up:.3f} s from the session to the mode'
    return (
        Speed('ours', effective, sampling, note),
        Speed('ours, set-up and all', effective, sampling + setting_up, with_set_up),
    )


def paper_chain(
    model: PaperModel, start: FloatArray, steps: int, rng: np.random.Generator
) -> float:
    """Run the paper's loop, one state at a time; return CPU seconds per step."""
    state, value = start, model.log_density(start, power=2)
    began = time.process_time()
    for _ in range(steps):
        candidate = state + rng.uniform(-HALF_WIDTH, HALF_WIDTH, DIMENSION)
        candidate_value = model.log_density(candidate, power=2)
        if np.log(rng.random()) < candidate_value - value:
            state, value = candidate, candidate_value
    return (time.process_time() - began) / steps


def paper(model: PaperModel, posterior: FloatArray, chains: int, steps: int) -> Speed:
    """Return the paper's figures; its chains begin in, and are judged by, draws (n, 13)."""
    rng = np.random.default_rng(6)
    per_step = min(paper_chain(model, posterior[0], 2000, rng) for _ in range(TURNS))
    state = posterior[rng.choice(len(posterior), chains, replace=False)]
    value = model.log_density(state, power=2)
    total, taken = np.zeros_like(state), 0
    for step in range(steps):
        candidate = state + rng.uniform(-HALF_WIDTH, HALF_WIDTH, state.shape)
        candidate_value = model.log_density(candidate, power=2)
        take = np.log(rng.random(chains)) < candidate_value - value
        taken += int(take.sum())
        state = np.where(take[:, None], candidate, state)
        value = np.where(take, candidate_value, value)
        total += state
        if step % 500 == 0:
            progress(f"the paper's chains: {100 * step / steps:.0f} %")
    progress('')
    error = np.mean((total / steps - posterior.mean(axis=0)) ** 2, axis=0)
    # More than one effective sample each is measured, fewer cannot be distinguished from one.
    each = np.maximum(posterior.var(axis=0) / error, 1.0)
    worst = int(np.argmin(each))
    note = (
        f'{chains} chains of {steps} steps, {100 * taken / (chains * steps):.1f} % taken, '
        f'{each[worst]:.1f} effective each (worst: {NAMES[worst]}), {1e6 * per_step:.0f} us a step'
    )
    return Speed(
        "the paper's, plain NumPy",
        float(each[worst]),
        steps * per_step,
        note,
        at_most=bool(each[worst] == 1.0),
    )


def laplace(
    model: PaperModel,
) -> tuple[FloatArray, FloatArray, Callable[[FloatArray], FloatArray]]:
    """Return peak and Cholesky factor in (theta, log sigma), and the log density there."""
    peak, covariance = model.peak()

    def log_density(points: FloatArray) -> FloatArray:
        states = np.concatenate((points[..., :-1], np.exp(points[..., -1:])), axis=-1)
        # d sigma = sigma d log sigma.
        return model.log_density(states) + points[..., -1]

    return peak, np.linalg.cholesky(covariance), log_density


def by_emcee(model: PaperModel, steps: int) -> Speed:
    peak, root, log_density = laplace(model)
    rng = np.random.default_rng(7)
    start = peak + rng.standard_normal((WALKERS, DIMENSION)) @ root.T
    moves = [(emcee.moves.DEMove(), 0.8), (emcee.moves.DESnookerMove(), 0.2)]
    sampler = emcee.EnsembleSampler(WALKERS, DIMENSION, log_density, moves=moves, vectorize=True)
    sampler.random_state = np.random.RandomState(8).get_state()

    def run() -> None:
        sampler.reset()
        sampler.run_mcmc(start, steps, skip_initial_state_check=True)

    seconds, _ = fastest(run)
    chain = sampler.get_chain(discard=steps // 10)
    tau = float(np.max(emcee.autocorr.integrated_time(chain, tol=10)))
    note = f'{WALKERS} walkers, {steps} steps, autocorrelation time {tau:.0f}'
    return Speed('emcee', WALKERS * steps / tau, seconds, note)


def by_nuts(model: PaperModel, draws: int) -> Speed:
    # One thread, as the others; set before JAX starts.
    os.environ['XLA_FLAGS'] = '--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1'
    import jax
    import jax.numpy as jnp
    from numpyro.infer import NUTS

    jax.config.update('jax_enable_x64', True)
    peak, root, _ = laplace(model)

    def potential(u: jax.Array) -> jax.Array:
        point = peak + root @ u
        state = jnp.append(point[:-1], jnp.exp(point[-1]))
        return -(model.log_density(state, xp=jnp) + point[-1])

    kernel = NUTS(potential_fn=potential, target_accept_prob=0.8)

    @partial(jax.jit, static_argnums=1)
    def advance(state: Any, count: int) -> tuple[Any, Any]:
        def step(state: Any, _: None) -> tuple[Any, Any]:
            state = kernel.sample(state, (), {})
            return state, (state.z, state.num_steps)

        return jax.lax.scan(step, state, None, length=count)

    starts = np.random.default_rng(9).standard_normal((4, DIMENSION))
    states = [
        advance(kernel.init(jax.random.PRNGKey(i), WARM_UP, start, (), {}), WARM_UP)[0]
        for i, start in enumerate(starts)
    ]
    # Once to compile, once by the clock.
    states = [advance(state, draws)[0] for state in states]
    seconds, runs = fastest(
        lambda: [jax.block_until_ready(advance(state, draws)[1]) for state in states]
    )
    u = np.array([z for z, _ in runs])
    gradients = int(np.sum([steps for _, steps in runs]))
    effective = float(np.min(convergence.ess_bulk(u @ root.T)))
    note = f'4 x {draws} draws, {1e6 * seconds / gradients:.0f} us a gradient'
    return Speed('NumPyro NUTS', effective, seconds, note)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('--full', action='store_true', help="the paper's 2e5 steps; five minutes")
    args = parser.parse_args()
    rng = np.random.default_rng(0)
    session, _ = experiment(
        rng, {'mocap': (SIGMA_M, 0.0)}, marker_std_m=0.0, sizes=(OPTIMIZATION,)
    )
    model, mode = PaperModel.of(session), product_mode(session)
    print(machine())
    product_speed, with_set_up = ours(session, mode, model, 50_000 if args.full else 10_000)
    run, _ = sample_posterior(mode, chains=4, draws=5000, rng=rng)
    posterior = product_states(model, mode, run.draws).reshape(-1, DIMENSION)
    rivals = {
        'paper': paper(model, posterior, 24, 200_000 if args.full else 20_000),
        'emcee': by_emcee(model, 5000 if args.full else 2000),
        'nuts': by_nuts(model, 2000 if args.full else 400),
    }
    rows = [
        (
            speed.name,
            f'{speed.rate:.3g}',
            _ratio(product_speed, speed, WANTED.get(key)),
            speed.note,
        )
        for key, speed in {'': product_speed, 'set-up': with_set_up, **rivals}.items()
    ]
    header = ('sampler', 'effective samples per CPU second', 'ours is faster', 'how')
    print(table(header, rows))


def _ratio(product_speed: Speed, other: Speed, wanted: float | None) -> str:
    ratio = product_speed.rate / other.rate
    if wanted is None:
        return f'{ratio:.3g}'
    if ratio >= wanted:
        verdict = 'yes'
    else:
        verdict = 'longer chains would show' if other.at_most else 'NO'
    least = 'at least ' if other.at_most else ''
    return f'**{least}{ratio:.3g} times** (wanted {wanted:g}: {verdict})'


if __name__ == '__main__':
    main()
