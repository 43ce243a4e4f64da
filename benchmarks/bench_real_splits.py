"""Do answers hold on poses that neither search nor guard has seen? Parts of real sessions.

From each session whole poses are drawn in ways that nothing was tuned for: so many at random,
those on one side of the workspace, without one corner of it, the first half in time, those with
nearly the same joint angles, those nearest to a plane, one branch of the joint solutions. Some of
them are fitted and a fifth as many held out; all others make a third set. What is left of the
region that was drawn from is *inside*, the rest *outside*. Printed are

- verdict, colour of the page and named causes,
- RMS of the 3-D error on held-out rows and on the third set, by the offsets and as returned, and
  their ratio; more than 1.05 is harm,
- how many rows lie in the 95 % regions predicted for them,
- how far zero-offsets, the same with what causes add to the joints' angles on the average, and
  sizes of causes are from those of the whole session with its causes, in the part's stated
  standard deviations: RMS and largest; curves at rows of the part, without their mean,
- CPU and peak memory of the search with its page's content.

Parts that are in the results file already are not repeated. The seed of a part is in its name.

    python benchmarks/bench_real_splits.py [--only NAME …] [--limit 600] [--report]
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from common import ROOT, each_in_its_process, table
from hidden_third import HARM, predicted_by_offsets, predictions_elsewhere
from scipy.cluster.vq import kmeans2

from remaster_ros.discovery.discover import Discovery, discover_session
from remaster_ros.reports.discovery_json import discovery_content, predictions_of
from remaster_ros.session.reader import read_session
from remaster_ros.types import BoolArray, FloatArray, IntArray, Measurements, Session

DATA = ROOT.parent / 'shared' / 'data'
SETS = {'B': 'ur10_two_solutions', 'D': 'ur10_iso_cubes', 'irb': 'irb120_three_points'}
HELD_OUT = 0.2
DRAWS = 40
ANGLES = 25
CORNERS = 8
# Of the UR10's joints 3 and 5, whose signs tell its branches apart.
BRANCH_JOINTS = [2, 4]


@dataclass(frozen=True)
class Part:
    """What is fitted of a session.

    Attributes
    ----------
    data
        Key of the session.
    kind
        Of the region that poses are drawn from.
    poses
        So many of them are fitted; 0 for the session with its own split.
    seed
        Of the draw and of the search.
    """

    data: str
    kind: str
    poses: int
    seed: int

    @property
    def name(self) -> str:
        """Name of its line."""
        return f'{self.data}-{self.kind}-{self.poses}-{self.seed}'


def parts() -> Iterator[Part]:
    """Give all parts; the whole sessions, which the others are compared with, first."""
    for data in ('irb', 'D', 'B'):
        yield Part(data, 'whole', 0, 0)
    for poses, seeds in ((40, 3), (80, 3), (150, 2), (300, 2)):
        yield from (Part(d, 'random', poses, seed) for d in 'DB' for seed in range(1, seeds + 1))
    yield from (Part('irb', 'random', 30, seed) for seed in (1, 2))
    for kind, poses in (('near', 60), ('plane', 100), ('side', 150), ('early', 150)):
        yield from (Part(data, kind, poses, 1) for data in 'DB')
    yield from (Part('irb', kind, 18, 1) for kind in ('side', 'early'))
    yield Part('D', 'corner', 150, 1)
    yield Part('D', 'branch', 150, 1)
    yield Part('B', 'branch', 150, 1)


def region(rows: Measurements, kind: str, poses: int, rng: np.random.Generator) -> BoolArray:
    """Return which rows lie where poses are drawn from, (n,)."""
    every, index = np.unique(rows.pose, return_inverse=True)

    def of_poses(values: FloatArray) -> FloatArray:
        """Return the mean of the rows of each pose."""
        total: FloatArray = np.bincount(index, values) / np.bincount(index)
        return total

    if kind in ('whole', 'random'):
        return np.ones(len(rows), bool)
    if kind == 'side':
        x = of_poses(rows.position[:, 0])
        return (x < np.median(x))[index]
    if kind == 'early':
        time_s = of_poses(rows.stamp_s)
        return (time_s < np.median(time_s))[index]
    if kind == 'branch':
        _, of_row, count = np.unique(
            np.sign(np.sin(rows.q[:, BRANCH_JOINTS])),
            axis=0,
            return_inverse=True,
            return_counts=True,
        )
        return of_row.ravel() == np.argmax(count)
    places = np.column_stack([of_poses(axis) for axis in rows.position.T])
    centred = places - places.mean(axis=0)
    if kind == 'corner':
        _, cluster = kmeans2(centred, CORNERS, minit='++', rng=rng)
        return (cluster != rng.integers(CORNERS))[index]
    most = round((1.0 + HELD_OUT) * poses)
    if kind == 'plane':
        away = np.abs(centred @ np.linalg.svd(centred, full_matrices=False)[2][-1])
    else:
        angles = np.column_stack([of_poses(axis) for axis in rows.q.T])
        away = np.linalg.norm(angles - angles[rng.integers(len(every))], axis=1)
    return np.isin(rows.pose, every[np.argsort(away)[:most]])


def split(session: Session, part: Part) -> tuple[Session, dict[str, BoolArray]]:
    """Return what is fitted and held out, and which rows make the third set."""
    rows = session.measurements
    if not part.poses:
        return session, {}
    rng = np.random.default_rng([part.seed, part.poses, *map(ord, part.kind)])
    inside = region(rows, part.kind, part.poses, rng)
    drawn = rng.permutation(np.unique(rows.pose[inside]))
    first = drawn[: part.poses]
    taken = inside & np.isin(rows.pose, drawn[: round((1.0 + HELD_OUT) * part.poses)])
    again = replace(rows, is_validation=~np.isin(rows.pose, first))
    third = {'inside': inside & ~taken, 'outside': ~inside}
    return (
        replace(session, measurements=again).select(taken),
        {where: which for where, which in third.items() if which.any()},
    )


def one(part: Part, session: Session, whole_file: Path) -> dict[str, Any]:
    """Search a part of a session; return a line of the results file."""
    fitted, third = split(session, part)
    start = time.process_time()
    found = discover_session(fitted, rng=np.random.default_rng(part.seed))
    content = discovery_content(found)
    seconds = time.process_time() - start
    memory_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    mm = [error and 1e3 * error for error in _held_out(found)]
    line = {
        'name': part.name,
        'rows': [int(np.sum(fitted.measurements.is_validation == held)) for held in (False, True)],
        'verdict': found.verdict,
        'mood': content.judgement.mood,
        'headline': content.judgement.headline,
        'converged': found.fit.sampler.converged,
        'causes': {},
        'unexplained': [f'{u.where}/{u.driver}: {u.next}' for u in found.unexplained],
        'noise_mm': 1e3 * found.gain.noise_floor_m,
        'held_out_mm': mm,
        'held_out_inside': _share(predictions_of(found).inside[fitted.measurements.is_validation]),
        'widening': content.predicted_regions95.widening,
        'third': {where: _third(found, session.select(rows)) for where, rows in third.items()},
        'seconds': seconds,
        'memory_mb': memory_mb,
    }
    for effect in found.effects:
        joints = line['causes'].get(effect.name, [])
        line['causes'][effect.name] = sorted({*joints, *effect.joints})
    if not part.poses:
        _keep(found, whole_file)
    elif whole_file.exists():
        with np.load(whole_file) as whole:
            line |= _compared(found, whole)
    return line


def _held_out(found: Discovery) -> tuple[float | None, float | None]:
    return found.gain.held_out_rms_before_m, found.gain.held_out_rms_after_m


def _share(inside: BoolArray) -> float | None:
    return float(inside.mean()) if len(inside) else None


def _third(found: Discovery, third: Session) -> dict[str, Any]:
    """Judge predictions of rows that were never seen."""
    rows = third.measurements
    predicted = predictions_elsewhere(found, third)
    limit = np.trace(predicted.covariance, axis1=1, axis2=2)
    lengths = [
        1e3 * np.linalg.norm(rows.position - position, axis=1)
        for position in (predicted_by_offsets(found.fit.session, third), predicted.position)
    ]
    return {
        'rows': len(rows),
        'rms_mm': [float(np.sqrt(np.mean(length**2))) for length in lengths],
        'mean_mm': [float(length.mean()) for length in lengths],
        'inside': _share(predicted.inside),
        'std_mm': 1e3 * float(np.sqrt(limit.mean())),
    }


def _cells(found: Discovery) -> Iterator[tuple[str, Any, slice]]:
    solution = found.solution
    for cell, where in zip(solution.cells, solution.slices(), strict=True):
        if cell.penalty is None or cell.place == 'joint_angle':
            yield f'{cell.name}_{cell.joints}_{cell.variant}', cell, where


def _keep(found: Discovery, path: Path) -> None:
    """Write offsets and sizes of the whole session; curves and turns as they are in every row."""
    fit, context = found.fit, found.residuals.context
    turns = np.zeros((len(context), context.joints))
    kept: dict[str, FloatArray] = {
        'observation': fit.session.measurements.observation,
        'offsets': fit.joint_offsets,
        'known': fit.identifiable,
        'turns': turns,
    }
    for name, cell, where in _cells(found):
        columns = cell.columns(context)
        if columns.at is not None:
            turns[:, columns.at] += columns.values @ fit.theta[where]
        if cell.penalty is not None:
            kept[f'curve {name}'] = columns.values @ fit.theta[where]
        else:
            for parameter, value in zip(cell.parameters, fit.theta[where], strict=True):
                kept[f'size {parameter}'] = value
    np.savez(path, **kept)


def _compared(found: Discovery, whole: Any) -> dict[str, Any]:
    """Return differences to the whole session in the part's standard deviations."""
    fit, context = found.fit, found.residuals.context
    both = fit.identifiable & whole['known']
    fitted = np.flatnonzero(context.to_fit)
    of_whole = np.searchsorted(whole['observation'], fit.session.measurements.observation[fitted])
    # With what the causes add to the joint's angle on the average: where zero is put is a choice.
    turn = fit.joint_offsets.copy()
    draws = fit.joint_offset_draws.reshape(-1, context.joints).copy()
    sizes: dict[str, float] = {}
    for name, cell, where in _cells(found):
        columns = cell.columns(context)
        own = fit.theta_draws[..., where].reshape(-1, cell.size)
        if columns.at is not None:
            mean = columns.values[fitted].mean(axis=0)
            turn[columns.at] += mean @ fit.theta[where]
            draws[:, columns.at] += own @ mean
        if cell.penalty is None:
            for index, parameter in enumerate(cell.parameters):
                if (key := f'size {parameter}') in whole:
                    value, std = fit.theta[where][index], fit.theta_std[where][index]
                    sizes[parameter] = float((value - whole[key]) / std)
        elif (key := f'curve {name}') in whole:
            at = _spread_out(context.measurements.q[fitted, cell.joints[-1] - 1])
            heights = columns.values[fitted[at]]
            heights = heights - heights.mean(axis=0)
            other = whole[key][of_whole[at]]
            apart = heights @ fit.theta[where] - other + other.mean()
            sizes[name] = float(np.sqrt(np.mean((apart / (own @ heights.T).std(axis=0)) ** 2)))
    turn_of_whole = whole['offsets'] + whole['turns'][of_whole].mean(axis=0)
    names = np.array(fit.joint_names)[both].tolist()

    def by_joint(apart: FloatArray, std: FloatArray) -> dict[str, float]:
        return dict(zip(names, (apart / std)[both].tolist(), strict=True))

    return {
        'offsets_z': by_joint(fit.joint_offsets - whole['offsets'], fit.joint_offsets_std),
        'turns_z': by_joint(turn - turn_of_whole, draws.std(axis=0)),
        'sizes_z': sizes,
    }


def _spread_out(angle: FloatArray) -> IntArray:
    """Return indices at quantiles of an angle (n,)."""
    order: IntArray = np.argsort(angle)
    return order[np.linspace(0, len(order) - 1, ANGLES).astype(int)]


def _errors(line: dict[str, Any], where: str) -> str:
    third = line['third'].get(where)
    if third is None:
        return ''
    before, after = third['rms_mm']
    ratio = f'{after / before:.2f}'
    if after > HARM * before:
        ratio = f'**{ratio}**'
    inside = f'{100.0 * third["inside"]:.0f} % of {third["rows"]}'
    return f'{before:.3f} → {after:.3f}, {ratio}; {third["mean_mm"][1]:.3f}; {inside}'


def _apart(z: dict[str, float]) -> str:
    if not z:
        return ''
    name = max(z, key=lambda key: abs(z[key]))
    rms = float(np.sqrt(np.mean(np.square(list(z.values())))))
    return f'{rms:.1f}; {name} {z[name]:+.1f}'


def row_of(line: dict[str, Any]) -> list[object]:
    """Return a row of the table."""
    if 'error' in line:
        return [line['name'], line['error'], *[''] * (len(HEADER) - 2)]
    shown = {'good': 'green', 'caution': 'amber', 'bad': 'red'}
    before, after = line['held_out_mm']
    held_out = '' if before is None else f'{before:.3f} → {after:.3f}'
    inside = line['held_out_inside']
    return [
        line['name'],
        ' + '.join(map(str, line['rows'])),
        f'{line["verdict"]}, {shown[line["mood"]]}',
        '; '.join(f'{k} {",".join(map(str, v))}' for k, v in line['causes'].items()),
        held_out if inside is None else f'{held_out}; {100.0 * inside:.0f} %',
        _errors(line, 'inside'),
        _errors(line, 'outside'),
        _apart(line.get('offsets_z', {})),
        _apart(line.get('turns_z', {})),
        _apart(line.get('sizes_z', {})),
        f'{line["seconds"]:.1f}',
        f'{line["memory_mb"]:.0f}',
    ]


HEADER = (
    'part (poses, seed)',
    'rows fitted + held out',
    'verdict, page',
    'causes',
    'held out, mm RMS; in 95 %',
    'third set inside, mm RMS, ratio; mean; in 95 %',
    'third set outside',
    'offsets apart, std',
    'with what causes add to the angles',
    'sizes apart, std',
    'CPU, s',
    'MB',
)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('--results', type=Path, default=Path('bench_real_splits.jsonl'))
    parser.add_argument('--only', nargs='*', default=(), help='what the names begin with')
    parser.add_argument('--limit', type=int, default=600, help='seconds of CPU for each search')
    parser.add_argument('--report', action='store_true', help='print what is known, run nothing')
    parser.add_argument('--run', help='only this one, as a line of the results file')
    args = parser.parse_args()
    todo = {part.name: part for part in parts()}
    if args.run:
        # The system ends what takes longer, whatever it is in the middle of.
        resource.setrlimit(resource.RLIMIT_CPU, (args.limit, args.limit))
        part = todo[args.run]
        whole_file = args.results.with_suffix(f'.{part.data}.npz')
        session = read_session(DATA / SETS[part.data])
        print(json.dumps(one(part, session, whole_file)))
        return
    wanted = [name for name in todo if name.startswith(tuple(args.only) or '')]
    commands = {
        name: (__file__, '--run', name, '--results', str(args.results))
        for name in (() if args.report else wanted)
    }
    lines = each_in_its_process(args.results, commands, args.limit)
    print(table(HEADER, [row_of(lines[name]) for name in wanted if name in lines]))


if __name__ == '__main__':
    main()
