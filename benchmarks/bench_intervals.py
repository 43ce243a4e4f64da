"""Do the intervals of a fit hold where other things than the offsets are wrong? Coverage.

Sessions of 36 poses with one or two sensors in turn, a noise of 0.1 mm per point and 0.1 mm common
to a pose, and two hidden effects of any named kinds (but a moved marker, of which noise and prior
hold most), their sizes drawn log-uniformly between the multiples of the noise in the table; and
sessions with nothing hidden. Printed are how often structure is found in the residuals, and how
many of the central 95 % intervals of the inner joints' offsets hold the truth: those of the model,
those of a sandwich by pose (CR3, the jackknife over poses), those with the discrepancy, and as
`remaster fit` gives them: with the discrepancy where structure was found.

    OMP_NUM_THREADS=1 python benchmarks/bench_intervals.py [--sessions 300]
"""

from __future__ import annotations

import argparse
import io
from contextlib import redirect_stdout
from typing import NamedTuple

import common  # noqa: F401  its folder of helpers
import numpy as np
from calibration_scenes import scene
from common import machine, progress, table
from scipy.stats import t as t_distribution

from remaster_ros.calibration.estimate import Estimate, Problem, estimate
from remaster_ros.calibration.residual_structure import residual_structure
from remaster_ros.calibration.robust_intervals import robust_std
from remaster_ros.calibration.smooth_functions import whitened
from remaster_ros.errors import InsufficientDataError
from remaster_ros.simulation.effect_sampling import EffectSpec
from remaster_ros.simulation.hidden_effects import NAMED
from remaster_ros.types import FloatArray

NOISE_M = 1e-4
# Multiples of the noise; nothing is hidden at None.
SIZES = (None, (0.5, 2.0), (2.0, 10.0))
LEFT_OUT = ('marker_offset', 'thermal_growth')


class Outcome(NamedTuple):
    """Of one session: whether structure was found, errors and standard deviations, rad, (4, j)."""

    found: bool
    offsets: FloatArray


def sandwich_std(found: Estimate) -> FloatArray:
    """Return the standard deviations of the free parameters by leaving out each pose in turn."""
    mode, rows = found.mode, found.posterior.rows
    white = whitened(mode, rows, {})
    _, pose = np.unique(found.problem.measurements.pose[rows.source], return_inverse=True)
    steps = []
    for index in range(pose.max() + 1):
        own = white['model'][pose == index].reshape(-1, len(found.posterior.free))
        errors = white['errors'][pose == index].ravel()
        gain = mode.covariance @ own.T
        steps.append(gain @ np.linalg.solve(np.eye(len(errors)) - own @ gain, errors))
    apart = np.array(steps)
    count = len(apart)
    normal = t_distribution.ppf(0.975, count - 1) / 1.96
    std: FloatArray = normal * np.sqrt((count - 1) / count * np.sum(apart**2, axis=0))
    return std


def one_session(seed: int, sizes: tuple[float, float] | None) -> Outcome | None:
    """Simulate and judge; None where the fit refuses the session."""
    rng = np.random.default_rng(seed)
    kinds = [kind for kind in NAMED if kind not in LEFT_OUT]
    hidden = []
    if sizes is not None:
        low, high = np.log(sizes)
        hidden = [
            EffectSpec(
                str(rng.choice(kinds)), None, NOISE_M * float(np.exp(rng.uniform(low, high)))
            )
            for _ in range(2)
        ]
    with redirect_stdout(io.StringIO()):
        session, truth = scene(
            seed,
            poses=36,
            sensor_count=1 + seed % 2,
            sigma_m=NOISE_M,
            pose_sigma_m=NOISE_M,
            effects=hidden,
        )
    try:
        found = estimate(Problem.of(session))
    except InsufficientDataError:
        return None
    measurements, free = found.problem.measurements, found.posterior.free
    inner = free[free < found.model.joints - 1]
    count = len(inner)
    return Outcome(
        bool(residual_structure(found.mode, measurements).found),
        np.array(
            [
                np.abs(found.mode.z[inner] - truth.joint_offsets[inner]),
                np.sqrt(np.diag(found.mode.covariance))[:count],
                sandwich_std(found)[:count],
                robust_std(found.mode, measurements)[inner],
            ]
        ),
    )


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--sessions', type=int, default=300)
    sessions = parser.parse_args().sessions
    print(machine())
    lines = []
    for place, sizes in enumerate(SIZES):
        outcomes = []
        for index in range(sessions):
            progress(f'{sizes}: {index} of {sessions}')
            outcomes.append(one_session(10_000 * (place + 1) + index, sizes))
        kept = [outcome for outcome in outcomes if outcome is not None]
        errors, model, sandwich, robust = np.concatenate([o.offsets for o in kept], axis=1)
        found = np.concatenate([np.full(o.offsets.shape[1], o.found) for o in kept])
        shown = np.where(found, robust, model)
        covered = (np.mean(errors < 1.96 * std) for std in (model, sandwich, robust, shown))
        lines.append(
            (
                'nothing' if sizes is None else f'{sizes[0]:g} to {sizes[1]:g} times the noise',
                len(kept),
                f'{100 * np.mean([o.found for o in kept]):.1f} %',
                *(f'{100 * share:.1f} %' for share in covered),
                f'{np.median(shown / model):.2f}',
            )
        )
    header = ('hidden', 'sessions', 'structure found', 'model', 'sandwich', 'discrepancy')
    print(table((*header, 'as given', 'median width'), lines))


if __name__ == '__main__':
    main()
