"""Designed poses against the paper's Latin hypercube: configurations and robot time, one world.

For each arm 173 configurations of a Latin hypercube set the precision, the RMS of the standard
deviations of the identifiable joints; designs reach the same, held-out poses apart, with the
floors that a search for causes needs. Times are those of the bridge's trajectories on free ways,
with 3 s of standstill and 0.5 s of dwell, at `speed_share` 0.3, without a Cartesian limit and with
0.25 m/s (chosen anew). What no free way leads to in the order of least travel is replaced, by the
next ones of the Latin hypercube or by another choice; "without a way" counts what is left of that.
Simulated sessions are then fitted: the RMS error against the truth, and how many of the 95 %
intervals hold it.

For the first arm a second table has the same number of configurations from the same candidates by
criteria and algorithms of the literature (`design_methods`).

    OMP_NUM_THREADS=1 python benchmarks/bench_pose_design.py --out poses.jsonl [--robots ur5e …]

Begun again with the same file it goes on where it was, row by row.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from common import known, machine, progress
from design_methods import compared
from design_tables import share_held, side_by_side, table_of
from designed_sessions import MARKER_STD, measured
from robot_descriptions import ur5e
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from remaster_ros.calibration.estimate import Problem, estimate
from remaster_ros.kinematics.free_paths import is_straight_free
from remaster_ros.planning.candidates import LineOfSight, Plan, PlannedPose, PlanningScene
from remaster_ros.planning.design_information import DesignInformation
from remaster_ros.planning.expected_sensors import ExpectedSensor
from remaster_ros.planning.planned_design import MOST_CANDIDATES, POOL_CANDIDATES, visit_order
from remaster_ros.planning.pose_design import Goal, choose
from remaster_ros.planning.tour_order import Tour
from remaster_ros.planning.travel_time import TravelTime
from remaster_ros.session.workcell import Workcell, read_cell
from remaster_ros.simulation.simulated_workcell import choose_robot
from remaster_ros.types import FloatArray, IntArray

PAPER = 173
"""Configurations of the paper's session."""
MARKERS = {
    'sir': (0.1, 0.0, 0.0),
    'second': (-0.1, 0.0, 0.0),
    'third': (0.0, 0.1, 0.0),
    'out_of_plane': (0.0, 0.0, 0.06),
}
UR_RADIUS = 0.05
NEIGHBOURS = 8
SPARE = 1.6
"""So many times 173 configurations are drawn for the UR5e: not all can be reached."""
TRIES = 12
LIMITS = (np.inf, 0.25)
START_DEG = (5.0, 7.0, 0.0, 112.0, 10.0, 35.0, -20.0)
Walk = tuple[tuple[int, ...], tuple[tuple[str, int, int], ...]]
"""What is visited, and in which order."""
TWO, LATIN, DESIGNED = (
    'two sensors: Latin hypercube',
    'one bar, one marker: Latin hypercube',
    'A-optimal, four markers, one out of plane',
)
# Row -> how many markers the bar sees (None: both sensors see one each), and whose precision is
# reached: None where the row sets it.
ROWS: dict[str, tuple[int | None, str | None]] = {
    TWO: (None, None),
    'two sensors: A-optimal': (None, TWO),
    LATIN: (1, None),
    'Latin hypercube, four markers': (4, LATIN),
    'A-optimal, one marker': (1, LATIN),
    'A-optimal, three markers': (3, LATIN),
    DESIGNED: (4, LATIN),
}


class Case(NamedTuple):
    """An arm, the seed of its poses, and the noise that the markers of a frame share, mm."""

    robot: str
    seed: int
    frame_noise_mm: float

    def line_name(self, row: str) -> str:
        """Return the name of a row in the results file."""
        framed = f' frames {self.frame_noise_mm:g}' * (self.frame_noise_mm > 0.0)
        return f'{self.robot} {self.seed}{framed} {row}'


@dataclass(frozen=True, eq=False)
class Stage:
    """An arm before its sensors, and the poses that it can be measured at.

    `lhs` is a Latin hypercube cut after 173 configurations; `pool` has further candidates.
    """

    cell: Workcell
    scene: PlanningScene
    lhs: tuple[PlannedPose, ...]
    pool: tuple[PlannedPose, ...]


@dataclass(frozen=True, eq=False)
class Row:
    """Configurations to choose from, what is expected of them, and those that were chosen."""

    poses: tuple[PlannedPose, ...]
    sensors: tuple[ExpectedSensor, ...]
    information: DesignInformation
    chosen: IntArray


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--out', type=Path, required=True, help='results so far, JSON lines')
    parser.add_argument('--robots', nargs='+', default=['lwr4plus', 'iiwa14', 'ur5e'])
    parser.add_argument('--seeds', nargs='+', type=int, default=[0])
    parser.add_argument(
        '--rows', choices=['all', 'main'], default='all', help='main: one marker against four'
    )
    parser.add_argument('--fits', type=int, default=20)
    parser.add_argument(
        '--frame-noise', type=float, default=0.0, help='that the markers of a frame share, mm'
    )
    parser.add_argument('--count', type=int, default=30, help='of the second table; 0 for none')
    args = parser.parse_args()
    print(machine())
    wanted = list(ROWS) if args.rows == 'all' else [LATIN, DESIGNED]
    done = known(args.out)
    cases = [Case(robot, seed, args.frame_noise) for robot in args.robots for seed in args.seeds]
    for case in cases:
        for name in wanted:
            if case.line_name(name) not in done:
                progress(case.line_name(name))
                line = measured_row(case, name, args.fits, done)
                done[line['name']] = line
                with args.out.open('a', encoding='utf-8') as file:
                    file.write(json.dumps(line) + '\n')
    for case in cases if args.rows == 'all' else ():
        print(f'\n**{case.robot}**, seed {case.seed}\n')
        print(table_of([done[case.line_name(name)] for name in wanted]))
    print('\n**One marker, Latin hypercube, against four markers, A-optimal**\n')
    lines = {
        (case.robot, case.seed): [done[case.line_name(name)] for name in (LATIN, DESIGNED)]
        for case in cases
    }
    print(side_by_side(lines, LIMITS))
    for name, place in ((LATIN, 0), (DESIGNED, 1)):
        held = sum(pair[place]['held'] for pair in lines.values())
        intervals = sum(pair[place]['intervals'] for pair in lines.values())
        print(f'\n{name}: {share_held(held, intervals)} of the 95 % intervals hold the truth')
    if not args.count:
        return
    print(f'\n**{args.robots[0]}, one bar, four markers, 100 candidate poses: criteria**\n')
    bar = stage(args.robots[0], 'mocap', args.seeds[0])
    information = DesignInformation.of(
        bar.scene.model.chain, bar.pool[:100], (expected_bar(bar, 4),), MARKER_STD
    )
    travel = TravelTime.of(bar.scene.model)
    print(compared(information, travel, args.count, np.random.default_rng(args.seeds[0])))


@lru_cache(maxsize=2)
def stage(robot: str, only: str | None, seed: int) -> Stage:
    """Put an arm before both sensors, or one; the bar sees all four markers."""
    cell = read_cell('demo')
    cell.markers = {**MARKERS, **cell.markers}
    if robot == 'ur5e':
        found = ur5e()
        # Its links are thinner than those of the KUKAs; its URDF here has no collision geometry.
        cell.link_radius_m = UR_RADIUS
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / 'ur5e.urdf'
            path.write_text(found.urdf, encoding='utf-8')
            chain = choose_robot(cell, str(path), found.base_link, found.tip_link)
    else:
        chain = choose_robot(cell, robot)
    scene = cell.planning_scene(chain, without_meshes=True)
    if only is not None:
        (sight,) = [sight for sight in scene.sights if sight.sensor == only]
        sights = [replace(sight, marker=m, marker_T=np.array(MARKERS[m])) for m in MARKERS]
        scene = replace(scene, sights=sights, aim_at=only)
    return Stage(cell, scene, latin_hypercube(scene, seed), more(scene, seed))


def latin_hypercube(scene: PlanningScene, seed: int) -> tuple[PlannedPose, ...]:
    """Return poses of one Latin hypercube, 173 configurations in all, or some more."""
    spare = len(scene.model.chain) <= 6
    wanted = int(SPARE * PAPER) if spare else PAPER
    for count in range(30, 400, 20 if spare else 5):
        plan = scene.plan(count, scene.rough_R, np.random.default_rng([seed, 1]))
        poses = connected(scene, plan.poses)
        if sum(len(pose.solutions) for pose in poses) >= wanted:
            break
    kept, left = [], wanted
    for pose in poses:
        if left > 0:
            kept.append(PlannedPose(pose.T_R_T, pose.solutions[:left]))
            left -= len(kept[-1].solutions)
    return tuple(kept)


def more(scene: PlanningScene, seed: int) -> tuple[PlannedPose, ...]:
    """Return the further candidates of a design."""
    plan = scene.plan(POOL_CANDIDATES, scene.rough_R, np.random.default_rng([seed, 2]))
    return connected(scene, plan.poses)


def connected(scene: PlanningScene, poses: Sequence[PlannedPose]) -> tuple[PlannedPose, ...]:
    """Keep the solutions in the largest group that free straight ways to neighbours connect.

    For the UR5e: a fifth of its solutions cannot be reached from most others.
    """
    if len(scene.model.chain) > 6:
        return tuple(poses)
    q = np.concatenate([pose.solutions for pose in poses])
    near = np.argsort(np.max(np.abs(q[:, None] - q[None]), axis=-1), axis=1)[:, 1 : NEIGHBOURS + 1]
    links = {(min(i, j), max(i, j)) for i in range(len(q)) for j in near[i].tolist()}
    free = [link for link in links if is_straight_free(scene.model, *q[list(link)])]
    rows, columns = np.array(free).T
    graph = coo_array((np.ones(len(free)), (rows, columns)), shape=(len(q), len(q)))
    label = connected_components(graph, directed=False)[1]
    mine = label == np.argmax(np.bincount(label))
    edges = np.cumsum([len(pose.solutions) for pose in poses])[:-1]
    kept = [(pose, part) for pose, part in zip(poses, np.split(mine, edges)) if part.any()]
    return tuple(PlannedPose(pose.T_R_T, pose.solutions[part]) for pose, part in kept)


def expected_bar(found: Stage, markers: int) -> ExpectedSensor:
    sight: LineOfSight = found.scene.sights[0]
    places = {name: np.array(MARKERS[name]) for name in list(MARKERS)[:markers]}
    return ExpectedSensor('mocap', sight.sensor_R, places)


def measured_row(
    case: Case, name: str, fits: int, done: dict[str, dict[str, Any]]
) -> dict[str, Any]:
    """Return a row of an arm's table as a line of the results file."""
    markers, reference = ROWS[name]
    seed = case.seed
    where = stage(case.robot, None if markers is None else 'mocap', seed)
    sensors = tuple(
        ExpectedSensor(s.sensor, s.sensor_R, {s.marker: s.marker_T}) for s in where.scene.sights
    )
    if markers is not None:
        sensors = (expected_bar(where, markers),)
    frame_sigma_m = 1e-3 * case.frame_noise_mm
    sensors = tuple(replace(sensor, frame_sigma_m=frame_sigma_m) for sensor in sensors)
    goal = None
    if reference is not None:
        before = done[case.line_name(reference)]
        goal = float(np.radians(before['limits'][0]['joint_rms_deg']))
    designed = reference is not None and not name.startswith('Latin')
    poses = (*where.lhs, *where.pool) if designed else where.lhs
    chain = where.scene.model.chain
    information = DesignInformation.of(chain, poses, sensors, MARKER_STD)
    limits, choices, rows = [], [], []
    walks: dict[Walk, tuple[list[FloatArray], list[int]]] = {}
    for limit in LIMITS:
        travel = TravelTime.of(where.scene.model, tool_speed=limit)
        left = np.arange(min(len(information), MOST_CANDIDATES))
        for _ in range(TRIES):
            started = time.process_time()
            rng = np.random.default_rng([seed, 4])
            chosen = choice(information.only(left), travel, goal, rng, designed=designed)
            choices.append(time.process_time() - started)
            row = Row(poses, sensors, information, left[chosen])
            fastest_s, lost = tour(where, row, travel, walks, in_order=True)
            if not lost:
                break
            left = np.setdiff1d(left, lost)
        nearest_s, not_nearest = tour(where, row, travel, walks, in_order=False)
        rows.append(row)
        limits.append(
            {
                'configurations': len(row.chosen),
                'poses': len(np.unique(information.pose[row.chosen])),
                'joint_rms_deg': float(np.degrees(information.joint_rms(row.chosen.tolist()))),
                'nearest_s': nearest_s,
                'nearest_lost': len(not_nearest),
                'fastest_s': fastest_s,
                'fastest_lost': len(lost),
            }
        )
    rms, held, intervals = fitted(where, rows[0], fits, np.random.default_rng([seed, 3]))
    return {
        'name': case.line_name(name),
        'row': name,
        'limits': limits,
        'rms_error_deg': float(np.degrees(rms)),
        'held': held,
        'intervals': intervals,
        'choice_s': choices[0],
    }


def choice(
    information: DesignInformation,
    travel: TravelTime,
    goal: float | None,
    rng: np.random.Generator,
    *,
    designed: bool,
) -> IntArray:
    """Choose the configurations of a row.

    Without a goal the first 173; without a design as many of the first as reach the goal.
    """
    if goal is None:
        return np.arange(min(PAPER, len(information)))
    if designed:
        design = choose(information, travel, Goal(goal, 1.0), rng, whole_poses=False)
        assert design.reached
        return np.array(design.chosen, dtype=np.int64)
    count = np.arange(1, len(information) + 1)
    return np.arange(next(n for n in count if information.joint_rms(range(n)) <= goal))


def tour(
    where: Stage,
    row: Row,
    travel: TravelTime,
    walks: dict[Walk, tuple[list[FloatArray], list[int]]],
    *,
    in_order: bool,
) -> tuple[float, list[int]]:
    """Return the robot's time on free ways, s, and what was not reached.

    In the order of least travel with ``in_order``, else as the nodes do by default. A walk that
    was made already is only timed.
    """
    chain, model = where.scene.model.chain, where.scene.model
    pose = row.information.pose[row.chosen]
    members = [row.chosen[pose == index] for index in np.unique(pose)]
    plan = Plan(
        tuple(
            PlannedPose(row.poses[row.information.pose[own[0]]].T_R_T, row.information.q[own])
            for own in members
        )
    )
    plans = {'optimization': plan}
    order = tuple(visit_order(plans, model, travel, whole_poses=False)) if in_order else ()
    walk = tuple(row.chosen.tolist()), order
    if walk not in walks:
        legs, lost = walks[walk] = [], []
        walked = Tour(chain, plans, model=model, order=order)
        here = np.deg2rad(START_DEG)[: len(chain)]
        if len(chain) == 6:
            here = row.information.q[row.chosen[0]]
        while (stop := walked.next(here)) is not None:
            lost += [int(members[stop.index][number]) for number in stop.unreached]
            for q, way in zip(stop.solutions, stop.paths, strict=True):
                legs.append(np.vstack((here, way, q)))
                here = q
    legs, lost = walks[walk]
    return sum(travel.along(leg) + travel.measuring_s for leg in legs), lost


def fitted(where: Stage, row: Row, fits: int, rng: np.random.Generator) -> tuple[float, int, int]:
    """Return the RMS error of the identifiable joints, rad, and how many intervals hold them."""
    joints = sorted(row.information.identifiable)
    errors, held = [], 0
    configurations = row.information.q[row.chosen], row.information.pose[row.chosen]
    for _ in range(fits):
        session, offsets = measured(
            where.scene.model.chain, where.cell.urdf_text, configurations, row.sensors, rng
        )
        found = estimate(Problem.of(session))
        free = found.posterior.free.tolist()
        std = np.sqrt(np.diag(found.mode.covariance))[[free.index(joint) for joint in joints]]
        error = found.model.natural(found.mode.z)[joints] - offsets[joints]
        errors.append(error)
        held += int(np.sum(np.abs(error) < 1.96 * std))
    return float(np.sqrt(np.mean(np.square(errors)))), held, fits * len(joints)


if __name__ == '__main__':
    main()
