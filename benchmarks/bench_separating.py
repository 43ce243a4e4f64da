"""Are look-alikes decided once the configurations that separate them are measured?

A hidden cause of the demo cell's arm before one bar with one marker, 0.1 mm of noise per reading
and 0.2 mm common to a pose: one of a pair of look-alikes, of a size that the plan's own
configurations tell from the other by 2 to 4 standard deviations. The session is searched; the
causes that it finds and their look-alikes go into the plan of the next session, which is measured
anew and searched. Printed is how often each search names the hidden cause alone, leaves it open,
finds nothing, or names others. Displacements are those of `remaster_ros.discovery.effects`, at
first order.

    OMP_NUM_THREADS=1 python benchmarks/bench_separating.py --out separating.jsonl [--sessions 20]

Begun again with the same file it goes on where it was.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import common  # noqa: F401  its folder of helpers
import numpy as np
from common import known, machine, progress, resumed, table
from designed_sessions import measured

from remaster_ros.discovery.discover import Discovery, discover_session
from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.planning.candidates import PlannedPose
from remaster_ros.planning.design_information import nominal_context
from remaster_ros.planning.expected_sensors import (
    ExpectedSensor,
    expected_measurements,
    nominal_model,
)
from remaster_ros.planning.separating_design import FoundCause, further_scene, separate
from remaster_ros.session.workcell import read_cell
from remaster_ros.types import FloatArray, Priors, Session

# Each way round.
PAIRS = (
    (('joint_compliance', (2,)), ('encoder_eccentricity', (2,))),
    (('joint_compliance', (2,)), ('base_compliance', ())),
    (('encoder_scale', (6,)), ('encoder_eccentricity', (6,))),
)
POSES, CANDIDATES = 60, 400
BAR = ExpectedSensor('mocap', np.array([1.9, 0, 1.3]), {'sir': np.array([0.1, 0.0, 0.0])})
Name = tuple[str, tuple[int, ...]]


def session_of(poses: list[PlannedPose], hidden: FoundCause, rng: np.random.Generator) -> Session:
    """Return a session of an arm with a hidden cause; every fourth pose is held out."""
    cell = read_cell('demo')
    chain = cell.chain()
    q = np.concatenate([pose.solutions for pose in poses])
    pose = np.repeat(np.arange(len(poses)), [len(one.solutions) for one in poses])
    session, _ = measured(chain, cell.urdf_text, (q, pose), [BAR], rng)
    model, x = nominal_model(chain, q, [BAR], Priors())
    rows = expected_measurements(model, q, pose, [BAR])
    context = nominal_context(model, x, rows)
    found = cell_of(context, (hidden.name, hidden.joints), tuple(hidden.sizes))
    shift = found.columns(context).displacement(context) @ np.array(list(hidden.sizes.values()))
    turn = model.reference[0, :3, :3]
    given = session.measurements
    moved = replace(
        given, position=given.position + shift @ turn, is_validation=pose % 4 == 3, from_q=given.q
    )
    return replace(session, measurements=moved, timed=False)


def cell_of(context: Any, name: Name, parameters: tuple[str, ...] | None = None) -> Cell:
    """Return the cell of an effect with these parameters, or its simplest one."""
    cells = [one for one in EFFECTS[name[0]].cells(context) if one.joints == name[1]]
    if parameters is not None:
        cells = [one for one in cells if one.parameters == parameters]
    return min(cells, key=lambda one: one.size)


def hidden_cause(true: Name, other: Name, poses: list[PlannedPose], apart: float) -> FoundCause:
    """Return a cause that these poses tell from another by so many standard deviations."""
    chain = read_cell('demo').chain()
    q = np.concatenate([pose.solutions for pose in poses])
    model, x = nominal_model(chain, q, [BAR], Priors())
    rows = expected_measurements(model, q, np.arange(len(q)), [BAR])
    context = nominal_context(model, x, rows)
    found = cell_of(context, true)
    unit = 1.0 / _rms(found.columns(context).displacement(context))
    sizes = dict(zip(found.parameters, 1e-3 * unit, strict=True))
    cause = FoundCause(*true, sizes, ((*other, ''),))
    (pair,) = separate(chain, poses, [], [BAR], 0.5e-3, [cause], Priors()).pairs
    factor = apart / pair.before
    return replace(cause, sizes={key: factor * value for key, value in sizes.items()})


def _rms(shift: FloatArray) -> FloatArray:
    rms: FloatArray = np.sqrt(np.mean(np.sum(shift**2, axis=1), axis=0))
    return rms


def verdict(found: Discovery, true: FoundCause) -> str:
    """Return whether a search is right, wrong, open, or finds nothing."""
    if not found.effects:
        return 'none'
    if found.verdict == 'undetermined':
        return 'open'
    right = [(effect.name, effect.joints) for effect in found.effects] == [
        (true.name, true.joints)
    ]
    return 'right' if right else 'wrong'


def causes_of(found: Discovery) -> list[FoundCause]:
    """Return causes and look-alikes as `remaster plan --separate` reads them."""
    return [
        FoundCause(
            effect.name,
            tuple(effect.joints),
            {one.name: one.value for one in effect.parameters},
            tuple((o.name, tuple(o.joints), o.separate_by) for o in effect.confusable_with),
        )
        for effect in found.effects
        if effect.confusable_with
    ]


def one(task: tuple[str, int]) -> dict[str, Any]:
    """Search a session, and the next one with what separates."""
    name, number = task
    first, second = PAIRS[number % len(PAIRS)]
    true, other = (first, second) if number // len(PAIRS) % 2 == 0 else (second, first)
    rng = np.random.default_rng([number, 7])
    scene = read_cell('demo').planning_scene(read_cell('demo').chain())
    planned = list(scene.plan(POSES, scene.rough_R, np.random.default_rng(0)).poses)
    hidden = hidden_cause(true, other, planned, float(rng.uniform(2.0, 4.0)))
    before = discover_session(session_of(planned, hidden, rng), rng=rng)
    causes = causes_of(before)
    line = {'name': name, 'true': true[0], 'other': other[0], 'before': verdict(before, hidden)}
    if not causes:
        return {**line, 'added': 0}
    pool = further_scene(scene).plan(CANDIDATES, scene.rough_R, rng).poses
    design = separate(scene.model.chain, planned, pool, [BAR], 0.5e-3, causes, Priors())
    after = discover_session(session_of([*planned, *design.poses], hidden, rng), rng=rng)
    again = discover_session(session_of(planned, hidden, rng), rng=rng)
    return {
        **line,
        'added': sum(len(pose.solutions) for pose in design.poses),
        'after': verdict(after, hidden),
        'again': verdict(again, hidden),
    }


def main() -> None:
    """Run what the file does not hold yet, and print."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('--out', type=Path, required=True, help='results so far, JSON lines')
    parser.add_argument('--sessions', type=int, default=20)
    parser.add_argument('--jobs', type=int, default=1)
    args = parser.parse_args()
    print(machine())
    todo = {f'session {number}': number for number in range(args.sessions)}
    done = known(args.out)
    left = {name: number for name, number in todo.items() if name not in done}
    for count, line in enumerate(resumed(args.out, left, one, args.jobs)):
        done[line['name']] = line
        progress(f'{count + 1} of {len(left)} sessions')
    lines = [done[name] for name in todo if name in done]
    rows = []
    for first, second in [*((a[0], b[0]) for a, b in PAIRS), ('', '')]:
        mine = [s for s in lines if not first or {s['true'], s['other']} == {first, second}]
        counts = [
            ' '.join(
                str(sum(s.get(key) == w for s in mine)) for w in ('right', 'open', 'none', 'wrong')
            )
            for key in ('before', 'again', 'after')
        ]
        added = [s['added'] for s in mine]
        rows.append([f'{first} / {second}' if first else 'all', len(mine), *counts, max(added)])
    header = ['pair', 'sessions', 'plan', 'plan, once more', 'plan and what separates', 'added']
    print('right, open, none, wrong:\n')
    print(table(header, rows))


if __name__ == '__main__':
    main()
