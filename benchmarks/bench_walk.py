# SPDX-License-Identifier: Apache-2.0
"""Causes by a walk over models (`walk`), beside the search of `discover`, on the same sessions.

The walk replaces the search when it is no worse in any group of hidden sessions; until then it is
measured here. For each session: what was hidden, the causes of both with a probability of one half
and more, mean and RMS error on held-out poses with the model of each sampled, and CPU.

    OMP_NUM_THREADS=1 python benchmarks/bench_walk.py ../shared/data/panda_left
    OMP_NUM_THREADS=1 python benchmarks/bench_walk.py --hidden pair --count 12 [--walk-alone]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from pathlib import Path

import bench_discovery
import numpy as np
from common import table
from walk.models import Walk
from worlds.hidden_sessions import hidden_session

from remaster_ros.calibration.fit import fit_session
from remaster_ros.calibration.mistakes import sound_estimate
from remaster_ros.discovery.discover import PRECISION, _to_search, discover_session
from remaster_ros.discovery.effects import splines
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.to_extension import extension_of
from remaster_ros.session.reader import read_session
from remaster_ros.types import FloatArray, Session

# Ridge over the second differences of a curve while the walk's candidates are made: white up to
# some 15 waves a turn. With the 1e-3 of the search a UR10 has 134 less of log evidence, and a
# curve of a few waves is taken for gear waves.
CURVE_RIDGE = 1.0


def held_out(session: Session, errors: FloatArray) -> str:
    """Return mean and RMS of the 3-D errors on held-out poses, mm."""
    rows = session.measurements.is_validation
    if not rows.any():
        return '–'
    lengths = 1e3 * np.linalg.norm(errors[rows], axis=1)
    return f'{lengths.mean():.4f} {np.sqrt(np.mean(lengths**2)):.4f}'


def by_walk(session: Session) -> tuple[list[str], str, float]:
    """Return causes with their probabilities, held-out errors and CPU seconds of the walk."""
    begin, rng = time.process_time(), np.random.default_rng(0)
    session = session.positions_alone()
    found, data, _ = _to_search(session, sound_estimate(session), rng)
    ridge, splines.RIDGE = splines.RIDGE, CURVE_RIDGE
    try:
        cells = [
            cell
            for effect in EFFECTS.values()
            if not effect.moves_the_fit and not effect.needs(data.context)
            for cell in effect.cells(data.context)
        ]
        walk = Walk(data, cells, rng, found.problem.priors.geometry_tolerance_m)
        extension = extension_of(data, walk.solution(walk.models[0]), found)
    finally:
        splines.RIDGE = ridge
    fit = fit_session(session, rng=rng, precision=PRECISION, extension=extension)
    causes = {
        f'{cell.name} {",".join(map(str, cell.joints))} {walk.probability_of(cell):.2f}'
        for cell in walk.claimed
    }
    seconds = time.process_time() - begin
    return sorted(causes), held_out(session, fit.residuals_after), seconds


def by_search(session: Session) -> tuple[list[str], str, float]:
    """Return causes, held-out errors and CPU seconds of `discover`."""
    begin = time.process_time()
    found = discover_session(session, rng=np.random.default_rng(0))
    causes = sorted(f'{one.name} {",".join(map(str, one.joints))}' for one in found.effects)
    errors = held_out(session, found.fit.residuals_after)
    return causes, errors, time.process_time() - begin


def sessions(arguments: argparse.Namespace) -> Iterator[tuple[str, Session, str]]:
    """Give each session with its name and what is hidden in it."""
    for path in arguments.sessions:
        yield path.name, read_session(path), ''
    for group in arguments.hidden:
        for name, recipe in bench_discovery.recipes(group, arguments.count):
            hidden = hidden_session(recipe)
            yield name, hidden.session, ', '.join(str(effect) for effect in hidden.truth.effects)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or '').split('\n')[0])
    parser.add_argument('sessions', nargs='*', type=Path)
    parser.add_argument('--hidden', nargs='*', default=[], choices=tuple(bench_discovery.GROUPS))
    parser.add_argument('--count', type=int, default=4)
    parser.add_argument('--walk-alone', action='store_true', help='do not run discover')
    arguments = parser.parse_args()
    for name, session, hidden in sessions(arguments):
        print(f'== {name} {hidden}'.rstrip())
        rows = [['walk', *_row(by_walk(session))]]
        if not arguments.walk_alone:
            rows.append(['discover', *_row(by_search(session))])
        print(table(['', 'held out, mm (mean, RMS)', 'CPU, s', 'causes'], rows), flush=True)


def _row(found: tuple[list[str], str, float]) -> list[str]:
    causes, errors, seconds = found
    return [errors, f'{seconds:.1f}', '; '.join(causes) or 'none']


if __name__ == '__main__':
    main()
