"""How often checks raise an alarm where nothing has changed, and how soon one where something has.

`python benchmarks/bench_check.py [ARMS] [DAYS]`: series of results of five joints, in standard
deviations of a check; what matters at the tool is 2.9 of them (0.1 mm where 0.17 mm is found).
"""

import sys

import numpy as np
from scipy.special import stdtrit

from remaster_ros.compensation.checking import ALARM, bayes_factors, change

SMALLEST = 2.9
JOINTS = 5
AFTER = 20


def independent(rng, arms, days):
    return rng.standard_normal((arms, JOINTS, days))


def remembering(rng, arms, days, memory=0.6):
    x = rng.standard_normal((arms, JOINTS, days))
    for t in range(1, days):
        x[..., t] = memory * x[..., t - 1] + np.sqrt(1.0 - memory**2) * x[..., t]
    return x


def seasonal(rng, arms, days, size=1.0):
    phase = rng.uniform(0.0, 2.0 * np.pi, (arms, JOINTS, 1))
    season = size * np.sqrt(2.0) * np.sin(2.0 * np.pi * np.arange(days) / 365.0 + phase)
    return rng.standard_normal((arms, JOINTS, days)) + season


def alarms(x, days):
    """Return for each arm whether its checks up to so many days raise an alarm, (arms,)."""
    part = x[..., :days]
    odds, sizes, left = bayes_factors(part)
    j = np.arange(1.0, days)
    weighted = odds / (j * (j + 1.0))
    evidence = 1.0 / days + weighted.sum(axis=-1)
    best = evidence.argmax(axis=-1)
    arms = np.arange(len(x))
    at = weighted[arms, best].argmax(axis=-1)
    v = 1.0 / (at + 1.0) + 1.0 / (days - at - 1.0)
    half = stdtrit(days - 2.0, 0.975) * np.sqrt(v * left[arms, best, at] / (days - 2.0))
    found = (evidence.mean(axis=-1) >= ALARM) & (np.abs(sizes[arms, best, at]) - half > SMALLEST)
    for arm in np.flatnonzero(found):
        one = change(part[arm, best[arm]])
        found[arm] = abs(one.size) - one.half > SMALLEST
    return found


def main(arms=500, days=1000, seed=36):
    rng = np.random.default_rng(seed)
    print('seed', seed)
    print(f'| wander of {arms} arms over {days} checks | arms with an alarm |\n|---|---|')
    for draw in (independent, remembering, seasonal):
        x = draw(rng, arms, days)
        ever = np.zeros(arms, bool)
        for day in range(3, days + 1):
            still = np.flatnonzero(~ever)
            ever[still] = alarms(x[still], day)
        print(f'| {draw.__name__} | {100.0 * ever.mean():.1f} % |', flush=True)
    print('\n| change, std of a check | after so many checks | checks until the alarm, median |')
    print('|---|---|---|')
    for size in (4.0, 5.0, 6.0, 8.0):
        for before in (20, 50):
            medians = []
            for joint in range(JOINTS):
                x = independent(rng, arms, before + AFTER)
                x[:, joint, before:] += size
                first = np.full(arms, AFTER + 1)
                for after in range(1, AFTER + 1):
                    first[alarms(x, before + after) & (first > AFTER)] = after
                medians.append(int(np.median(first)))
            print(f'| {size:g} | {before} | {", ".join(map(str, medians))} |', flush=True)


if __name__ == '__main__':
    main(*map(int, sys.argv[1:]))
