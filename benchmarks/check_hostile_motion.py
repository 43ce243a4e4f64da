"""A real bridge process between a hostile arm and whatever can go wrong: what does it command?

Random injections (late, early, lost, doubled, reordered, wrapped, frozen, foreign joint states;
emergency stops, pauses, stops and kills at random moments) into bridges between an arm that obeys
everything and stand-ins for planner and recorder, over real DDS; several injections in the life
of a bridge, several bridges at a time in DDS domains of their own. Every command is judged by its
physics: see test/hostile_judge.py. Ends with status 1 if anything was wrong.

    python benchmarks/check_hostile_motion.py --injections 1000
    python benchmarks/check_hostile_motion.py --known         (the situations that were found)
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import common  # noqa: F401  its folder of helpers
import numpy as np
from common import machine, progress, table
from hostile_campaign import in_parallel
from hostile_judge import Rules
from hostile_known import known_situations
from hostile_outcomes import Outcome, report


def main() -> int:
    """Print the figures; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n', 1)[0])
    parser.add_argument('--injections', type=int, default=1000)
    parser.add_argument('--seed', type=int, default=int(time.time()))
    parser.add_argument('--bridges', type=int, default=3, help='at a time')
    parser.add_argument('--first-domain', type=int, default=150)
    parser.add_argument('--speed-share', type=float, default=0.3)
    parser.add_argument('--cartesian', type=float, default=np.inf, help='speed limit, m/s')
    parser.add_argument(
        '--acceleration', type=float, nargs='+', help='bound of each joint, or of all, rad/s^2'
    )
    parser.add_argument('--minutes', type=float, default=np.inf, help='stop after so long')
    parser.add_argument('--known', action='store_true', help='the known situations alone')
    parser.add_argument('--keep', type=Path, help="leave the bridges' logs in this folder")
    args = parser.parse_args()
    bound = None if args.acceleration is None else np.array(args.acceleration)
    rules = Rules(args.speed_share, args.cartesian, bound)
    print(f'{machine()}; seed {args.seed}')
    with tempfile.TemporaryDirectory(prefix='hostile_') as folder:
        where = args.keep or Path(folder)
        if args.known:
            return known(where, rules, args.first_domain)
        return campaign(args, where, rules)


def known(folder: Path, rules: Rules, domain: int) -> int:
    """Print what is commanded in the situations that were found first."""
    rows = list(known_situations(folder, rules, domain))
    header = (
        'situation', 'commanded way, deg', "of the URDF's speed, %", 'outside limits, deg',
        'back, deg', 'm/s', 'commands after it', 'halted', 'wrong',
    )  # fmt: skip
    print(table(header, [row.cells(rules) for row in rows]))
    return int(any(row.outcome.wrong(rules) for row in rows))


def campaign(args: argparse.Namespace, folder: Path, rules: Rules) -> int:
    """Print what came of random injections."""
    began = time.monotonic()
    outcomes: list[Outcome] = []
    broken: list[str] = []
    domains: Sequence[int] = range(args.first_domain, args.first_domain + args.bridges)
    deadline = began + 60.0 * args.minutes
    for some, error in in_parallel(args.seed, args.injections, folder, rules, domains, deadline):
        outcomes += some
        broken += [error] if error else []
        progress(f'{len(outcomes)} of {args.injections}, {time.monotonic() - began:.0f} s')
    progress('')
    print(report(outcomes, rules))
    print(f'{time.monotonic() - began:.0f} s')
    for error in broken:
        print(f'the test itself broke: {error}')
    return int(bool(broken) or any(outcome.wrong(rules) for outcome in outcomes))


if __name__ == '__main__':
    raise SystemExit(main())
