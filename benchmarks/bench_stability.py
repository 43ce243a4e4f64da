"""Do causes and their sizes stay when a tenth of the poses is left out? On real sessions.

Each session is searched as it is, and ten times without a random tenth of its poses to fit. Main
causes are those with at least 5 % of the gain on held-out poses. Printed are how often they are
found again, by name and joint by joint, and how many of their sizes lie within two of the stated
standard deviations of those of the whole session; one that is not found again counts as 0. Free
curves are compared at 25 angles, from which their mean is taken. Runs that are in the results file
already are not repeated; one that takes more CPU than the limit counts as not ended.

    python benchmarks/bench_stability.py [FOLDER …] [--limit 600] [--report]
"""

from __future__ import annotations

import argparse
import json
import resource
from pathlib import Path
from typing import Any

import numpy as np
from common import ROOT, each_in_its_process, table

from remaster_ros.discovery.discover import Discovery, discover_session
from remaster_ros.session.reader import read_session
from remaster_ros.types import FloatArray, Session

SETS = ('ur10_two_solutions', 'ur10_iso_cubes')
RUNS = 10
LEFT_OUT = 0.1
MAIN_SHARE = 0.05
ANGLES = 25
WITHIN_STD = 2.0


def without_a_tenth(session: Session, run: int) -> Session:
    """Leave out a random tenth of the poses to fit; none in run 0."""
    rows = session.measurements
    poses = np.unique(rows.pose[~rows.is_validation])
    rng = np.random.default_rng([run, len(poses)])
    dropped = rng.choice(poses, round(LEFT_OUT * len(poses)) if run else 0, replace=False)
    return session.select(rows.is_validation | ~np.isin(rows.pose, dropped))


def one(folder: Path, run: int) -> dict[str, Any]:
    """Search one session; return a line of the results file."""
    session = without_a_tenth(read_session(folder), run)
    found = discover_session(session, rng=np.random.default_rng(run))
    causes: dict[str, tuple[list[int], float]] = {}
    for effect in found.effects:
        joints, share = causes.get(effect.name, ([], 0.0))
        joints = sorted({*joints, *effect.joints})
        causes[effect.name] = (joints, share + (effect.share or 0.0))
    gain = found.gain
    return {
        'name': f'{folder.name}-{run}',
        'verdict': found.verdict,
        'causes': causes,
        'sizes': {
            name: [causes[cause][1], value, std] for cause, name, value, std in _sizes(found)
        },
        'held_out_mm': [
            None if error is None else 1e3 * error
            for error in (gain.held_out_rms_before_m, gain.held_out_rms_after_m)
        ],
    }


def _sizes(found: Discovery) -> list[tuple[str, str, float, float]]:
    """Return cause, name, value and std of every parameter, curves at some angles instead."""
    fit, sizes, solution = found.fit, [], found.solution
    wheres = dict(zip(solution.cells, solution.slices(), strict=True))
    # An effect without cells is that of a marker, which has no parameters of its own.
    causes = [
        (effect.name, cell)
        for effect, group in zip(found.effects, found.groups, strict=False)
        for cell in group
    ]
    for cause, cell in causes:
        where = wheres[cell]
        if cell.penalty is None:
            values, stds = fit.theta[where], fit.theta_std[where]
            names: list[str] = list(cell.parameters)
        else:
            rows, names = _rows(found, cell.joints), []
            columns = cell.columns(found.residuals.context).values[rows]
            columns = columns - columns.mean(axis=0)
            if columns.ndim > 2:
                continue
            draws = fit.theta_draws[..., where].reshape(-1, cell.size) @ columns.T
            values, stds = columns @ fit.theta[where], draws.std(axis=0)
            names = [f'{cell.name}_{cell.joints}_{cell.label}_{i}' for i in range(ANGLES)]
        sizes += [
            (cause, name, float(value), float(std))
            for name, value, std in zip(names, values, stds, strict=True)
        ]
    return sizes


def _rows(found: Discovery, joints: tuple[int, ...]) -> FloatArray:
    """Return held-out rows, which all runs have, at quantiles of the last joint's angle."""
    rows = found.residuals.context.measurements
    held_out = np.flatnonzero(rows.is_validation)
    order = held_out[np.argsort(rows.q[held_out, joints[-1] - 1] if joints else held_out)]
    return order[np.linspace(0, len(order) - 1, ANGLES).astype(int)]


def report(folder: str, lines: dict[str, dict[str, Any]]) -> tuple[object, ...]:
    """Compare the runs of a session with run 0; return a row of the table."""
    whole = lines.get(f'{folder}-0')
    others = [line for run in range(1, RUNS + 1) if (line := lines.get(f'{folder}-{run}'))]
    ended = [line for line in others if 'error' not in line]
    if whole is None or 'error' in whole:
        why = 'not run' if whole is None else whole['error']
        return folder, why, f'{len(ended)} of {len(others)}', '', '', '', ''
    wanted = _main_causes(whole)
    names = joints_too = within = compared = 0
    for line in ended:
        found = _main_causes(line)
        names += set(found) == set(wanted)
        joints_too += found == wanted
        for name, (share, value, std) in whole['sizes'].items():
            if share >= MAIN_SHARE:
                again = line['sizes'].get(name, (0.0, 0.0, 0.0))[1]
                within += abs(again - value) <= WITHIN_STD * std
                compared += 1
    return (
        folder,
        ', '.join(f'{name} {joints}' for name, joints in wanted.items()) or whole['verdict'],
        f'{len(ended)} of {len(others)}',
        names,
        joints_too,
        f'{100.0 * within / compared:.0f} %' if compared else '',
        ' → '.join('' if error is None else f'{error:.3f}' for error in whole['held_out_mm']),
    )


def _main_causes(line: dict[str, Any]) -> dict[str, list[int]]:
    return {
        name: joints for name, (joints, share) in line['causes'].items() if share >= MAIN_SHARE
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    data = ROOT.parent / 'shared' / 'data'
    parser.add_argument('folders', nargs='*', type=Path, default=[data / name for name in SETS])
    parser.add_argument('--results', type=Path, default=Path('bench_stability.jsonl'))
    parser.add_argument('--limit', type=int, default=600, help='seconds of CPU for each search')
    parser.add_argument('--report', action='store_true', help='print what is known, run nothing')
    parser.add_argument('--run', type=int, help='only this one, as a line of the results file')
    args = parser.parse_args()
    if args.run is not None:
        # The system ends what takes longer, whatever it is in the middle of.
        resource.setrlimit(resource.RLIMIT_CPU, (args.limit, args.limit))
        print(json.dumps(one(args.folders[0], args.run)))
        return
    commands = {
        f'{folder.name}-{run}': (__file__, str(folder), '--run', str(run))
        for folder in (() if args.report else args.folders)
        for run in range(RUNS + 1)
    }
    lines = each_in_its_process(args.results, commands, args.limit)
    header = (
        'session',
        'main causes',
        'ended',
        'same names',
        'and joints',
        'sizes within 2 std',
        'held out, mm',
    )
    print(table(header, [report(folder.name, lines) for folder in args.folders]))


if __name__ == '__main__':
    main()
