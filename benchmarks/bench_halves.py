# SPDX-License-Identifier: Apache-2.0
"""Do two halves of one session tell the same causes, and offsets that differ as they may?

Each set beside this repository is split at random into halves that share no pose; both go through
`remaster discover`. Two figures of each set:

- of the causes that one half has with a probability of 0.95 or more, joint by joint, the share
  that have 0.5 or more in the other half, by whatever name they stand in its models;
- RMS of the differences of the zero-offsets over the standard deviations of these differences, 1
  where those are right.

Halves are of one arm: what only the prior decides cancels. With y = A φ + e in a half, φ all
parameters of both halves' models (of the arm, and the same in both), V their variance before the
data, and K the estimator of a half by its own model, the offsets differ by (K₁A₁ − K₂A₂) φ +
K₁e₁ − K₂e₂, so that::

    Var(δ₁ − δ₂) = (K₁A₁ − K₂A₂) V (K₁A₁ − K₂A₂)' + K₁WK₁' + K₂WK₂' + M₁M₁' + M₂M₂'

with M the moves from each half's best model to its others. V has the lengths and tilts of a
drawing's tolerance, too. Beside it stands the same with the standard deviations that fit.json
states, which contain what only the prior decides. Each split is a line of the results file, so
that the benchmark can be stopped and goes on where it was.

    python benchmarks/bench_halves.py                       ten splits of four sets, on all cores
    python benchmarks/bench_halves.py --only panda_left --splits 1
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
from common import ROOT, known, resumed, table

from remaster_ros.calibration.identifiability import OPEN_ANGLE
from remaster_ros.calibration.priors import DRAWING_TAILS, prior_rows
from remaster_ros.discovery import discover
from remaster_ros.discovery.effects.base import Candidate
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.random_effects import kinds
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.discovery.unmodelled import Unmodelled
from remaster_ros.discovery.walk import Walk, at_any_time
from remaster_ros.session.records.reader import read_session
from remaster_ros.types import FloatArray, Session

SETS = ('panda_left', 'meca500_repeats', 'ur10_two_solutions', 'ur10_iso_cubes')
SURE, LIKELY = 0.95, 0.5


class Split(NamedTuple):
    """One of the splits of a set."""

    folder: str
    seed: int


class Half(NamedTuple):
    """What was found in a half."""

    found: discover.Discovery
    unmodelled: Unmodelled  # Normal equations of its best model
    moves: FloatArray  # Of all parameters to its other models, (size, models)
    probability: dict[str, float]  # Of each cause that some model has


def half_of(session: Session, seed: int) -> Half:
    """Discover a half of a session."""
    equations: list[Unmodelled] = []
    moves: list[FloatArray] = []
    probability: dict[str, float] = {}
    describe = discover.describe

    class Kept(Unmodelled):
        """Normal equations that are kept."""

        def by_models(self, *args: Any) -> FloatArray:
            equations.append(self)
            moves.append(super().by_models(*args))
            return moves[-1]

    def noted(walk: Walk, *args: Any) -> Any:
        for key, chance in walk.probability.items():
            probability[_text(key)] = float(chance)
        return describe(walk, *args)

    with patch.object(discover, 'Unmodelled', Kept), patch.object(discover, 'describe', noted):
        found = discover.discover_session(session, rng=np.random.default_rng(seed))
    # The last one is that of the model that is returned.
    return Half(found, equations[-1], moves[-1], probability)


def _text(key: tuple[Any, ...]) -> str:
    name, joints, *_, subject, change = key
    return ' '.join(part for part in (name, ','.join(map(str, joints)), subject, change) if part)


def sure_of(half: Half) -> list[str]:
    """Return the causes that a half states with a probability of `SURE`, joint by joint."""
    stated = [
        _text(at_any_time(candidate))
        for effect, group in zip(half.found.effects, half.found.groups, strict=False)
        if (effect.probability or 0.0) >= SURE
        for candidate in group
    ]
    return [*dict.fromkeys(key for key in stated if half.probability.get(key, 0.0) >= SURE)]


def difference_std(halves: list[Half]) -> FloatArray:
    """Return the standard deviation of the difference of the zero-offsets of two halves, (k,)."""
    joints = len(halves[0].found.fit.joint_offsets)
    shared, variance = _shared(halves)
    total = np.zeros(joints)
    responses = []
    for half in halves:
        unmodelled = half.unmodelled
        rows = np.full(joints, -1)
        mine = unmodelled.where < joints
        rows[unmodelled.where[mine]] = np.flatnonzero(mine)
        estimator = (unmodelled.root[rows] @ unmodelled.root.T) @ unmodelled.white.T
        columns = unmodelled.data.columns(shared)
        white = unmodelled.data.noise_model.whitened(columns, unmodelled.solution.noise)
        free = unmodelled.found.posterior.free
        base = unmodelled.white[:, : len(free)]
        responses.append(
            np.concatenate((estimator @ base, estimator @ white.reshape(len(base), -1)), axis=1)
        )
        total += np.sum(estimator**2, axis=1) + np.sum(half.moves[:joints] ** 2, axis=1)
    differs = responses[0] - responses[1]
    return np.sqrt(total + np.einsum('ij,jk,ik->i', differs, variance, differs))


def _shared(halves: list[Half]) -> tuple[list[Candidate], FloatArray]:
    """Return the causes that either half's model has, and the variance of all parameters.

    Those of the offsets model first: what has a flat prior is in both halves as it is, and has no
    variance here.
    """
    unmodelled = halves[0].unmodelled
    x = unmodelled.found.model.natural(unmodelled.found.mode.z)
    free = unmodelled.found.posterior.free
    rows = prior_rows(unmodelled.found.model, unmodelled.found.posterior.priors, x, natural=True)[
        1
    ][:, free]
    blocks = [np.linalg.pinv(rows.T @ rows, rcond=1e-10)]
    shared: list[Candidate] = []
    names: set[str] = set()
    for half in halves:
        for candidate, variance in _variances(half.unmodelled.solution):
            if names.isdisjoint(candidate.parameters):
                shared.append(candidate)
                blocks.append(variance)
                names |= {*candidate.parameters}
    for candidate, variance in _of_drawing(
        unmodelled.data, unmodelled.found.problem.priors.geometry_tolerance_m
    ):
        if names.isdisjoint(candidate.parameters):
            shared.append(candidate)
            blocks.append(variance)
    edges = np.cumsum([0, *(len(block) for block in blocks)])
    together = np.zeros((edges[-1], edges[-1]))
    for block, start, stop in zip(blocks, edges[:-1], edges[1:], strict=True):
        together[start:stop, start:stop] = block
    return shared, together


def _variances(solution: Solution) -> list[tuple[Candidate, FloatArray]]:
    precision = solution.prior_precision()
    return [
        (candidate, np.linalg.pinv(precision[where, where], rcond=1e-10, hermitian=True))
        for candidate, where in zip(solution.candidates, solution.slices(), strict=True)
    ]


def _of_drawing(data: Residuals, tolerance_m: float) -> list[tuple[Candidate, FloatArray]]:
    candidates = [
        candidate
        for effect in EFFECTS.values()
        if effect.place in ('link_translation', 'link_rotation')
        if not effect.needs(data.context)
        for candidate in effect.candidates(data.context)
        if candidate.model_change is not None
    ]
    return [
        (member, (DRAWING_TAILS * tolerance_m) ** 2 * mapping @ mapping.T)
        for family in kinds(data, candidates)
        for member, mapping in zip(family.members, family.maps, strict=True)
    ]


def run(item: tuple[str, Split]) -> dict[str, Any]:
    """Discover both halves; return a line of the results file."""
    name, (folder, seed) = item
    session = read_session(folder)
    rng = np.random.default_rng(seed)
    poses = rng.permutation(np.unique(session.measurements.pose))
    started = time.process_time()
    halves = []
    for part in np.array_split(poses, 2):
        rows = np.flatnonzero(np.isin(session.measurements.pose, part))
        halves.append(half_of(session.select(rows), seed))
    seconds = time.process_time() - started
    fit, other = (half.found.fit for half in halves)
    # Joints that only the prior decides are not told apart by halves.
    known_to = np.maximum(fit.joint_offsets_std, other.joint_offsets_std)
    both = known_to < OPEN_ANGLE * halves[0].unmodelled.found.problem.chain.per_radian
    differences = (fit.joint_offsets - other.joint_offsets)[both]
    stated = np.hypot(fit.joint_offsets_std, other.joint_offsets_std)[both]
    again = [
        [key, mine.probability[key], theirs.probability.get(key, 0.0)]
        for mine, theirs in (halves, halves[::-1])
        for key in sure_of(mine)
    ]
    return {
        'name': name,
        'offsets': (differences / difference_std(halves)[both]).tolist(),
        'stated': (differences / stated).tolist(),
        'causes': again,
        'verdicts': [half.found.verdict for half in halves],
        'seconds': seconds,
    }


def _rms(values: list[float]) -> str:
    return f'{np.sqrt(np.mean(np.square(values))):.2f} of {len(values)}' if values else 'none'


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('--data', type=Path, default=ROOT.parent / 'shared' / 'data')
    parser.add_argument('--results', type=Path, default=Path('bench_halves.jsonl'))
    parser.add_argument('--only', nargs='+', choices=SETS, default=list(SETS))
    parser.add_argument('--splits', type=int, default=10)
    parser.add_argument('--jobs', type=int, default=os.cpu_count() or 1)
    args = parser.parse_args()
    if not args.data.is_dir():
        print(f'no data beside this repository ({args.data})')
        return
    wanted = {
        f'{name}-{seed}': Split(str(args.data / name), seed)
        for name in args.only
        for seed in range(args.splits)
    }
    done = known(args.results)
    todo = {name: split for name, split in wanted.items() if name not in done}
    for line in resumed(args.results, todo, run, args.jobs):
        done[line['name']] = line
        print(line['name'], f'{line["seconds"]:.0f} s', flush=True)
    rows, gone = [], []
    for name in args.only:
        lines = [done[f'{name}-{seed}'] for seed in range(args.splits)]
        causes = [cause for line in lines for cause in line['causes']]
        again = sum(chance >= LIKELY for _, _, chance in causes)
        gone += [(name, key, f'{chance:.2f}') for key, _, chance in causes if chance < LIKELY]
        rows.append(
            [
                f'`{name}`, {args.splits}',
                f'{again} of {len(causes)}'
                + (f' ({100 * again / len(causes):.0f} %)' if causes else ''),
                _rms([value for line in lines for value in line['offsets']]),
                _rms([value for line in lines for value in line['stated']]),
                f'{np.median([line["seconds"] for line in lines]):.0f}',
            ]
        )
    header = (
        'set, splits',
        'causes of one half in the other',
        'offsets, by the variance of the difference',
        'by the stated std',
        'CPU s',
    )
    print(table(header, rows))
    print()
    print(table(('set', 'not in the other half', 'probability there'), gone))


if __name__ == '__main__':
    main()
