# SPDX-License-Identifier: Apache-2.0
"""Does the fast sampler sample the posterior itself? Against a long run of another program.

The model of eq. 8 and 15 (joint 1 held, see `paper_model`) at 173 configurations. The gold run
is an independence Metropolis-Hastings sampler of its own: the density is that of `paper_model`,
evaluated row by row in double precision for every proposal; proposals come from the scaled
inverse chi-square of sigma and the normal of the rest at a numerically found peak, a tenth of them
widened. Nothing is shared with the product but the chain of joint frames read from the URDF.

Printed are, over the 13 parameters in the paper's own units, the largest difference of posterior
means in posterior std (limit 0.02) and the largest difference of standard deviations (limit 1 %),
each with what the two runs' own Monte-Carlo errors allow.

    OMP_NUM_THREADS=1 python benchmarks/bench_exactness.py [--gold 1100000] [--draws 50000]
"""

from __future__ import annotations

import argparse
import time

import common  # noqa: F401  its folder of helpers
import numpy as np
from common import machine, progress, table
from paper_model import DIMENSION, NAMES, PaperModel, product_mode, product_states
from scipy.special import gammaln
from worlds.paper_experiment import OPTIMIZATION, experiment

from remaster_ros.calibration import convergence
from remaster_ros.calibration.sampling import sample_posterior
from remaster_ros.types import FloatArray

SIGMA_M = 0.89e-3
MEAN_LIMIT, STD_LIMIT = 0.02, 0.01
GOLD_CHAINS = 4
WIDE_SHARE, WIDE = 0.1, 1.3
BATCH = 2000


def gold_run(model: PaperModel, draws: int, rng: np.random.Generator) -> tuple[FloatArray, float]:
    """Return states (chains, draws, 13) and the share of proposals taken."""
    peak, covariance = model.peak()
    f = DIMENSION - 1
    freedom = 3 * len(model.q) - f
    root = np.linalg.cholesky(covariance[:f, :f]) / np.exp(peak[f])
    scale = freedom * np.exp(2.0 * peak[f])

    def propose(count: int) -> tuple[FloatArray, FloatArray]:
        """Return states and their log proposal density in d theta d sigma."""
        sigma = np.sqrt(scale / rng.chisquare(freedom, count))
        whitened = rng.standard_normal((count, f))
        whitened *= np.where(rng.random(count) < WIDE_SHARE, WIDE, 1.0)[:, None]
        square = np.sum(whitened**2, axis=1)
        of_theta = np.logaddexp(
            np.log1p(-WIDE_SHARE) - 0.5 * square,
            np.log(WIDE_SHARE) - f * np.log(WIDE) - 0.5 * square / WIDE**2,
        ) - f * np.log(sigma)
        half = 0.5 * freedom
        of_sigma = (
            half * np.log(0.5 * scale)
            - gammaln(half)
            - (freedom + 1) * np.log(sigma)
            - 0.5 * scale / sigma**2
        )
        theta = peak[:f] + sigma[:, None] * (whitened @ root.T)
        return np.column_stack((theta, sigma)), of_theta + of_sigma

    length = draws // GOLD_CHAINS
    chains, taken = np.empty((GOLD_CHAINS, length, DIMENSION)), 0
    for chain in chains:
        (state,), (log_proposal,) = propose(1)
        weight = model.log_density(state) - log_proposal
        for start in range(0, length, BATCH):
            states, log_proposals = propose(min(BATCH, length - start))
            weights = model.log_density(states) - log_proposals
            log_uniform = np.log(rng.random(len(states)))
            for i in range(len(states)):
                if log_uniform[i] < weights[i] - weight:
                    state, weight, taken = states[i], weights[i], taken + 1
                chain[start + i] = state
            progress(f'gold run: {100 * start / length:.0f} % of a chain')
    progress('')
    return chains, taken / (length * GOLD_CHAINS)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('--gold', type=int, default=200_000, help='draws of the gold run')
    parser.add_argument(
        '--draws', type=int, default=25_000, help="draws of each of ours' 4 chains"
    )
    parser.add_argument('--seed', type=int, default=0)
    args = parser.parse_args()
    data, gold_rng, our_rng = np.random.default_rng(args.seed).spawn(3)
    session, _ = experiment(
        data, {'mocap': (SIGMA_M, 0.0)}, marker_std_m=0.0, sizes=(OPTIMIZATION,)
    )
    model = PaperModel.of(session)
    started = time.perf_counter()
    gold, acceptance = gold_run(model, args.gold, gold_rng)
    between = time.perf_counter()
    run, name = sample_posterior(product_mode(session), chains=4, draws=args.draws, rng=our_rng)
    seconds = time.perf_counter() - between
    ours = product_states(model, product_mode(session), run.draws)

    gold_ess, our_ess = convergence.ess_bulk(gold), convergence.ess_bulk(ours)
    gold_flat, our_flat = gold.reshape(-1, DIMENSION), ours.reshape(-1, DIMENSION)
    gold_std = gold_flat.std(axis=0)
    mean = (our_flat.mean(axis=0) - gold_flat.mean(axis=0)) / gold_std
    std = our_flat.std(axis=0) / gold_std - 1.0
    chance = np.sqrt(1.0 / gold_ess + 1.0 / our_ess)
    print(machine())
    print(
        f'gold: {len(gold_flat)} draws, {gold_ess.min():.0f} effective, {100 * acceptance:.1f} % '
        f'taken, {between - started:.0f} s\n'
        f'ours: {len(our_flat)} draws, {our_ess.min():.0f} effective, '
        f'{100 * run.acceptance_rate:.1f} % taken, {seconds:.1f} s ({name})\n'
    )
    rows = [
        (label, f'{m:.4f}', f'{s:.4f}', f'{dm:+.4f}', f'{100 * ds:+.2f}')
        for label, m, s, dm, ds in zip(NAMES, gold_flat.mean(axis=0), gold_std, mean, std)
    ]
    header = ('parameter (mm, deg)', 'gold mean', 'gold std', 'ours: mean, std', 'ours: std, %')
    print(table(header, rows))
    worst_mean, worst_std = np.max(np.abs(mean)), np.max(np.abs(std))
    print(
        f'\nlargest difference of means {worst_mean:.4f} std (limit {MEAN_LIMIT}, chance '
        f'{chance.max():.4f}), of std {100 * worst_std:.2f} % (limit {100 * STD_LIMIT:g} %, '
        f'chance {100 * chance.max() / np.sqrt(2.0):.2f} %): '
        f'{"holds" if worst_mean <= MEAN_LIMIT and worst_std <= STD_LIMIT else "DOES NOT HOLD"}'
    )


if __name__ == '__main__':
    main()
