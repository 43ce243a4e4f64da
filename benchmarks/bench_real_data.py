# SPDX-License-Identifier: Apache-2.0
"""Real robots, zero-offsets only: `remaster fit` on the public sets beside this repository.

Prints the mean error on the held-out poses, nothing refitted, and what an independent fit of
others reached with registration, marker and zero-offsets. Then how much of what is held out lies
where the posterior predicts it: the share of errors inside their 95 % regions (ellipsoids of
the noise plus the spread of the prediction over the draws), point by point, pose by pose (the mean
error of a pose's points), and for what is left of a point after its pose's mean. Last how the
errors of two solutions of a pose hang together, which the model takes as zero or positive.

    OMP_NUM_THREADS=1 python benchmarks/bench_real_data.py [FOLDER]    (default: ../shared/data)
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from common import table
from scipy.stats import chi2, kurtosis

from remaster_ros.calibration.estimate import Problem, estimate
from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.sampling import sample_posterior
from remaster_ros.session.records.reader import read_session
from remaster_ros.types import FloatArray

# Largest held-out mean that is as good as the independent fit's, mm.
LIMITS_MM = {'ur10_two_solutions': 1.02, 'irb120_three_points': 0.64}
DRAWS = 400


class Coverage(NamedTuple):
    """Shares inside the 95 % regions, and what the errors look like.

    Attributes
    ----------
    points, poses, within
        Whether each point, each pose's mean, each point less its pose's mean is inside.
    ratio
        RMS of the held-out errors over the predicted one: points, poses, within.
    excess
        Kurtosis of the whitened errors above the Gaussian's.
    correlation
        Between the errors of two points of one pose; NaN where no pose has two.
    """

    points: FloatArray
    poses: FloatArray
    within: FloatArray
    ratio: tuple[float, float, float]
    excess: float
    correlation: float


def coverage(folder: Path) -> Coverage:
    """Compare the held-out rows of a session with what its fit predicts of them."""
    rng = np.random.default_rng(0)
    found = estimate(Problem.of(read_session(folder)))
    posterior, model = found.posterior, found.model
    run, _ = sample_posterior(found.mode, chains=4, draws=1000, rng=rng)
    points = run.draws.reshape(-1, run.draws.shape[-1])
    points = points[rng.choice(len(points), DRAWS, replace=False)]
    measurements = found.problem.measurements
    rows = Rows.of(measurements, np.flatnonzero(measurements.is_validation), model.reference)
    predicted = model.predict(posterior.parameters(points), rows)
    noise = posterior.noise_model.sensor_noise(posterior.noise(points[:, len(posterior.free) :]))
    sigma, pose_sigma = (
        np.sqrt(np.mean(part**2, axis=0))[rows.group_sensor]
        for part in (noise.sigma, noise.pose_sigma)
    )
    group, size = rows.group_of_row, rows.group_size
    errors = rows.target - predicted.mean(axis=0)
    mean = rows.group_sum(errors) / size[:, None]
    spread = predicted - predicted.mean(axis=0)
    spread_of_mean = np.swapaxes(rows.group_sum(np.swapaxes(spread, 0, 1)), 0, 1) / size[:, None]

    of_points = _squares(errors, spread, (sigma**2 + pose_sigma**2)[group])
    of_poses = _squares(mean, spread_of_mean, sigma**2 / size + pose_sigma**2)
    several = size[group] > 1
    less = (1.0 - 1.0 / size)[group][several] * sigma[group][several] ** 2
    of_rest = _squares(
        (errors - mean[group])[several], (spread - spread_of_mean[:, group])[:, several], less
    )
    limit = chi2.ppf(0.95, 3)
    whitened = errors / np.sqrt((sigma**2 + pose_sigma**2)[group])[:, None]
    return Coverage(
        of_points < limit,
        of_poses < limit,
        of_rest < limit,
        tuple(
            float(np.sqrt(np.mean(s) / 3.0)) if len(s) else np.nan
            for s in (of_points, of_poses, of_rest)
        ),
        float(kurtosis(whitened, axis=None)),
        _correlation(errors, rows),
    )


def _correlation(errors: FloatArray, rows: Rows) -> float:
    """Return the intraclass correlation of errors (n, 3) of one sensor at one pose."""
    size = rows.group_size
    products = rows.group_sum(errors) ** 2 - rows.group_sum(errors**2)
    pairs = np.sum(size * (size - 1))
    if pairs == 0:
        return np.nan
    return float(np.sum(products) / (3 * pairs) / np.mean(errors**2))


def _squares(errors: FloatArray, spread: FloatArray, variance: FloatArray) -> FloatArray:
    """Return the squared Mahalanobis lengths of errors (n, 3); spread of draws (d, n, 3)."""
    covariance = np.einsum('dni,dnj->nij', spread, spread) / len(spread)
    covariance += variance[:, None, None] * np.eye(3)
    return np.einsum('ni,ni->n', errors, np.linalg.solve(covariance, errors[..., None])[..., 0])


def fit_by_command(folder: Path) -> tuple[dict[str, Any], float]:
    """Return fit.json of a session and the seconds of the command."""
    with tempfile.TemporaryDirectory() as out:
        command = [sys.executable, '-m', 'remaster_ros.cli.main', 'fit', str(folder)]
        started = time.perf_counter()
        subprocess.run([*command, '--out', out, '--no-figures', '--quiet'], check=True)
        seconds = time.perf_counter() - started
        return json.loads((Path(out) / 'fit.json').read_text(encoding='utf-8')), seconds


def main() -> None:
    default = Path(__file__).resolve().parents[2] / 'shared' / 'data'
    data = Path(sys.argv[1]) if len(sys.argv) > 1 else default
    errors, shares = [], []
    for name, limit in LIMITS_MM.items():
        if not (data / name).is_dir():
            print(f'{name} is not in {data}')
            continue
        result, seconds = fit_by_command(data / name)
        metric = result['accuracy']['validation']['post_registration']
        before, after = metric['before']['mean_mm'], metric['after']['mean_mm']
        sizes = result['session']
        errors.append(
            (
                name,
                sizes['optimization']['observations'],
                sizes['validation']['observations'],
                f'{before:.3f}',
                f'{after:.3f} ({"<=" if after <= limit else "NOT <="} {limit:.2f})',
                'yes' if result['sampler']['converged'] else 'NO',
                f'{seconds:.1f}',
            )
        )
        intervals = coverage(data / name)
        shares.append((name, *(_share(part) for part in intervals[:3]), *_looks(intervals)))
    header = ('set', 'rows', 'held out', 'before, mm', 'after, mm', 'converged', 'command, s')
    print(table(header, errors))
    header = (
        'set',
        'points inside 95 %',
        'means of poses inside',
        'points less that mean inside',
        'RMS error / predicted: points, poses, rest',
        'excess kurtosis',
        'correlation within a pose',
    )
    print()
    print(table(header, shares))


def _share(inside: FloatArray) -> str:
    return f'{100 * np.mean(inside):.1f} % of {len(inside)}' if len(inside) else '–'


def _looks(intervals: Coverage) -> tuple[str, str, str]:
    ratio = ', '.join('–' if np.isnan(value) else f'{value:.2f}' for value in intervals.ratio)
    correlation = '–' if np.isnan(intervals.correlation) else f'{intervals.correlation:+.2f}'
    return ratio, f'{intervals.excess:+.1f}', correlation


if __name__ == '__main__':
    main()
