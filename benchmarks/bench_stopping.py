"""Ending a collection when enough is known: cover of the intervals, and false claims of looks.

*Cover.* Sessions of the demo cell's arm before one bar: 30 poses in two solutions each, one or
three markers, 0.1 mm of noise per reading and 0.2 mm common to a pose, offsets and markers drawn.
Each is looked at every 6 configurations and ends at the first look at which one of four goals,
drawn for it, is reached. Printed is how often the central 95 % interval at the end, the noise
integrated out, holds the offset that was drawn; tested against 95 % by a binomial test. Beside it
stands the cover after the configurations of the first look, of the sessions that end there and of
those that go on: what is different between them is whether the noise came out small.

*Frames.* The same with three markers in a frame that share a further 0.02 or 0.1 mm of noise.

*Levels.* As *cover*, but all noise of a session is 0.5 to 2 times as large, even in the logarithm.

*Claims.* Sessions with nothing wrong but offsets, looked at 12 times: how often any look claims
structure in the residuals, with the rule's error rate spent over the looks, and with 1 % at each;
*frame claims* the same with frames.

A look fits as `remaster_ros.collection.stopping_rule` does, but begins at the truth: the search
for a start and for gross errors, most of the time of a fit, would find nothing. `--whole 20`
compares, and times looks at three markers and up to 482 configurations.

    OMP_NUM_THREADS=1 python benchmarks/bench_stopping.py --out stopping.jsonl [--cover 5000] …

Begun again with the same file it goes on where it was.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import common  # noqa: F401  its folder of helpers
import numpy as np
from common import known, machine, progress, resumed, table
from designed_sessions import measured
from scipy.stats import binomtest, norm
from stopping_scene import POSES, SOLUTIONS, World, world

from remaster_ros.calibration.estimate import Estimate, Problem, estimate
from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.identifiability import find_gauge
from remaster_ros.calibration.laplace import find_mode
from remaster_ros.calibration.posterior import Posterior
from remaster_ros.calibration.precision import NoiseMixture
from remaster_ros.calibration.residual_structure import FAMILY_WISE_ERROR, residual_structure
from remaster_ros.collection.stopping_rule import Look, StoppingGoal, StoppingRule, so_far
from remaster_ros.planning.expected_sensors import nominal_model
from remaster_ros.session.workcell import read_cell
from remaster_ros.types import FloatArray, Priors, Session

LOOK_EVERY, TEST_EVERY = 6, 5
FRAME_NOISE = (0.02e-3, 0.1e-3)
LARGEST_LEVEL = 2.0
LARGE_PLAN, COUNTS = 220, (60, 173, 482)
KINDS = {'cover': 5000, 'frames': 5000, 'levels': 2000, 'claims': 1000, 'frame claims': 1000}
# Of a bundle of sessions, one line of the file.
BUNDLE = 50
INNER = slice(1, 6)


def quick_fit(session: Session, offsets: FloatArray, of: World) -> Estimate:
    """Return the mode from a start at the truth, nothing left out."""
    problem = Problem.of(session)
    model, x = nominal_model(of.chain, of.q, of.sensors, Priors())
    rows = Rows.of(problem.measurements, problem.fitted, model.reference)
    known_before = problem.marker_priors(model)
    x[: len(offsets)] = offsets
    gauge = find_gauge(model, x, rows, known_before)
    free = np.setdiff1d(np.arange(model.size), gauge.held)
    x[gauge.held] = 0.0
    priors = known_before + problem.plausibility(model, free)
    mode = find_mode(Posterior.of(model, rows, priors, free, model.pinned(x)))
    return Estimate(problem, model, gauge, mode, (), problem.fitted)


def drawn(kind: str, number: int) -> tuple[World, Session, FloatArray, np.random.Generator]:
    """Draw a session; without frames odd numbers have one marker, even ones three."""
    framed = kind in ('frames', 'frame claims')
    of = world(3, FRAME_NOISE[number % 2]) if framed else world(1 if number % 2 else 3)
    rng = np.random.default_rng([number, *kind.encode()])
    sensors = of.sensors
    if kind == 'levels':
        level = LARGEST_LEVEL ** rng.uniform(-1.0, 1.0)
        sensors = tuple(
            replace(one, sigma_m=level * one.sigma_m, pose_sigma_m=level * one.pose_sigma_m)
            for one in sensors
        )
    session, offsets = measured(of.chain, of.urdf, (of.q, of.pose), sensors, rng)
    return of, session, offsets, rng


def cover(kind: str, number: int) -> dict[str, Any]:
    """Return where a session ends, and where in the posterior each inner offset lies.

    At its end, and after the configurations of the first look.
    """
    of, session, offsets, rng = drawn(kind, number)
    goal = of.goals[int(rng.integers(len(of.goals)))]
    rule = StoppingRule(StoppingGoal(joint_std_rad=goal), len(of.q), LOOK_EVERY)
    look: Look | None = None
    first: FloatArray | None = None
    # With fewer configurations there are not enough poses to stop at.
    for count in [n for n in rule.counts if n >= SOLUTIONS * rule.floors.poses]:
        found = quick_fit(so_far(session, count)[0], offsets, of)
        look = rule.judge(found, count, look, 0.0, 0.0, rng)
        if first is None:
            first = below(found, offsets, rng)
        if rule.is_enough(look):
            break
    assert look is not None
    assert first is not None
    return {
        'markers': len(of.sensors[0].markers),
        'frame_sigma_m': of.sensors[0].frame_sigma_m,
        'ended': look.configurations,
        'enough': rule.is_enough(look),
        'below': below(found, offsets, rng).tolist(),
        'below_first': first.tolist(),
    }


def below(found: Estimate, offsets: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return how much of the posterior lies below each inner offset, the noise integrated out."""
    mixture = NoiseMixture.of(found.mode, rng)
    free = found.posterior.free.tolist()
    places = [free.index(joint) for joint in range(INNER.start, INNER.stop)]
    std = np.sqrt(np.diagonal(mixture.covariance, axis1=1, axis2=2))[:, places]
    result: FloatArray = mixture.weight @ norm.cdf(
        (offsets[INNER] - mixture.mean[:, places]) / std
    )
    return result


def claims(kind: str, number: int) -> dict[str, Any]:
    """Return whether looks claim structure, with the error rate spent and with all of it."""
    of, session, offsets, _ = drawn(kind, number)
    rule = StoppingRule(StoppingGoal(), len(of.q), TEST_EVERY)
    spent = naive = False
    for count in rule.counts:
        found = quick_fit(so_far(session, count)[0], offsets, of)
        tests = residual_structure(found.mode, found.problem.measurements).tests
        least = min((test.p_value for test in tests), default=1.0) * len(tests)
        spent |= bool(tests) and least < rule.limit(count)
        naive |= bool(tests) and least < FAMILY_WISE_ERROR
    return {'looks': len(rule.counts), 'spent': spent, 'naive': naive}


def bundle(task: tuple[str, tuple[str, int]]) -> dict[str, Any]:
    """Return the outcomes of some sessions as a line of the file."""
    name, (kind, first) = task
    one = claims if kind.endswith('claims') else cover
    return {
        'name': name,
        'kind': kind,
        'sessions': [one(kind, number) for number in range(first, first + BUNDLE)],
    }


def show_cover(sessions: list[dict[str, Any]]) -> None:
    """Print how many intervals hold what was drawn."""
    ends = sorted({s['ended'] for s in sessions})
    noises = sorted({s['frame_sigma_m'] for s in sessions})
    groups = {
        'all': sessions,
        'ended before the plan': [s for s in sessions if s['ended'] < POSES * SOLUTIONS],
        'not reached within the plan': [s for s in sessions if not s['enough']],
        **{
            f'{count} marker{"s" * (count > 1)}': [s for s in sessions if s['markers'] == count]
            for count in sorted({s['markers'] for s in sessions})
        },
        **{
            f'frames share {sigma * 1e3:g} mm': [
                s for s in sessions if s['frame_sigma_m'] == sigma
            ]
            for sigma in noises
            if len(noises) > 1
        },
        **{
            f'ended after {count}': [s for s in sessions if s['ended'] == count and s['enough']]
            for count in ends
        },
    }
    rows = [covered(words, members, 'below') for words, members in groups.items() if members]
    going_on = [s for s in sessions if s['ended'] > ends[0]]
    at_first = {f'all, after {ends[0]}': sessions, f'… of them going on after {ends[0]}': going_on}
    rows += [covered(words, members, 'below_first') for words, members in at_first.items()]
    joints = [f'joint {index + 1}' for index in range(INNER.start, INNER.stop)]
    print(table(['sessions', 'n', 'configurations', *joints, 'mean', 'least p'], rows))


def covered(words: str, members: list[dict[str, Any]], key: str) -> list[object]:
    """Return a row of the table, of some sessions."""
    shares = np.array([s[key] for s in members])
    inside = (shares > 0.025) & (shares < 0.975)
    p_values = [binomtest(int(n), len(shares), 0.95).pvalue for n in inside.sum(axis=0)]
    return [
        words,
        len(members),
        f'{np.mean([s["ended"] for s in members]):.1f}',
        *(f'{share:.4f}' for share in inside.mean(axis=0)),
        f'{inside.mean():.4f}',
        f'{min(p_values):.3f}',
    ]


def show_claims(sessions: list[dict[str, Any]]) -> None:
    """Print how many sessions with nothing wrong had a claim."""
    spent, naive = (sum(s[key] for s in sessions) for key in ('spent', 'naive'))
    looks, n = sessions[0]['looks'], len(sessions)
    print(f'\n{n} sessions with nothing wrong, {looks} looks each: structure claimed in {spent}')
    print(f'({spent / n:.2%}; with 1 % at each look in {naive}, {naive / n:.2%})')


def compare(count: int) -> None:
    """Print how far quick fits are from those of the rule, and what the latter take."""
    apart, seconds = [], []
    for number in range(count):
        of, session, offsets, _ = drawn('cover', number)
        quick = quick_fit(session, offsets, of).mode
        begun = time.process_time()
        whole = estimate(Problem.of(session))
        seconds.append(time.process_time() - begun)
        std = np.sqrt(np.diag(quick.covariance))[:5]
        apart.append(np.abs(whole.mode.z[INNER] - quick.z[INNER]) / std)
    print(
        f'{count} whole fits of {len(of.q)} configurations: {np.median(seconds):.3f} s of CPU '
        f'each, offsets within {np.max(apart):.4f} std of the quick ones'
    )


def show_looks(repeats: int = 5) -> None:
    """Print what the rule's looks take, of three markers in frames."""
    of = world(3, FRAME_NOISE[0])
    scene = read_cell('demo').planning_scene(of.chain)
    planned = scene.plan(LARGE_PLAN, scene.rough_R, np.random.default_rng(3)).poses
    q = np.concatenate([pose.solutions for pose in planned])
    pose = np.repeat(np.arange(len(planned)), [len(one.solutions) for one in planned])
    for count in COUNTS:
        rng = np.random.default_rng(count)
        session, _ = measured(of.chain, of.urdf, (q[:count], pose[:count]), of.sensors, rng)
        rule = StoppingRule(StoppingGoal(joint_std_rad=1e-9), count, count)
        spent = []
        for _ in range(repeats):
            begun = time.process_time(), time.perf_counter()
            look = rule.look(session, count, None, rng)
            spent.append((time.process_time() - begun[0], time.perf_counter() - begun[1]))
        cpu, wall = np.median(spent, axis=0)
        print(f'look at {look.configurations} configurations: {cpu:.3f} s of CPU, {wall:.2f} s')


def main() -> None:
    """Run what the file does not hold yet, and print."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('--out', type=Path, required=True, help='results so far, JSON lines')
    for kind, count in KINDS.items():
        parser.add_argument(f'--{kind.replace(" ", "-")}', type=int, default=count)
    parser.add_argument('--first', type=int, default=1000, help='seed of the first claims')
    parser.add_argument('--bundles', type=int, default=1000000, help='no more in this run')
    parser.add_argument('--jobs', type=int, default=1)
    parser.add_argument('--whole', type=int, default=0, help='whole fits to compare with')
    args = parser.parse_args()
    print(machine())
    if args.whole:
        compare(args.whole)
        show_looks()
    todo = {}
    for kind in KINDS:
        start = args.first if kind.endswith('claims') else 0
        count = getattr(args, kind.replace(' ', '_'))
        todo |= {f'{kind} {n}': (kind, n) for n in range(start, start + count, BUNDLE)}
    done = known(args.out)
    left = {name: task for name, task in todo.items() if name not in done}
    some = dict(list(left.items())[: args.bundles])
    for number, line in enumerate(resumed(args.out, some, bundle, args.jobs)):
        done[line['name']] = line
        progress(f'{number + 1} of {len(some)} bundles')
    for kind in KINDS:
        lines = [done[name] for name in todo if name in done and done[name]['kind'] == kind]
        sessions = [one for line in lines for one in line['sessions']]
        if sessions:
            print(f'\n*{kind}*\n')
            (show_claims if kind.endswith('claims') else show_cover)(sessions)


if __name__ == '__main__':
    main()
