# SPDX-License-Identifier: Apache-2.0
"""What daily checks say of healthy arms, after a jump, and in a slow drift.

Each arm has eight chosen poses, 0.1 mm of noise per axis and reading, and a check a day; a joint
that is drawn jumps by 3 standard deviations of a check after 30 days, or drifts to 6 in 60 days.
Of each arm: whether and when a change or drift was told with its size (an alarm or less), whether
it was called changed, and whether the last answer is still an open question.

    OMP_NUM_THREADS=1 python benchmarks/bench_check.py --arms 30
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
from common import table
from worlds.checked_arms import NOISE_M, CheckedArm

from remaster_ros.compensation import checking
from remaster_ros.compensation.arm_model import ArmModel
from remaster_ros.compensation.checking import POWER_STD, CheckResult, judge

FIRST_SEED = 800
DAYS = 60
BEFORE = 30
# Days that are looked at: every check is written, and judged on these.
LOOKS = range(4, BEFORE + DAYS + 1, 2)
DAY_S = 86_400.0
# Each check is compared with the model once, however often its history is judged.
checking.seen = cache(checking.seen)


def of_arm(seed: int, kind: str, season_std: float) -> tuple[list[tuple[int, CheckResult]], int]:
    """Return what the checks of an arm say, by the day, and which joint has changed."""
    arm = CheckedArm(seed)
    rng = np.random.default_rng((seed, 3))
    joint = int(rng.integers(1, arm.true.joints))
    # Standard deviation of one check of a joint, m at the tool.
    std = NOISE_M * arm.sizes / POWER_STD
    sizes: Callable[[int], float] = {
        'healthy': lambda day: 0.0,
        'jump': lambda day: 3.0 * std[joint] if day >= BEFORE else 0.0,
        'drift': lambda day: 6.0 * std[joint] * max(0, day - BEFORE) / DAYS,
    }[kind]
    phases = rng.uniform(0.0, 2.0 * np.pi, arm.true.joints)

    def at(day: int) -> ArmModel:
        offsets = arm.true.joint_offsets.copy()
        offsets[joint] += sizes(day) / arm.levers[joint]
        if season_std:
            wave = season_std * std * np.sin(2.0 * np.pi * day / 365.0 + phases)
            offsets += np.nan_to_num(wave / arm.levers)
        return replace(arm.true, joint_offsets=offsets)

    checks = [replace(arm.check(at(day)), when_s=DAY_S * day) for day in range(BEFORE + DAYS)]
    return [(count, judge(arm.found, checks[:count])) for count in LOOKS], joint


def main() -> None:
    """Print the error rates."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--arms', type=int, default=30)
    parser.add_argument('--kinds', nargs='+', default=['healthy', 'jump', 'drift'])
    parser.add_argument('--season-std', type=float, default=0.0, help='of a check, in every joint')
    args = parser.parse_args()
    rows = []
    for kind in args.kinds:
        changed, days, named, again, open_ = [], [], 0, 0, 0
        for seed in range(FIRST_SEED, FIRST_SEED + args.arms):
            said, joint = of_arm(seed, kind, args.season_std)
            again += sum(result.again for _, result in said)
            calls = [day for day, result in said if result.verdict in ('changed', 'setup_moved')]
            ends = [
                (day, result)
                for day, result in said
                if result.trend is not None or result.changed or result.verdict == 'setup_moved'
            ]
            changed += calls[:1]
            days += [ends[0][0]] if ends else []
            if ends:
                last = ends[-1][1]
                named += joint in (last.changed or (last.trend.joints if last.trend else ()))
            last = said[-1][1]
            open_ += last.verdict == 'unclear' and last.trend is None and not last.changed
        rows.append(
            (kind, args.arms, len(days), _median(days, kind), len(changed), _median(changed, kind),
             named, open_, again)
        )  # fmt: skip
    head = ('arms', 'count', 'told', 'days until', 'changed', 'days until', 'joint named')
    print(table((*head, 'open at the end', 'asked at once, looks'), rows))


def _median(days: list[int], kind: str) -> str:
    if not days:
        return '–'
    return f'{np.median(days) - (0 if kind == "healthy" else BEFORE):.0f}'


if __name__ == '__main__':
    main()
