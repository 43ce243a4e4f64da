# SPDX-License-Identifier: Apache-2.0
"""Are two sessions of one arm taken for those of two arms, or the other way round?

Pairs of hidden sessions on different tours before sensors set up anew: of one arm (with nothing
beside its zero-offsets, links and axes off their drawing, a soft joint, an eccentric encoder, or
other errors of the arm; three robots, four kinds of noise), and of two arms of one kind.

    OMP_NUM_THREADS=1 python benchmarks/bench_one_arm.py --pairs 60
"""

from __future__ import annotations

import argparse
from collections import Counter

import numpy as np
from common import table
from worlds.hidden_sessions import NOISES, Recipe, another_session, hidden_session

from remaster_ros.calibration.mistakes import sound_estimate
from remaster_ros.calibration.one_arm import OffsetDifferences, offset_differences
from remaster_ros.types import Session

KINDS: tuple[tuple[str, ...], ...] = (
    (),
    ('link_length', 'joint_axis_tilt'),
    ('joint_compliance',),
    ('encoder_eccentricity',),
    ('link_length', 'joint_compliance', 'encoder_eccentricity'),
    ('backlash',),
)
ROBOTS = ('iiwa7', 'six', 'ur10')
FIRST_SEED = 700


def compared(first: Session, other: Session) -> OffsetDifferences | None:
    """Compare the offsets of two sessions."""
    return offset_differences(*(sound_estimate(session) for session in (first, other)))


def word(found: OffsetDifferences | None) -> str:
    """Return what is said of a pair."""
    if found is None:
        return 'not comparable'
    return 'refused' if found.mostly else 'amber' if found.differ else 'one arm'


def main() -> None:
    """Print how often pairs are told apart."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--pairs', type=int, default=60)
    parser.add_argument('--first', type=int, default=FIRST_SEED)
    parser.add_argument('--verbose', action='store_true')
    args = parser.parse_args()
    said = {True: Counter[str](), False: Counter[str]()}
    for number in range(args.pairs):
        seed = args.first + number
        kinds, robot = KINDS[number % len(KINDS)], ROBOTS[number // len(KINDS) % len(ROBOTS)]
        noise = list(NOISES)[number % len(NOISES)]
        recipe = Recipe(seed, kinds, robot=robot, noise=noise, candidates=50)
        further = Recipe(seed + 10_000, kinds, robot=robot, noise=noise, candidates=50)
        first = hidden_session(recipe)
        pairs = {
            True: another_session(first, further, first.truth.effects),
            False: hidden_session(further),
        }
        for same, other in pairs.items():
            found = compared(first.session, other.session)
            said[same][word(found)] += 1
            if args.verbose and found is not None:
                shown = np.round(found.sigmas, 1).tolist()
                print(seed, robot, kinds, same, word(found), f'{found.p_value:.1e}', shown)
    head = ('pairs of', 'one arm', 'amber', 'refused', 'not comparable')
    rows = [
        ('one arm' if same else 'two arms', *(counts[name] for name in head[1:]))
        for same, counts in said.items()
    ]
    print(table(head, rows))


if __name__ == '__main__':
    main()
