# SPDX-License-Identifier: Apache-2.0
"""Does `remaster discover` name what begins or ends in mid-session, with its moment?

Sessions come from the hidden world (test/worlds/changing_sessions.py). Right is who names kind,
joint and moment, within a twentieth of the session, and no other kind with certainty.

    python benchmarks/bench_changes.py [--count 4] [--multiple 6]
"""

from __future__ import annotations

import argparse
import time
import zlib
from typing import Any

import numpy as np
from common import table
from worlds.changing_sessions import CHANGING, Changing, changing_session
from worlds.hidden_sessions import Recipe

from remaster_ros.discovery.discover import discover_session
from remaster_ros.errors import RemasterError

SHARES = (0.3, 0.5, 0.7)
WITHIN = 0.05


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('--count', type=int, default=4, help='sessions of each kind')
    parser.add_argument('--multiple', type=float, default=6.0, help='of what can be detected')
    args = parser.parse_args()
    lines = []
    for kind in CHANGING:
        for number in range(args.count):
            lines.append(_line(kind, number, args.multiple))
            print(' | '.join(map(str, lines[-1])), flush=True)
    print(table(('session', 'outcome', 'verdict', 'named', 'CPU, s'), lines))
    right = sum(line[1] == 'right' for line in lines)
    false = sum(line[1] == 'wrong' for line in lines)
    print(f'{right} of {len(lines)} right, {false} wrong in green')


def _line(kind: str, number: int, multiple: float) -> tuple[Any, ...]:
    name = f'change-{kind}-{number}'
    recipe = Recipe(
        zlib.crc32(name.encode()),
        (kind,),
        multiple,
        robot=('iiwa7', 'six')[number % 2],
        noise=('independent', 'pose_common')[number // 2 % 2],
    )
    hidden = changing_session(recipe, SHARES[number % 3], ends=number % 4 == 3)
    started = time.process_time()
    try:
        found = discover_session(hidden.session, rng=np.random.default_rng(recipe.seed))
    except RemasterError as error:
        return name, 'refused', '', str(error).replace('|', '/'), ''
    seconds = time.process_time() - started
    named = [
        f'{effect.title} ({effect.probability:.2f})'.replace('|', '/') for effect in found.effects
    ]
    named += [f'? {error_kind.where} {error_kind.driver}' for error_kind in found.unexplained]
    return name, outcome(hidden, found), found.verdict, '; '.join(named), f'{seconds:.1f}'


def outcome(hidden: Changing, found: Any) -> str:
    """Return 'right', 'unsure' where no cause is certain, 'beside' or 'wrong'."""
    certain = [effect for effect in found.effects if effect.is_certain]
    for effect in found.effects:
        if effect.name != hidden.kind or (
            hidden.joints and not {*hidden.joints} & {*effect.joints}
        ):
            continue
        is_dated = (
            effect.moment_s is not None
            and abs(effect.moment_s - hidden.moment_s) <= WITHIN * hidden.duration_s
        )
        if is_dated:
            further_effects = [e for e in certain if e.name != hidden.kind]
            return 'right' if not further_effects else 'beside'
    return 'wrong' if certain and not found.unexplained else 'unsure'


if __name__ == '__main__':
    main()
