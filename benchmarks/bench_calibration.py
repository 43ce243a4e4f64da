"""Are the intervals right? Sessions with random truths: coverage, rank statistics, efficiency.

Every session has the paper's size (36 poses, 173 configurations), one of three choices of sensors
(mocap, tracker, both) and one of three kinds of noise:

    independent  per point only
    common       a part common to all solutions of a pose, 2 to 6 times the part per point
    prior        the ratio of the two parts drawn from the fit's own prior, half-Cauchy

The size of the noise is drawn log-uniformly from 0.02 to 0.5 mm, the offsets from N(0, 0.3 deg),
the markers from their prior, all anew for each session. Printed are, over all sessions,

*Coverage* of the central 95 % intervals. The common part under independent noise is left out: its
truth is exactly 0, where no central interval reaches.

*Ranks* of the truth among the draws (simulation-based calibration, Talts et al. 2018), with the
p-value of a chi-square test in 20 bins. Ranks are uniform only for truths from the prior. The
priors of offsets, registrations and log sigma are flat, so there is nothing to draw from; but flat
priors are those of the shifts and the scale that leave the model as it is (to first order in
offsets of a fraction of a degree), and then ranks are uniform for *any* truth. Markers and the
ratio of the noises have proper priors and are drawn from them; so sessions of kind `prior` decide.

*Efficiency*: RMS of (posterior mean - truth) over the Cramér-Rao bound of the session: inverse
Fisher information of all parameters and the markers' prior at the truth, with the noise known.

Compared are parameters in coordinates that the data can see (joint 1 turned into the
registrations, the last joint into the markers).

    OMP_NUM_THREADS=1 python benchmarks/bench_calibration.py [--sessions 1000] [--record FILE]

With --record a run goes on where it was stopped.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from common import OPTIMIZATION, experiment, in_parallel, machine, progress, table
from scipy.stats import binom, chi2, kstest

from remaster_ros.calibration.estimate import Estimate, Problem, estimate
from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.model import Model
from remaster_ros.calibration.sampling import sample_posterior
from remaster_ros.kinematics.transforms import inverse
from remaster_ros.simulation.session_simulator import SessionTruth
from remaster_ros.types import FloatArray

SENSORS = (('mocap',), ('tracker',), ('mocap', 'tracker'))
NOISES = ('independent', 'common', 'prior')
SIGMA_M = (0.02e-3, 0.5e-3)
RATIO = (2.0, 6.0)
# The half-Cauchy reaches metres, at which the fit rightly refuses. What is cut off is so plain to
# the data that ranks of the rest do not notice.
MOST_COMMON_M = 5e-3
# Ranks run from 0 to this: the draws are thinned to so many.
RANKS = 199
BINS = 20


class Outcome(NamedTuple):
    """What one session showed: per parameter whether its interval holds, its rank; its errors.

    Attributes
    ----------
    inside, rank
        By parameter.
    error
        (posterior mean - truth) / Cramér-Rao bound of the inner joints' offsets.
    """

    seed: int
    sensors: str
    noise: str
    inside: dict[str, bool]
    rank: dict[str, int]
    error: list[float]


def draw_noise(kind: str, rng: np.random.Generator) -> tuple[float, float]:
    """Return sigma and pose_sigma, m."""
    while True:
        sigma, pose_sigma = _any_noise(kind, rng)
        if pose_sigma < MOST_COMMON_M:
            return sigma, pose_sigma


def _any_noise(kind: str, rng: np.random.Generator) -> tuple[float, float]:
    sigma = float(np.exp(rng.uniform(*np.log(SIGMA_M))))
    if kind == 'independent':
        return sigma, 0.0
    if kind == 'common':
        return sigma, sigma * float(rng.uniform(*RATIO))
    return sigma, sigma * float(np.abs(np.tan(np.pi * (rng.random() - 0.5))))


def one_session(seed: int, poses: tuple[int, int] = OPTIMIZATION) -> Outcome:
    """Simulate and fit the session of a seed; the kinds take turns."""
    rng = np.random.default_rng([20261121, seed])
    sensors, noise = SENSORS[seed % 3], NOISES[seed // 3 % 3]
    session, truth = experiment(
        rng, {name: draw_noise(noise, rng) for name in sensors}, sizes=(poses,)
    )
    found = estimate(Problem.of(session))
    names, draws = visible_draws(found, rng)
    true = visible_truth(found.model, truth)
    thinned = draws[rng.permutation(len(draws))[:RANKS]]
    low, high = np.quantile(draws, (0.025, 0.975), axis=0)
    inside, rank = {}, {}
    for index, name in enumerate(names):
        value = true[name]
        if name.endswith('pose_sigma') and noise == 'independent':
            continue
        inside[name] = bool(low[index] <= value <= high[index])
        rank[name] = int(np.sum(thinned[:, index] < value))
    inner = list(found.model.names[1 : found.model.joints - 1])
    where = [names.index(name) for name in inner]
    error = draws[:, where].mean(axis=0) - [true[name] for name in inner]
    bound = cramer_rao_std(found, truth)[1 : found.model.joints - 1]
    return Outcome(seed, '+'.join(sensors), noise, inside, rank, (error / bound).tolist())


def visible_draws(found: Estimate, rng: np.random.Generator) -> tuple[list[str], FloatArray]:
    """Sample as the product does; return names and draws of what the data can see, (n, p)."""
    posterior, model = found.posterior, found.model
    run, _ = sample_posterior(found.mode, chains=4, draws=1000, rng=rng)
    points = run.draws.reshape(-1, run.draws.shape[-1])
    z = posterior.parameters(points)
    sigma, pose_sigma = posterior.sensor_noise(points[:, len(posterior.free) :])
    columns = np.concatenate((z[:, visible(model)], sigma, pose_sigma), axis=1)
    return visible_names(model), columns


def visible(model: Model) -> list[int]:
    """Return the indices of all parameters but the outer two joints, which move nothing."""
    return [i for i in range(model.size) if i not in (0, model.joints - 1)]


def visible_names(model: Model) -> list[str]:
    names = [model.names[i] for i in visible(model)]
    for part in ('sigma', 'pose_sigma'):
        names += [f'noise.{sensor}.{part}' for sensor in model.sensor_names]
    return names


def visible_truth(model: Model, truth: SessionTruth) -> dict[str, float]:
    """Return the truth in the same coordinates."""
    noise = [truth.sensors[name].sigma_m for name in model.sensor_names]
    noise += [truth.sensors[name].pose_sigma_m for name in model.sensor_names]
    values = np.concatenate((pinned_truth(model, truth)[visible(model)], noise))
    return dict(zip(visible_names(model), values.tolist()))


def pinned_truth(model: Model, truth: SessionTruth) -> FloatArray:
    """Return the true parameters in the model's pinned coordinates, (size,)."""
    markers = np.array([truth.markers[name] for name in model.marker_names])
    T_R_N = np.array([truth.sensors[name].T_R_N for name in model.sensor_names])
    x = model.vector(truth.joint_offsets, markers)
    return model.pinned(model.with_corrections(x, model.reference @ inverse(T_R_N)))


def cramer_rao_std(found: Estimate, truth: SessionTruth) -> FloatArray:
    """Return the bound of the model's pinned parameters, (size,); NaN where nothing tells."""
    model = found.model
    rows = Rows.of(found.problem.measurements, found.problem.fitted, model.reference)
    z = pinned_truth(model, truth)
    derivative = model.jacobian(z, rows)
    information = np.zeros((model.size, model.size))
    for start, size, sensor in zip(rows.group_start, rows.group_size, rows.group_sensor):
        noise = truth.sensors[model.sensor_names[sensor]]
        # Of one axis, all solutions of a pose: their common part fills the matrix.
        covariance = noise.sigma_m**2 * np.eye(size) + noise.pose_sigma_m**2
        part = derivative[start : start + size].transpose(1, 0, 2)
        information += np.sum(part.transpose(0, 2, 1) @ np.linalg.solve(covariance, part), axis=0)
    # The last joint turns the marker, and only the prior on the marker's own place resists: seen
    # from the inner joints that is the same marker with a prior loose along the turn. Shifts of
    # half a millimetre change no direction that matters, so the prior is taken at the truth.
    marker_std = found.problem.session.marker_std_m
    origin, axis = model.tool_axis
    for marker in range(len(model.marker_names)):
        where = model.marker(marker)
        information[where, where] += np.eye(3) / marker_std**2
        turned = np.cross(axis, z[where] - origin)
        last = model.joints - 1
        information[last, last] += turned @ turned / marker_std**2
        information[where, last] -= turned / marker_std**2
        information[last, where] -= turned / marker_std**2
    free = np.flatnonzero(np.diag(information) > 0.0)
    scale = 1.0 / np.sqrt(np.diag(information)[free])
    scaled = information[np.ix_(free, free)] * np.outer(scale, scale)
    std = np.full(model.size, np.nan)
    std[free] = scale * np.sqrt(np.diag(np.linalg.inv(scaled)))
    return std


def report(outcomes: Sequence[Outcome]) -> str:
    """Return the tables."""
    parts = [_coverage(outcomes), _ranks(outcomes), _efficiency(outcomes)]
    return '\n\n'.join(parts)


def kind_of(name: str) -> str:
    """Return which group a parameter belongs to."""
    group = name.split('.')[0]
    if group == 'noise':
        return name.split('.')[-1]
    return group if group in ('registration', 'marker') else 'offset'


def _coverage(outcomes: Sequence[Outcome]) -> str:
    rows = []
    by_name: dict[str, list[bool]] = {}
    for outcome in outcomes:
        for name, held in outcome.inside.items():
            by_name.setdefault(name, []).append(held)
    for kind in dict.fromkeys(map(kind_of, by_name)):
        names = [name for name in by_name if kind_of(name) == kind]
        shares = [float(np.mean(by_name[name])) for name in names]
        counts = [len(by_name[name]) for name in names]
        together = float(np.average(shares, weights=counts))
        fewest = min(counts)
        low, high = binom.interval(0.99, fewest, 0.95) if fewest else (0, 0)
        rows.append(
            (
                kind,
                len(names),
                f'{fewest}',
                f'{100 * together:.1f}',
                f'{100 * min(shares):.1f} to {100 * max(shares):.1f}',
                f'{100 * low / fewest:.1f} to {100 * high / fewest:.1f}',
            )
        )
    cells = []
    for noise in NOISES:
        for sensors in SENSORS:
            mine = [o for o in outcomes if (o.noise, o.sensors) == (noise, '+'.join(sensors))]
            held = [h for o in mine for n, h in o.inside.items() if kind_of(n) == 'offset']
            if held:
                error = 100 * np.sqrt(0.95 * 0.05 / len(held))
                cells.append(
                    (
                        noise,
                        ' + '.join(sensors),
                        len(mine),
                        f'{100 * np.mean(held):.1f}',
                        f'{error:.1f}',
                    )
                )
    header = (
        'parameters',
        'how many',
        'sessions each, at least',
        'all together, %',
        'from worst to best, %',
        'of one at 95 %: 99 % of chance lies in',
    )
    of_offsets = ('noise', 'sensors', 'sessions', 'offsets held, %', 'std of that by chance')
    return (
        f'Coverage of central 95 % intervals\n\n{table(header, rows)}\n\n'
        f'Offsets, by kind of session\n\n{table(of_offsets, cells)}'
    )


def _ranks(outcomes: Sequence[Outcome]) -> str:
    rows = []
    for title, chosen in (
        ('all', outcomes),
        ('prior only', [o for o in outcomes if o.noise == 'prior']),
    ):
        ranks: dict[str, list[int]] = {}
        for outcome in chosen:
            for name, rank in outcome.rank.items():
                if title == 'all' and 'pose_sigma' in name:
                    continue
                ranks.setdefault(name, []).append(rank)
        p_values = {name: _uniform(values) for name, values in ranks.items()}
        if not p_values:
            continue
        worst = min(p_values, key=lambda name: p_values[name][0])
        p = np.array([chi for chi, _ in p_values.values()])
        rows.append(
            (
                title,
                len(p),
                len(chosen),
                f'{p.min():.4f} ({worst})',
                f'{min(1.0, len(p) * p.min()):.2f}',
                f'{np.sum(p < 0.05)} ({0.05 * len(p):.1f} expected)',
                f'{min(ks for _, ks in p_values.values()):.4f}',
            )
        )
    header = (
        'sessions',
        'parameters',
        'how many',
        'smallest chi-square p',
        'times the number of tests',
        'p below 0.05',
        'smallest KS p',
    )
    note = 'pose_sigma has a proper prior: its ranks are uniform in sessions of kind `prior` only.'
    return f'Ranks ({BINS} bins)\n\n{table(header, rows)}\n\n{note}'


def _uniform(ranks: Sequence[int]) -> tuple[float, float]:
    """Return p-values that ranks 0 … RANKS are uniform, by chi-square and Kolmogorov-Smirnov."""
    values = np.asarray(ranks)
    found = np.bincount(values * BINS // (RANKS + 1), minlength=BINS)
    expected = len(values) / BINS
    statistic = float(np.sum((found - expected) ** 2) / expected)
    # The middle of each rank's step: a continuous stand-in, for a test of continuous values.
    return float(chi2.sf(statistic, BINS - 1)), float(
        kstest((values + 0.5) / (RANKS + 1), 'uniform').pvalue
    )


def _efficiency(outcomes: Sequence[Outcome]) -> str:
    rows = []
    for title, chosen in (
        ('all', outcomes),
        *((noise, [o for o in outcomes if o.noise == noise]) for noise in NOISES),
    ):
        errors = np.array([outcome.error for outcome in chosen])
        if len(errors) == 0:
            continue
        squares = np.mean(errors**2, axis=1)
        ratio = float(np.sqrt(squares.mean()))
        spread = float(squares.std() / np.sqrt(len(squares)) / (2.0 * ratio))
        by_joint = ' '.join(f'{value:.3f}' for value in np.sqrt(np.mean(errors**2, axis=0)))
        rows.append((title, len(errors), f'{ratio:.3f}', f'{spread:.3f}', by_joint))
    header = ('noise', 'sessions', 'RMS error / bound', 'std of that by chance', 'joint by joint')
    return f'Standard error of the offsets over the Cramér-Rao bound\n\n{table(header, rows)}'


def read_record(path: Path | None) -> list[Outcome]:
    """Return the outcomes of an earlier run; a last line cut short is left out."""
    if path is None or not path.is_file():
        return []
    found = []
    for line in path.read_text(encoding='utf-8').splitlines():
        try:
            found.append(Outcome(**json.loads(line)))
        except (ValueError, TypeError):
            continue
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('--sessions', type=int, default=90, help='how many (default 90)')
    parser.add_argument('--record', type=Path, help='JSON lines of what is done; goes on from it')
    parser.add_argument('--workers', type=int, default=os.cpu_count() or 1)
    args = parser.parse_args()
    outcomes = [o for o in read_record(args.record) if o.seed < args.sessions]
    seeds = sorted(set(range(args.sessions)) - {outcome.seed for outcome in outcomes})
    print(f'{machine()}; {args.sessions} sessions, {len(outcomes)} of them from {args.record}')
    started = time.perf_counter()
    file = args.record.open('a', encoding='utf-8') if args.record else None
    for outcome in in_parallel(one_session, seeds, args.workers):
        outcomes.append(outcome)
        if file is not None:
            file.write(json.dumps(outcome._asdict()) + '\n')
            file.flush()
        progress(f'{len(outcomes)} of {args.sessions}')
        if len(outcomes) % 250 == 0 and len(outcomes) < args.sessions:
            print(f'-- after {len(outcomes)} sessions\n{report(outcomes)}\n', flush=True)
    progress('')
    print(report(outcomes))
    print(f'\n{len(seeds)} sessions in {time.perf_counter() - started:.0f} s')


if __name__ == '__main__':
    main()
