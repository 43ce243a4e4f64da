"""Does `fit` see that held-out poses do not agree with the others? False alarms and power.

Sessions of 18 poses and 12 held-out ones in up to five joint solutions each, two sensors with a
noise of 0.23 mm per point and 0.1 mm common to a pose. The first sensor is moved in one direction
before the held-out poses, by a multiple of the noise of its mean at a pose; or its held-out
readings have so many times their noise. Printed is in how many sessions each rule says so: the
rank tests at 1 % over the nine of a fit (`calibration.held_out_tests`), and the comparison with
what is known of the noise (`calibration.noise_check`), by which alone a page was green before.

    OMP_NUM_THREADS=1 python benchmarks/bench_held_out.py [--sessions 200]
"""

from __future__ import annotations

import argparse
import io
from contextlib import redirect_stdout
from dataclasses import replace
from typing import NamedTuple

import common  # noqa: F401  its folder of helpers
import numpy as np
from calibration_scenes import scene
from common import machine, progress, table

from remaster_ros.calibration.comparison import predicted_rows
from remaster_ros.calibration.estimate import Problem, estimate
from remaster_ros.calibration.held_out_tests import held_out_tests
from remaster_ros.calibration.noise_check import check_noise
from remaster_ros.calibration.residual_structure import FAMILY_WISE_ERROR

SIGMA_M, POSE_SIGMA_M, SOLUTIONS = 0.23e-3, 0.1e-3, 5
OF_MEAN_M = float(np.hypot(SIGMA_M / np.sqrt(SOLUTIONS), POSE_SIGMA_M))
# Of the other tests of a fit of two sensors there are six, of these four.
LEVEL = FAMILY_WISE_ERROR / 10.0


class Case(NamedTuple):
    """A step in units of the noise of a mean, and how many times the noise there is held out."""

    step: float
    noisier: float


CASES = (
    Case(0.0, 1.0),
    Case(1.0, 1.0),
    Case(2.0, 1.0),
    Case(3.0, 1.0),
    Case(5.0, 1.0),
    Case(0.0, 2.0),
    Case(0.0, 3.0),
)


def one_session(seed: int, case: Case) -> tuple[bool, bool, bool]:
    """Return whether the first sensor, the second one, and what is known of the noise tell."""
    with redirect_stdout(io.StringIO()):
        session, _ = scene(
            seed,
            poses=18,
            validation=12,
            sensor_count=2,
            sigma_m=SIGMA_M,
            pose_sigma_m=POSE_SIGMA_M,
        )
    m = session.measurements
    rng = np.random.default_rng(seed)
    # The noise held out has so many times the variance in all.
    more = np.sqrt(case.noisier**2 - 1.0) * SIGMA_M * rng.standard_normal((len(m), 3))
    errors = np.array([case.step * OF_MEAN_M, 0.0, 0.0]) + more
    mine = (m.is_validation & (m.sensor == 0))[:, None]
    found = estimate(
        Problem.of(replace(session, measurements=replace(m, position=m.position + mine * errors)))
    )
    measurements, names = found.problem.measurements, found.problem.sensor_names
    tests = held_out_tests(found.mode, measurements, np.zeros(0, np.int64))
    fires = {test.sensor for test in tests if test.p_value < LEVEL}
    residuals = measurements.position - predicted_rows(found.problem, found.model, found.mode.z)
    checks = check_noise(
        measurements, names, residuals, np.zeros(0, np.int64), len(found.posterior.free)
    )
    return names[0] in fires, names[1] in fires, not all(check.explained for check in checks)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--sessions', type=int, default=200)
    sessions = parser.parse_args().sessions
    print(machine())
    lines = []
    for place, case in enumerate(CASES):
        outcomes = []
        for index in range(sessions):
            progress(f'{place + 1} of {len(CASES)}: {index} of {sessions}')
            outcomes.append(one_session(10_000 * (place + 1) + index, case))
        first, second, known = np.sum(outcomes, axis=0)
        lines.append(
            (
                f'{case.step:g} ({1e3 * case.step * OF_MEAN_M:.2f} mm)',
                f'{case.noisier:g}',
                f'{first} of {sessions}',
                f'{second} of {sessions}',
                f'{known} of {sessions}',
            )
        )
    header = ('moved, in std of a mean', 'noise held out, times')
    print(table((*header, 'this sensor', 'the other', 'by what is known of the noise'), lines))


if __name__ == '__main__':
    main()
