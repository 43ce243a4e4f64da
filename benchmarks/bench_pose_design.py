"""Designed poses against the paper's Latin hypercube: configurations and robot time, one world.

For each arm 173 configurations of a Latin hypercube set the precision, the RMS of the standard
deviations of the identifiable joints; designs reach the same, held-out poses apart, with the
floors that a search for causes needs. Times are those of the bridge's trajectories on free ways,
with 3 s of standstill and 0.5 s of dwell, at `speed_share` 0.3, without a Cartesian limit and with
0.25 m/s (chosen anew). Simulated sessions are then fitted: the RMS error against the truth, and
how many of the 95 % intervals hold it.

For the first arm a second table has the same number of configurations from the same candidates by
criteria and algorithms of the literature (`design_methods`).

    OMP_NUM_THREADS=1 python benchmarks/bench_pose_design.py [--robots lwr4plus …] [--fits N]
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from common import machine, progress, table
from design_methods import compared
from designed_sessions import MARKER_STD, measured
from robot_descriptions import ur5e
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.stats import binomtest

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
LIMITS = (np.inf, 0.25)
START_DEG = (5.0, 7.0, 0.0, 112.0, 10.0, 35.0, -20.0)


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
    """Chosen configurations, with what they are expected to tell and what fits found."""

    name: str
    poses: tuple[PlannedPose, ...]
    sensors: tuple[ExpectedSensor, ...]
    information: DesignInformation
    chosen: tuple[int, ...]
    choice_s: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--robots', nargs='+', default=['lwr4plus', 'iiwa14', 'ur5e'])
    parser.add_argument('--fits', type=int, default=20)
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--count', type=int, default=30, help='of the second table; 0 for none')
    args = parser.parse_args()
    print(machine())
    for robot in args.robots:
        print(f'\n**{robot}**, seed {args.seed}\n')
        header = (
            'row', 'configurations', 'poses', 'nearest, s', 'fastest, s',
            '… at 0.25 m/s: configurations', 'nearest, s', 'fastest, s', 'expected RMS std, deg',
            f'RMS error of {args.fits} fits, deg', '95 % intervals that hold it', 'choice, s',
        )  # fmt: skip
        print(table(header, rows_of(robot, args.fits, args.seed)), flush=True)
    if not args.count:
        return
    print(f'\n**{args.robots[0]}, one bar, four markers, 100 candidate poses: criteria**\n')
    bar = stage(args.robots[0], 'mocap', args.seed)
    information = DesignInformation.of(
        bar.scene.model.chain, bar.pool[:100], (expected_bar(bar, 4),), MARKER_STD
    )
    travel = TravelTime.of(bar.scene.model)
    print(compared(information, travel, args.count, np.random.default_rng(args.seed)))


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
    """Return poses of one Latin hypercube, 173 configurations in all."""
    for count in range(30, 400, 5):
        plan = scene.plan(count, scene.rough_R, np.random.default_rng([seed, 1]))
        poses = connected(scene, plan.poses)
        if sum(len(pose.solutions) for pose in poses) >= PAPER:
            break
    kept, left = [], PAPER
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


def rows_of(robot: str, fits: int, seed: int) -> list[tuple[object, ...]]:
    """Return the table of an arm."""
    both, bar = stage(robot, None, seed), stage(robot, 'mocap', seed)
    two = tuple(
        ExpectedSensor(s.sensor, s.sensor_R, {s.marker: s.marker_T}) for s in both.scene.sights
    )
    one = (expected_bar(bar, 1),)
    jobs = [
        ('two sensors: Latin hypercube', both, two, two),
        ('two sensors: A-optimal', both, two, None),
        ('one bar, one marker: Latin hypercube', bar, one, one),
        ('Latin hypercube, four markers', bar, (expected_bar(bar, 4),), 'needed'),
        ('A-optimal, one marker', bar, one, None),
        ('A-optimal, three markers', bar, (expected_bar(bar, 3),), None),
        ('A-optimal, four markers, one out of plane', bar, (expected_bar(bar, 4),), None),
    ]
    goal, lines = 0.0, []
    for name, where, sensors, reference in jobs:
        progress(f'{robot}: {name}')
        results = []
        for limit in LIMITS:
            travel = TravelTime.of(where.scene.model, tool_speed=limit)
            wanted = None if reference == sensors else goal
            row = chosen(name, where, sensors, travel, wanted, seed, prefix=reference == 'needed')
            if reference == sensors:
                goal = row.information.joint_rms(row.chosen)
            results.append((row, times(where, row, travel)))
        (row, free), (slow, limited) = results
        rms, held, intervals = fitted(where, row, fits, np.random.default_rng([seed, 3]))
        p = binomtest(held, intervals, 0.95).pvalue if intervals else 1.0
        lines.append(
            (
                name,
                len(row.chosen),
                len(np.unique(row.information.pose[list(row.chosen)])),
                free[0],
                free[1],
                len(slow.chosen),
                limited[0],
                limited[1],
                f'{np.degrees(row.information.joint_rms(row.chosen)):.5f}',
                f'{np.degrees(rms):.5f}',
                f'{held} of {intervals} (p {p:.2f})',
                f'{row.choice_s:.1f}',
            )
        )
    return lines


def chosen(
    name: str,
    where: Stage,
    sensors: tuple[ExpectedSensor, ...],
    travel: TravelTime,
    goal: float | None,
    seed: int,
    *,
    prefix: bool = False,
) -> Row:
    """Choose the configurations of a row; all of the Latin hypercube without a goal.

    With `prefix` as many of the Latin hypercube as reach the goal.
    """
    poses = where.lhs if goal is None or prefix else (*where.lhs, *where.pool)
    chain = where.scene.model.chain
    information = DesignInformation.of(chain, poses, sensors, MARKER_STD)
    if goal is None:
        return Row(name, poses, sensors, information, tuple(range(PAPER)), 0.0)
    if goal is not None and prefix:
        enough = (n for n in range(1, PAPER + 1) if information.joint_rms(range(n)) <= goal)
        return Row(name, poses, sensors, information, tuple(range(next(enough))), 0.0)
    started = time.process_time()
    among = information.only(np.arange(min(len(information), MOST_CANDIDATES)))
    design = choose(among, travel, Goal(goal, 1.0), np.random.default_rng([seed, 4]))
    assert design.reached, name
    return Row(name, poses, sensors, information, design.chosen, time.process_time() - started)


def times(where: Stage, row: Row, travel: TravelTime) -> tuple[str, str]:
    """Return the robot's time in both orders, s, on free ways."""
    chain, model = where.scene.model.chain, where.scene.model
    which = np.array(row.chosen)
    pose = row.information.pose[which]
    plan = Plan(
        tuple(
            PlannedPose(row.poses[i].T_R_T, row.information.q[which[pose == i]])
            for i in np.unique(pose)
        )
    )
    plans = {'optimization': plan}
    found = []
    for order in ((), visit_order(plans, model, travel)):
        tour = Tour(chain, plans, model=model, order=order)
        here = np.deg2rad(START_DEG)[: len(chain)]
        if len(chain) == 6:
            here = row.information.q[which[0]]
        spent, visited = 0.0, 0
        while (stop := tour.next(here)) is not None:
            for q, way in zip(stop.solutions, stop.paths, strict=True):
                spent += travel.along(np.vstack((here, way, q))) + travel.measuring_s
                here, visited = q, visited + 1
        lost = len(row.chosen) - visited
        found.append(f'{spent:.0f}' + f' ({lost} without a way)' * bool(lost))
    return found[0], found[1]


def fitted(where: Stage, row: Row, fits: int, rng: np.random.Generator) -> tuple[float, int, int]:
    """Return the RMS error of the identifiable joints, rad, and how many intervals hold them."""
    joints = sorted(row.information.identifiable)
    errors, held = [], 0
    which = np.array(row.chosen)
    configurations = row.information.q[which], row.information.pose[which]
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
