# SPDX-License-Identifier: Apache-2.0
"""Does `remaster discover` name what is hidden, and nothing where nothing is?

Sessions come from a world of its own (test/worlds/hidden_world.py: pinocchio, no code shared with
the package but the plain records and the planning). Each is one line of the results file, so that
the benchmark can be stopped and goes on where it was; figures are printed as they come.

    python benchmarks/bench_discovery.py                      all of it, on all cores
    python benchmarks/bench_discovery.py --only null --count 40
    python benchmarks/bench_discovery.py --report             only print what is known so far
    python benchmarks/bench_discovery.py --session single-backlash-3    one again, in full

Single effects are drawn with sizes between half and eight times the one at which the best possible
test, which is given the effect and the noise, finds them in 90 % of sessions at 2 % false
alarms. Judged by test/judges/hidden_effects.py: right is who names exactly what was hidden. The
model that is returned is compared with the offsets alone on a third set of poses, without noise;
harm is an error more than 5 % larger there.
"""

from __future__ import annotations

import argparse
import json
import os
import time
import warnings
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from common import known, resumed
from discovery_tables import report
from judges.hidden_effects import judge
from worlds.hidden_sessions import (
    NOISES,
    WRONG_NOISES,
    Recipe,
    held_out_noise_m,
    hidden_session,
    third_visits,
)
from worlds.hidden_third import third_errors

from remaster_ros.discovery.discover import discover_session
from remaster_ros.simulation.hidden_effects import NAMED

ROBOTS = ('iiwa7', 'six')
SENSORS = (('mocap',), ('mocap', 'tracker'))
FEW = (10, 13, 16)
"""Candidates of the sessions with few poses."""
MISPAIRED = 'mispaired'
STRUCTURE = (
    'range_distortion',
    'spherical_distortion',
    'one_sided_lens',
    'slipped_marker',
    'slipped_joint',
    'bumped_sensor',
)
# Sessions of two and three keep the kinds that they were drawn from first.
AT_ONCE = tuple(kind for kind in NAMED if kind not in ('lateral_compliance', 'base_tipping'))
# On a plane, the tool hardly turned, a wrong marker is seen only where it is wrong by decimetres.
SEEN_ANYWHERE = tuple(kind for kind in AT_ONCE if kind != 'marker_offset')


@dataclass(frozen=True)
class Group:
    """Sessions of one sort.

    Attributes
    ----------
    count
        How many, of each kind where there are kinds.
    each
        Kinds of effects, or of noise: a session has one of them, in turn.
    of, at_once
        Kinds of which so many are hidden at once, drawn anew for every session; the numbers in
        turn.
    powers
        Powers of two between which sizes are drawn, as multiples of what can be detected.
    where
        See `hidden_tours.visits`; but for ``all`` the marker is known to 5 mm only.
    """

    count: int
    each: tuple[str, ...] = ('',)
    of: tuple[str, ...] = ()
    at_once: tuple[int, ...] = (0,)
    powers: tuple[float, float] = (-1.0, 3.0)
    where: str = 'all'


GROUPS = {
    'single': Group(24, tuple(NAMED)),
    'pair': Group(60, of=AT_ONCE, at_once=(2,), powers=(2.0, 3.0)),
    'triple': Group(40, of=AT_ONCE, at_once=(3,), powers=(2.0, 3.0)),
    'unnamed': Group(
        12,
        (
            'foreign_torque',
            'creeping_joint',
            'slipped_joint',
            'warm_joint',
            'bent_coupling',
            'sagging_tool',
            'bumped_sensor',
            'off_centre_lens',
            'lagging_growth',
        ),
    ),
    # Nothing is hidden in these two; `few` has few poses.
    'null': Group(300),
    'few': Group(150),
    # What no simple cause explains, and noise that no noise model has.
    'structure': Group(40, (*STRUCTURE, MISPAIRED), powers=(1.0, 3.0)),
    'noise': Group(150, tuple(noise for noise in WRONG_NOISES if noise != MISPAIRED)),
    # Poses on a plane or in a small region: nothing hidden, or one effect; then two large ones
    # that no simple cause explains.
    'plane': Group(80, ('',), SEEN_ANYWHERE, (0, 1), (1.0, 3.0), 'plane'),
    'region': Group(80, ('',), SEEN_ANYWHERE, (0, 1), (1.0, 3.0), 'region'),
    'plane_wrong': Group(40, ('',), STRUCTURE, (2,), (3.0, 5.0), 'plane'),
    'region_wrong': Group(40, ('',), STRUCTURE, (2,), (3.0, 5.0), 'region'),
}


def recipes(name: str, count: int) -> Iterator[tuple[str, Recipe]]:
    """Give every session of a group with its name; the first n stay the same for any count."""
    group = GROUPS[name]
    for i in range(count):
        for kind in group.each:
            session = '-'.join(part for part in (name, kind, str(i)) if part)
            yield session, _recipe(session, name, group, kind, i)


def _recipe(session: str, name: str, group: Group, kind: str, i: int) -> Recipe:
    seed = zlib.crc32(session.encode())
    rng = np.random.default_rng(seed)
    hidden: tuple[str, ...] = (kind,) if kind and kind not in WRONG_NOISES else ()
    if drawn := group.at_once[i % len(group.at_once)]:
        hidden = tuple(rng.choice(group.of, drawn, replace=False).tolist())
    multiple = float(2.0 ** rng.uniform(*group.powers))
    plain = name == 'few' or kind in WRONG_NOISES
    # Half, a quarter … of the sessions have each: all combinations occur.
    return Recipe(
        seed=seed,
        kinds=hidden,
        multiple=multiple,
        robot=ROBOTS[i // len(group.at_once) % 2],
        # Of two markers only one can lie on a plane.
        sensors=SENSORS[0 if group.where == 'plane' else (i // 2) % 2],
        noise=kind if kind in WRONG_NOISES else tuple(NOISES)[(i // 4) % 4],
        outliers=bool(rng.random() < 0.5) and not plain,
        held_out_outliers=name == 'null',
        candidates=FEW[i % 3] if name == 'few' else None,
        where=group.where,
        marker_std_m=0.5e-3 if group.where == 'all' else 5e-3,
    )


def run(name: str, recipe: Recipe, talk: bool = False) -> dict[str, Any]:
    """Make one session, discover, judge; return a line of the results file."""
    hidden = hidden_session(recipe)
    started = time.process_time()
    line: dict[str, Any] = {
        'name': name,
        'robot': recipe.robot,
        'sensors': len(recipe.sensors),
        'noise': recipe.noise,
        'outliers': recipe.outliers,
        'rows': int(np.sum(~hidden.session.measurements.is_validation)),
        'kinds': list(recipe.kinds),
        'truth': [str(effect) for effect in hidden.truth.effects],
        'multiple': recipe.multiple,
        'size_mm': [1e3 * size for size in hidden.truth.size_m],
        'best_mm': [1e3 * size for size in hidden.best_size_m],
        'floor_mm': 1e3 * held_out_noise_m(hidden),
    }
    try:
        with warnings.catch_warnings():
            warnings.simplefilter('error')
            found = discover_session(hidden.session, rng=np.random.default_rng(recipe.seed))
    except Exception as error:  # a benchmark goes on, and counts it
        return {**line, 'error': f'{type(error).__name__}: {error}'}
    line['seconds'] = time.process_time() - started
    verdict = judge(hidden.world, hidden.truth, found)
    third = third_errors(hidden.world, hidden.truth.effects, third_visits(recipe), found)
    line |= {
        'verdict': found.verdict,
        'hidden': [_cause(cause) for cause in verdict.hidden],
        'named': [_cause(cause) for cause in verdict.named],
        'named_right': verdict.named_right,
        'forgiven': verdict.forgiven,
        'first_right': verdict.first_right,
        'size_right': verdict.size_right,
        'deviations': {key: round(z, 3) for key, z in verdict.deviations.items()},
        'listed': [
            [f'{other.name} {list(other.joints)}' for other in effect.confusable_with]
            for effect in found.effects
        ],
        'p_values': [effect.p_value for effect in found.effects],
        'sigmas': [round(effect.sigmas, 2) for effect in found.effects],
        'outcome': verdict.outcome,
        'unexplained': [
            [entry.where, entry.driver, 1e3 * entry.size_m, entry.p_value]
            for entry in found.unexplained
        ],
        'third_offsets_mm': 1e3 * third.offsets_m,
        'third_mm': 1e3 * third.returned_m,
        'harm': third.harm,
        'before_mm': 1e3 * found.gain.held_out_rms_before_m,
        'after_mm': 1e3 * found.gain.held_out_rms_after_m,
    }
    if talk:
        for effect in found.effects:
            print(effect)
    return line


def _run(item: tuple[str, Recipe]) -> dict[str, Any]:
    return run(*item)


def _cause(cause: tuple[str, tuple[int, ...], str]) -> str:
    name, joints, driver = cause
    return ' '.join(part for part in (name, ','.join(map(str, joints)), driver) if part)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('--results', type=Path, default=Path('bench_discovery.jsonl'))
    parser.add_argument('--only', nargs='+', choices=tuple(GROUPS), default=list(GROUPS))
    parser.add_argument(
        '--kind', nargs='+', help='only sessions with these effects, or this noise'
    )
    parser.add_argument('--count', type=int, help='sessions (of each kind) instead of all')
    parser.add_argument('--above', type=float, default=0.0, help='only larger multiples than this')
    parser.add_argument('--jobs', type=int, default=os.cpu_count())
    parser.add_argument('--report', action='store_true', help='print what is known, run nothing')
    parser.add_argument('--session', metavar='NAME', help='run one again and print all of it')
    args = parser.parse_args()
    wanted = {
        name: recipe
        for group in args.only
        for name, recipe in recipes(group, args.count or GROUPS[group].count)
        if not args.kind or set(args.kind) & {*recipe.kinds, recipe.noise}
        if recipe.multiple > args.above or not recipe.kinds
    }
    if args.session:
        everything = {n: r for g in GROUPS for n, r in recipes(g, 1000)}
        line = run(args.session, everything[args.session], talk=True)
        print(json.dumps(line, indent=1))
        return
    done = known(args.results)
    todo = {name: recipe for name, recipe in wanted.items() if name not in done}
    if args.report:
        todo = {}
    ready = len(wanted.keys() & done.keys())
    print(f'{ready} of {len(wanted)} sessions known, {len(todo)} to run', flush=True)
    for number, line in enumerate(resumed(args.results, todo, _run, args.jobs), 1):
        done[line['name']] = line
        outcome = line.get('error') or (
            line['outcome']
            + (' HARM' if line['harm'] else '')
            + f' x{line["multiple"]:.1f} {line["seconds"]:.1f} s: '
            + ('; '.join(line['named']) or 'nothing')
        )
        print(f'{number}/{len(todo)} {line["name"]}: {outcome}', flush=True)
    print()
    report(line for name, line in done.items() if name in wanted)


if __name__ == '__main__':
    main()
