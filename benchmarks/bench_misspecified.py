"""Do intervals hold where the model is wrong? Two more effects, too small to be named.

Sessions of the hidden world with two effects of half to one times the size at which the best
possible test, which is given effect and noise, finds them in 90 %; in every second session
there is also one effect of four to eight times that size. How often do the 95 % intervals of
zero-offsets and of named sizes hold the truth? Of `fit`, and of `discover`. Beside it, for every
fourth of the sessions, the same without the two: what the intervals do where the model is right.
It goes on where it was stopped, like bench_discovery.py.

    python benchmarks/bench_misspecified.py [--count 500] [--report]

What counts as the true zero-offset is in test/hidden_offsets.py; `as drawn` is the one that was
drawn, though another effect is in part the same.
"""

from __future__ import annotations

import argparse
import os
import warnings
import zlib
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from bench_discovery import ROBOTS, SENSORS
from common import known, resumed, table
from hidden_offsets import true_offsets
from hidden_sessions import NOISES, HiddenSession, Recipe, hidden_session

from remaster_ros.calibration.fit import fit_session
from remaster_ros.calibration.result import FitResult
from remaster_ros.discovery.discover import Discovery, discover_session
from remaster_ros.simulation.hidden_effects import NAMED, true_parameters

# A marker's offset is within its prior, unlike the rest.
SMALL = tuple(kind for kind in NAMED if kind != 'marker_offset')
Z95 = 1.959964


def recipes(count: int) -> Iterator[tuple[str, Recipe]]:
    """Give every session with its name; the first n stay the same for any count."""
    for i in range(count):
        name = f'misspecified-{i}'
        seed = zlib.crc32(name.encode())
        rng = np.random.default_rng(seed)
        *further, clear = rng.choice(SMALL, 3, replace=False).tolist()
        recipe = Recipe(
            seed=seed,
            kinds=(clear,) if i % 2 else (),
            multiple=float(2.0 ** rng.uniform(2.0, 3.0)),
            robot=ROBOTS[i // 2 % 2],
            sensors=SENSORS[i // 4 % 2],
            noise=tuple(NOISES)[i // 8 % 4],
            further=tuple(further),
            further_multiple=float(2.0 ** rng.uniform(-1.0, 0.0)),
        )
        yield name, recipe
        if i // 2 % 4 == 0:
            yield f'right-{i}', replace(recipe, further=())


def run(item: tuple[str, Recipe]) -> dict[str, Any]:
    """Make one session, fit, discover; return a line of the results file."""
    name, recipe = item
    hidden = hidden_session(recipe)
    line: dict[str, Any] = {
        'name': name,
        'kinds': list(recipe.kinds),
        'further': list(recipe.further),
        'further_multiple': recipe.further_multiple,
    }
    try:
        with warnings.catch_warnings():
            warnings.simplefilter('error')
            rng = np.random.default_rng(recipe.seed)
            fit = fit_session(hidden.session, rng=rng)
            found = discover_session(hidden.session, rng=rng)
    except Exception as error:  # a benchmark goes on, and counts it
        return {**line, 'error': f'{type(error).__name__}: {error}'}
    return {
        **line,
        'verdict': found.verdict,
        'named': [f'{effect.name} {list(effect.joints)}' for effect in found.effects],
        'fit': _offsets(fit, hidden, set()),
        'discover': _offsets(
            found.fit,
            hidden,
            {(effect.name, joint) for effect in found.effects for joint in effect.joints},
        ),
        'sizes': _sizes(hidden, found),
    }


def _offsets(
    fit: FitResult, hidden: HiddenSession, named: set[tuple[str, int]]
) -> list[list[float]]:
    """Return for each identifiable joint: number, z, and whether its interval holds.

    The last of them for the offset as drawn.
    """
    true = true_offsets(hidden.world, hidden.truth, named)
    drawn = hidden.truth.joint_offsets
    low, high = fit.joint_offsets_interval95.T
    z = (fit.joint_offsets - true) / fit.joint_offsets_std
    return [
        [
            int(j) + 1,
            round(float(z[j]), 3),
            int(low[j] <= true[j] <= high[j]),
            int(low[j] <= drawn[j] <= high[j]),
        ]
        for j in np.flatnonzero(fit.identifiable)
    ]


def _sizes(hidden: HiddenSession, found: Discovery) -> dict[str, float]:
    """Return (found - true) / std of every parameter that is of a hidden effect."""
    true = {
        name: (effect.kind, value)
        for effect in hidden.truth.effects
        for name, value in true_parameters(effect).items()
    }
    return {
        parameter.name: round((parameter.value - true[parameter.name][1]) / parameter.std, 3)
        for effect in found.effects
        for parameter in effect.parameters
        if true.get(parameter.name, ('',))[0] == effect.name
    }


def report(lines: list[dict[str, Any]]) -> None:
    """Print the coverage of all intervals."""
    failed = [line for line in lines if 'error' in line]
    for line in failed[:5]:
        print(f'  failed: {line["name"]}: {line["error"]}')
    lines = [line for line in lines if 'error' not in line]
    rows = []
    for model, title in (('right', 'nothing more'), ('misspecified', 'two more, too small')):
        for clear in (False, True):
            mine = [
                line
                for line in lines
                if line['name'].startswith(model) and bool(line['kinds']) == clear
            ]
            hidden = 'one clear effect, ' * clear + title
            for who in ('fit', 'discover'):
                offsets = [row for line in mine for row in line[who]]
                rows.append((hidden, len(mine), f'{who}: offsets', *_coverage(offsets)))
            sizes = [
                [0, z, abs(z) <= Z95, abs(z) <= Z95]
                for line in mine
                for z in line['sizes'].values()
            ]
            rows.append((hidden, len(mine), 'discover: named sizes', *_coverage(sizes)))
    print(f'{len(lines)} sessions, {len(failed)} failed\n')
    figures = ('n', 'hold the truth', 'as drawn', 'RMS z', 'largest z')
    header = ('hidden', 'sessions', 'intervals of', *figures)
    print(table(header, rows))
    by_kind: dict[str, list[list[float]]] = defaultdict(list)
    for line in lines:
        for kind in line['further']:
            by_kind[kind] += line['discover']
    print('\nOffsets after discover, by a kind that is hidden and too small:\n')
    print(
        table(
            ('kind', *figures),
            [(kind, *_coverage(by_kind[kind])) for kind in sorted(by_kind)],
        )
    )


def _coverage(rows: list[list[float]]) -> tuple[str, ...]:
    if not rows:
        return '0', '', '', '', ''
    _, z, held, drawn = np.transpose(rows)
    return (
        str(len(rows)),
        f'{100.0 * held.mean():.1f} %',
        f'{100.0 * drawn.mean():.1f} %',
        f'{np.sqrt(np.mean(z**2)):.2f}',
        f'{np.abs(z).max():.1f}',
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('--results', type=Path, default=Path('bench_misspecified.jsonl'))
    parser.add_argument('--count', type=int, default=500)
    parser.add_argument('--jobs', type=int, default=os.cpu_count())
    parser.add_argument('--report', action='store_true', help='print what is known, run nothing')
    args = parser.parse_args()
    wanted = dict(recipes(args.count))
    done = known(args.results)
    todo = {} if args.report else {n: r for n, r in wanted.items() if n not in done}
    print(f'{len(wanted.keys() & done.keys())} of {len(wanted)} sessions known', flush=True)
    for number, line in enumerate(resumed(args.results, todo, run, args.jobs), 1):
        done[line['name']] = line
        outcome = line.get('error') or line['verdict']
        print(f'{number}/{len(todo)} {line["name"]}: {outcome}', flush=True)
    report([line for name, line in done.items() if name in wanted])


if __name__ == '__main__':
    main()
