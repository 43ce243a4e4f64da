# SPDX-License-Identifier: Apache-2.0
"""The paper's Tables I to VIII beside ours: writes benchmarks/PAPER.md.

Its two experiments are simulated from its own Tables I and II: 36 poses with 173 configurations to
fit, 32 with 156 to validate, the offsets of Table I as the truth, the registration corrections of
Table II, noise of its sigma. Twice: with noise that is independent for each point, and with most
of it common to all solutions of a pose. The product fits all four; the paper's own chain
(`--sampler paper`) runs on the two with common noise.

    OMP_NUM_THREADS=1 python benchmarks/paper_tables.py [--steps N] [--out benchmarks/PAPER.md]
"""

from __future__ import annotations

import argparse
import re
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import common  # noqa: F401  its folder of helpers
import numpy as np
from common import progress, table
from worlds.paper_convention import errors, random_configurations
from worlds.paper_experiment import experiment
from worlds.paper_published import ERRORS, SIGMA_MM, TABLE_I_DEG, TABLE_II

from remaster_ros.calibration.accuracy import solution_pairs
from remaster_ros.calibration.estimate import Problem, estimate
from remaster_ros.calibration.fit import FitResult, fit_session
from remaster_ros.calibration.sampling import sample_posterior
from remaster_ros.kinematics.transforms import inverse, rotation_vector_to_matrix, transform
from remaster_ros.simulation.truth import SessionTruth
from remaster_ros.types import FloatArray, Session

SENSORS = {'mocap': 'Motion Capture', 'tracker': 'Laser Tracker'}
NOISES = {'independent': 'independent noise', 'common': 'pose-common noise'}
# Within a pose, mm: what the relative errors of Table III leave room for.
WITHIN_MM = {'mocap': 0.23, 'tracker': 0.21}
# T* turns by Rz(alpha) Ry(beta) Rx(gamma).
CORRECTIONS = ('x (mm)', 'y (mm)', 'z (mm)', 'alpha (deg)', 'beta (deg)', 'gamma (deg)')


class Case(NamedTuple):
    """A simulated experiment and its fit.

    Attributes
    ----------
    corrections
        Draws of Table II's parameters, with joint 1 at the paper's offset, mm and deg, (n, 6).
    """

    session: Session
    truth: SessionTruth
    fit: FitResult
    corrections: FloatArray


Cases = Mapping[tuple[str, str], Case]


def simulated(sensor: str, noise: str, seed: int) -> Case:
    """Simulate and fit one experiment."""
    rng = np.random.default_rng([seed, list(SENSORS).index(sensor), list(NOISES).index(noise)])
    sigma, within = 1e-3 * SIGMA_MM[sensor][0], 1e-3 * WITHIN_MM[sensor]
    parts = (sigma, 0.0) if noise == 'independent' else (within, np.sqrt(sigma**2 - within**2))
    offsets = np.radians(TABLE_I_DEG[sensor][0])
    session, truth = experiment(rng, {sensor: parts}, joint_offsets=offsets)
    fit = fit_session(session, rng=rng)
    return Case(session, truth, fit, corrections(session, truth, sensor, rng))


def corrections(
    session: Session, truth: SessionTruth, sensor: str, rng: np.random.Generator
) -> FloatArray:
    """Return draws of Table II's parameters, the initial registration being off by its means."""
    found = estimate(Problem.of(session))
    run, _ = sample_posterior(found.mode, chains=4, draws=1000, rng=rng)
    z = found.posterior.parameters(run.draws.reshape(-1, run.draws.shape[-1]))
    # Which registration belongs to which offset of joint 1 is exact: they turn together.
    z[:, 0] = truth.joint_offsets[0]
    T_N_R = inverse(found.model.T_R_N(found.model.natural(z))[:, 0])
    correction = T_N_R @ truth.sensors[sensor].T_R_N @ _true_correction(sensor)
    turn = correction[:, :3, :3]
    angles = (
        np.arctan2(turn[:, 1, 0], turn[:, 0, 0]),
        -np.arcsin(turn[:, 2, 0]),
        np.arctan2(turn[:, 2, 1], turn[:, 2, 2]),
    )
    return np.column_stack((1e3 * correction[:, :3, 3], np.degrees(np.stack(angles, axis=1))))


def _true_correction(sensor: str) -> FloatArray:
    values = TABLE_II[sensor][0]
    turns = [
        rotation_vector_to_matrix(np.radians(angle) * np.eye(3)[axis])
        for angle, axis in zip(values[3:], (2, 1, 0))
    ]
    return transform(turns[0] @ turns[1] @ turns[2], 1e-3 * np.array(values[:3]))


def table_i(cases: Cases, chains: Mapping[str, FitResult]) -> Iterator[str]:
    header = (
        'joint',
        'sensor',
        'paper',
        *NOISES.values(),
        "the paper's chain: mean of each of four",
    )
    rows = []
    for joint in range(7):
        for sensor, title in SENSORS.items():
            mean, std = (column[joint] for column in TABLE_I_DEG[sensor])
            cells = [_offset(cases[sensor, noise].fit, joint) for noise in NOISES]
            chain = chains.get(sensor)
            rows.append(
                (joint + 1, title, f'{mean:.3f} ± {std:.3f}', *cells, _chain(chain, joint))
            )
    yield '## Table I: zero-offsets, degrees'
    yield table(header, rows)
    yield note('I')


def _offset(fit: FitResult, joint: int) -> str:
    mean, std = np.degrees(fit.joint_offsets[joint]), np.degrees(fit.joint_offsets_std[joint])
    if joint == 0:
        return 'cannot be told: turns with the registration'
    return f'{mean:.3f} ± {std:.3f}' + ('' if fit.identifiable[joint] else ' (by the prior)')


def _chain(fit: FitResult | None, joint: int) -> str:
    if fit is None:
        return '–'
    draws = np.degrees(fit.joint_offset_draws[:, :, joint])
    means = ' '.join(f'{value:.3f}' for value in draws.mean(axis=1))
    return f'{means} (each ± {np.mean(draws.std(axis=1)):.3f}; R-hat {_r_hat(fit, joint):.1f})'


def _r_hat(fit: FitResult, joint: int) -> float:
    return float(fit.diagnostics.r_hat[fit.parameter_names.index(fit.joint_names[joint])])


def table_ii(cases: Cases, chains: Mapping[str, FitResult]) -> Iterator[str]:
    rows = []
    for index, name in enumerate(CORRECTIONS):
        for sensor, title in SENSORS.items():
            mean, std = (column[index] for column in TABLE_II[sensor])
            draws = [cases[sensor, noise].corrections[:, index] for noise in NOISES]
            rows.append(
                (
                    name,
                    title,
                    f'{mean:.3f} ± {std:.3f}',
                    *(f'{d.mean():.3f} ± {d.std():.3f}' for d in draws),
                )
            )
    for sensor, title in SENSORS.items():
        mean, std = SIGMA_MM[sensor]
        cells = []
        for noise in NOISES:
            found = cases[sensor, noise].fit.noise[sensor]
            text = f'{1e3 * found.sigma_m:.3f} ± {1e3 * found.std_m:.3f} per point'
            if found.pose_sigma_m is not None and found.pose_std_m is not None:
                text += f', {1e3 * found.pose_sigma_m:.3f} ± {1e3 * found.pose_std_m:.3f} common'
            cells.append(text)
        rows.append(('sigma (mm)', title, f'{mean:.3f} ± {std:.3f}', *cells))
    yield '## Table II: corrections of the registration, and the noise'
    yield table(('parameter', 'sensor', 'paper', *NOISES.values()), rows)
    worst = '; '.join(
        f'{SENSORS[sensor]} {np.nanmax(fit.diagnostics.r_hat):.1f}'
        for sensor, fit in chains.items()
    )
    yield note('II', worst=worst or 'not run')


def errors_table(
    number: str, title: str, columns: Mapping[str, Any], names: tuple[str, str]
) -> Iterator[str]:
    """Yield a table of errors; columns: title -> function of sensor and side to a summary."""
    rows = []
    for label, side in zip(names, (0, 1)):
        for sensor, sensor_title in SENSORS.items():
            rows.append(
                (
                    label,
                    sensor_title,
                    _errors(*ERRORS[number][sensor][side]),
                    *(_summary(column(sensor, side)) for column in columns.values()),
                )
            )
    yield f'## Table {number}: {title}, mm'
    yield table(('', 'sensor', 'paper', *columns), rows)


def _errors(mean: float, low: float, high: float) -> str:
    return f'{mean:.3f} [{low:.3f}, {high:.3f}]'


def _summary(values: Mapping[str, Any] | None) -> str:
    return '–' if values is None else _errors(values['mean_mm'], *values['interval95_mm'])


def measured(cases: Cases, noise: str, split: str, metric: str) -> Any:
    """Return a column of before and after."""
    return lambda sensor, side: cases[sensor, noise].fit.accuracy[split][metric][
        ('before', 'after')[side]
    ]


def theoretical(fits: Mapping[str, FitResult], metric: str, suffix: str = '') -> Any:
    """Return a column of section V-C from the fits of the sensors."""
    return lambda sensor, side: (
        fits[sensor].accuracy['optimization'][metric][('before', 'after')[side] + suffix]
        if sensor in fits
        else None
    )


def convention(cases: Cases, suffix: str, place: str) -> Any:
    """Return a column of section V-C from Tables I and II alone, all joints counted."""
    rng = np.random.default_rng(len(suffix))
    everywhere = random_configurations(rng)

    def column(sensor: str, side: int) -> Any:
        measurements = cases[sensor, 'independent'].session.measurements
        q = everywhere if place else measurements.q[~measurements.is_validation]
        return errors(sensor, q, rng, noise=not suffix)[side]

    return column


def document(cases: Cases, chains: Mapping[str, FitResult], steps: int) -> Iterator[str]:
    """Yield the page's paragraphs."""
    both = ('Vernier', 'Bayesian')
    yield '# The paper, table by table'
    yield (
        'K. Van Wyk, J. Falco, G. Cheok: "Efficiently Improving and Quantifying Robot Accuracy In '
        'Situ". Written by `OMP_NUM_THREADS=1 python benchmarks/paper_tables.py`; do not edit.'
    )
    yield note('how', steps=steps, mocap=WITHIN_MM['mocap'], tracker=WITHIN_MM['tracker'])
    yield from table_i(cases, chains)
    yield from table_ii(cases, chains)
    for number, title, metric in (
        ('III', 'relative error (eq. 17)', 'relative'),
        ('IV', 'absolute error after registration (eq. 18)', 'post_registration'),
    ):
        columns = {
            name: measured(cases, noise, 'optimization', metric) for noise, name in NOISES.items()
        }
        yield from errors_table(number, title, columns, both)
        yield note(number, pairs=_pairs(cases))
    fits = {noise: {sensor: cases[sensor, noise].fit for sensor in SENSORS} for noise in NOISES}
    for number, title, suffix, place in (
        ('V', 'theoretical error at visited configurations', '', ''),
        ('VI', 'theoretical error at 1,000 random configurations', '', '_random'),
        ('VII', 'the same without noise', '_offsets_only', '_random'),
    ):
        columns = {}
        for version, label in (('paper_theoretical', 'base frame'), ('theoretical', 'invariant')):
            for noise, name in NOISES.items():
                columns[f'{label}, {name}'] = theoretical(fits[noise], version + place, suffix)
        if chains:
            columns["the paper's chain, base frame"] = theoretical(
                chains, 'paper_theoretical' + place, suffix
            )
        columns["the paper's convention"] = convention(cases, suffix, place)
        yield from errors_table(number, title, columns, both)
        yield note(number)
    columns = {
        name: lambda sensor, side, noise=noise: cases[sensor, noise].fit.accuracy['validation'][
            ('relative', 'post_registration')[side]
        ]['after']
        for noise, name in NOISES.items()
    }
    names = ('relative', 'absolute after registration')
    yield from errors_table('VIII', 'validation, after', columns, names)
    yield note('VIII')


NOTES = {
    'how': """
        The paper's two experiments are simulated from its own Tables I and II: a LWR 4+ with the
        offsets of Table I, 36 poses with 173 configurations to fit and 32 with 156 to validate,
        poses planned as in its section III, markers 0.5 mm (std per axis) off their nominal
        places. The noise has the sigma of Table II: once independent for each point, as eq. 10
        says; once with all but {mocap:g} mm (tracker {tracker:g} mm) of it common to all solutions
        of a pose. `remaster fit` fits all four. The paper's own chain (`remaster fit --sampler
        paper`, {steps} steps, four starts) runs on those with common noise. Errors are means and
        95 % intervals; "Vernier" is before, "Bayesian" after. The real robot had more errors than
        offsets and noise; these simulations have not.""",
    'I': """
        *Joint 1.* A turn of joint 1 is a turn of the sensor about the base axis. Nothing in the
        data tells them apart, so there is no offset to report, and no std. The paper's ± 0.012 and
        ± 0.009 are those of a chain that has not moved: from other starting registrations the same
        chain on the same data ends elsewhere (last column), far outside its own std; and the
        paper's two sensors disagree by five of its stds.
        *Joint 7.* It trades with the place of the marker, 1.7 mm a degree at 100 mm. ± 0.039 and
        ± 0.026 need markers known to 0.05 mm on the tool. The paper's two sensors disagree by 0.33
        degrees, which is 0.6 mm of marker. Ours has the marker's prior (0.5 mm per axis) in it, is
        as wide as that and says so; the simulated markers are off by a draw of that prior, which
        the paper's chain takes for an offset of joint 7.
        *Joints 2 to 6.* With independent noise ours has the paper's std within a third for joints
        2 to 4; for 5 and 6 it is wider (the poses are not published). With common noise the truth
        is known two to four times better, because the solutions of one pose share what disturbs
        them. So, if the paper's own Tables III and IV are right, its stds are not: they are those
        of a likelihood that its data contradict.""",
    'II': """
        Ours are for joint 1 at the offset of Table I; without that nothing bounds them. The
        initial registrations are simulated as wrong by exactly the means of Table II. The
        translations are those of the origin of the distant sensor: a hundredth of a degree about
        the robot moves it by a third of a millimetre. The paper's stds (0.04 to 0.11 mm) are three
        to eight times too small for independent noise and more for common noise: they are the
        spread of a chain that moves 0.007 mm a step and has not wandered through its posterior.
        Largest R-hat of the paper's chain over four starts: {worst}.""",
    'III': """
        {pairs} pairs here, 440 in the paper. Independent noise of 0.89 mm alone makes 1.1 mm of
        relative error, four times what the paper found. So its noise was not independent, and its
        likelihood (eq. 12) was not that of its data. With common noise ours agrees.""",
    'IV': """
        After: mean and interval of the paper's motion capture imply an RMS near 1.64 mm, that is
        a sigma of 0.95 mm and not the 0.89 ± 0.03 of its Table II; those of the tracker agree with
        it (0.74). Before: ours has the registration and the marker fitted anew with offsets at
        zero; they take up the offsets of joints 1 and 7 and part of the others. The paper's is
        as large as if the offsets of joints 1 and 7 counted, which no sensor can tell from its own
        place and its marker's.""",
    'V': """
        In the base frame ours has the offset of joint 1 at zero, since nothing tells it. What is
        missing "before" against the paper is that gauge: half a degree at half a metre. The last
        column counts joints 1 and 7 as the paper does: their offsets and stds are those of its
        Table I, the noise that of Table II, the markers 50 mm further out than our plate, for its
        quick-change connector, whose length it does not give: of 0, 50 and 100 mm the one that
        agrees (without it the means before are 4 % smaller, and differ by up to 9 %). So
        computed, the means of Tables V to VII are the paper's within 6 %, the ends of their
        intervals within 15 %; the other columns differ in what they count.""",
    'VI': """
        Uniform within the joint limits, collisions ignored. The invariant error grows away from
        where the registration was fitted, that in the base frame with the reach. The paper's
        "more than 5 mm over the full workspace" is in good part its joint 1.""",
    'VII': """
        The share of the offsets "after" depends on what is held. In the base frame joint 7 has its
        marker's prior in it; invariantly, offsets, registration and marker are drawn together, as
        they were measured together. The paper's 0.22 and 0.18 mm come from stds of a chain that
        had not mixed, and contain a joint 1 that is no error of the arm. The conclusion that
        offsets are 15 % of what is left therefore has no footing.""",
    'VIII': """
        The paper's relative error doubles from fitting (0.29) to validation (0.56). Thirteen
        parameters fitted to 519 numbers cannot do that, and with us it stays. What was applied to
        the robot was then not what was fitted, or the validation poses have errors of another
        kind. (One sensor's offsets were applied, and its arm was remastered in between.)""",
}


def note(number: str, **values: object) -> str:
    """Return a note as paragraphs, one a line."""
    text = ' '.join(NOTES[number].format(**values).split())
    return re.sub(r' (\*Joint[^*]*\*)', r'\n\n\1', text)


def _pairs(cases: Cases) -> int:
    case = cases['mocap', 'independent']
    rows = case.session.measurements.select(~case.session.measurements.is_validation)
    return len(solution_pairs(rows, np.random.default_rng(0)))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument(
        '--steps',
        type=int,
        default=200_000,
        help="of the paper's chain (default: its 2e5); 0: none",
    )
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--out', type=Path, help='write there instead of printing')
    args = parser.parse_args()
    started = time.perf_counter()
    cases, chains = {}, {}
    for sensor in SENSORS:
        for noise in NOISES:
            progress(f'fitting {sensor}, {noise}')
            cases[sensor, noise] = simulated(sensor, noise, args.seed)
        if args.steps:
            progress(f"the paper's chain, {sensor}")
            chains[sensor] = fit_session(
                cases[sensor, 'common'].session,
                rng=np.random.default_rng(args.seed),
                sampler='paper',
                draws=args.steps,
            )
    progress('')
    text = '\n\n'.join(document(cases, chains, args.steps)) + '\n'
    if args.out is None:
        print(text)
    else:
        args.out.write_text(text, encoding='utf-8')
    print(f'{time.perf_counter() - started:.0f} s')


if __name__ == '__main__':
    main()
