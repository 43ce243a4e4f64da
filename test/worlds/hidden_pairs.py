# SPDX-License-Identifier: Apache-2.0
"""Pairs of look-alikes in the hidden world: an arm is measured, and measured further.

The cell is the demo's with the bar alone, and configurations come from the package's planning, as
in a real cell. What is measured there is that of `HiddenWorld`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from judges.hidden_effects import judge
from judges.hidden_oracle import Oracle
from worlds.hidden_sessions import NOISES
from worlds.hidden_tours import REPEATABILITY_RAD, facing_sensor
from worlds.hidden_world import MARKER_STD_M, HiddenTruth, HiddenWorld, Visits

from remaster_ros.discovery.discover import Discovery
from remaster_ros.planning.candidates import PlanningScene
from remaster_ros.planning.expected_sensors import ExpectedSensor
from remaster_ros.planning.planned_design import POOL_CANDIDATES
from remaster_ros.planning.rival_causes import FoundCause
from remaster_ros.planning.separating_design import (
    SeparatingDesign,
    measured_so_far,
    scene_with_other_elbows,
    separate,
)
from remaster_ros.planning.tour_planner import TourPlanner
from remaster_ros.session.cells.workcell import read_cell
from remaster_ros.simulation.effect_sampling import draw_effect
from remaster_ros.simulation.hidden_effect import HiddenEffect
from remaster_ros.simulation.world_model import Round
from remaster_ros.types import Priors, Session

Name = tuple[str, tuple[int, ...]]
PAIRS: tuple[tuple[Name, Name], ...] = (
    (('joint_compliance', (2,)), ('encoder_eccentricity', (2,))),
    (('joint_compliance', (2,)), ('base_compliance', ())),
    (('link_length', (3,)), ('link_length', (4,))),
    (('encoder_scale', (6,)), ('encoder_eccentricity', (6,))),
    (('backlash', (4,)), ('settling', (4,))),
    (('registration_drift', ()), ('thermal_growth', ())),
)
MULTIPLES = 2.0, 8.0
"""Sizes, as multiples of the one at which the best possible test finds the effect in 90 %."""
CANDIDATES = 60
"""Of each split, as the planner has it by default."""
BAR = ExpectedSensor('mocap', np.array([1.9, 0, 1.3]), {'sir': np.array([0.1, 0.0, 0.0])})
# A break between the two, and how fast the arm cools and warms, s.
BREAK_S = 120.0, 600.0
COOLING_S = 2500.0
TURN_S = 10.0, 13.0


@dataclass(frozen=True, eq=False)
class PairSession:
    """An arm with one of a pair of look-alikes, measured by an ordinary plan.

    Attributes
    ----------
    number
        Which of `PAIRS`.
    true, other
        Which is hidden, and its look-alike.
    multiple
        Its size, see `MULTIPLES`.
    session, world, truth
        As of `hidden_sessions.HiddenSession`.
    noise
        Of `hidden_sessions.NOISES`.
    rng
        Draws what is measured further.
    """

    number: int
    true: Name
    other: Name
    multiple: float
    session: Session
    world: HiddenWorld
    truth: HiddenTruth
    noise: str
    rng: np.random.Generator


@cache
def scene() -> PlanningScene:
    """Return the demo cell with its bar alone."""
    cell = read_cell('demo')
    cell_scene = cell.planning_scene(cell.chain())
    sights = [sight for sight in cell_scene.sights if sight.sensor == 'mocap']
    return replace(cell_scene, sights=sights, aim_at='mocap')


@cache
def planned(seed: int) -> Visits:
    """Return the tour of an ordinary plan, as visited."""
    counts = {'optimization': CANDIDATES, 'validation': CANDIDATES}
    planner = TourPlanner(scene(), counts, seed)
    tour = planner.collection(planner.rough_places)
    home = np.full(len(scene().model.chain), 0.1)
    rng = np.random.default_rng([seed, 1])
    q, pose, held_out, here = [], [], [], home
    while (stop := tour.next(here)) is not None:
        q.append(stop.solutions)
        pose += [stop.pose] * len(stop.solutions)
        held_out += [stop.split == 'validation'] * len(stop.solutions)
        here = stop.solutions[-1]
    reached = np.concatenate(q)
    reached = reached + REPEATABILITY_RAD * rng.standard_normal(reached.shape)
    return Visits(reached, np.array(pose), np.array(held_out), home)


def pair_session(number: int) -> PairSession:
    """Return a session; the same number gives the same one, and all pairs take turns."""
    first, second = PAIRS[number % len(PAIRS)]
    true, other = (first, second) if number // len(PAIRS) % 2 == 0 else (second, first)
    rng = np.random.default_rng([number, 13])
    cell = read_cell('demo')
    visits = planned(int(rng.integers(8)))
    origin = np.array(cell.sensors['mocap'].rough_position_m) + 0.05 * rng.standard_normal(3)
    sensors = {'mocap': facing_sensor('sir', origin, rng)}
    markers = {'sir': np.array(cell.markers['sir'])}
    world = HiddenWorld(cell.urdf_text, visits, sensors, markers, rng, cell.marker_std_m)
    noise = ('independent', 'pose_common')[int(rng.integers(2))]
    _, plain = world.measure((), NOISES[noise], np.random.default_rng(0))
    multiple = float(np.exp(rng.uniform(*np.log(MULTIPLES))))
    effect = _drawn(world, true, rng)
    size_m = world.size_m(effect) * Oracle(world, plain).size_for_power(effect)
    effect = world.of_size(effect, multiple * size_m)
    session, truth = world.measure((effect,), NOISES[noise], rng)
    return PairSession(
        number % len(PAIRS), true, other, multiple, session, world, truth, noise, rng
    )


def _drawn(world: HiddenWorld, name: Name, rng: np.random.Generator) -> HiddenEffect:
    """Draw an effect of this name at these joints."""
    kind, joints = name
    if kind == 'link_length':
        return HiddenEffect(kind, joints, np.array([rng.choice((-1e-3, 1e-3))]))
    if kind == 'joint_compliance':
        # Those of one joint alone.
        return HiddenEffect(kind, joints, np.array([1e-4]))
    return draw_effect(world, kind, rng, 0.2e-3, joints[0] if joints else None)


def measured_further(
    pair: PairSession, further: Visits
) -> tuple[Session, HiddenWorld, HiddenTruth]:
    """Return the session with what is measured further at its end, in one world.

    After a break the time goes on; an arm that stood cools, and warms again.
    """
    first, rng = pair.world, pair.rng
    m, added = len(first.visits.q), len(further.q)
    visits = Visits(
        np.concatenate((first.visits.q, further.q)),
        np.concatenate((first.visits.pose, 1 + first.visits.pose.max() + further.pose)),
        np.concatenate((first.visits.is_validation, further.is_validation)),
        first.visits.home,
    )
    world = HiddenWorld(first.urdf, visits, first.sensors, first.nominal_markers, rng)
    stood_s = rng.uniform(*BREAK_S)
    working_s = np.cumsum(rng.uniform(*TURN_S, added))
    warm = first.visited.warming_k[-1]
    cooled = warm * np.exp(-stood_s / COOLING_S)
    warming = warm + (cooled - warm) * np.exp(-working_s / COOLING_S)
    time_s = first.visited.time_s[-1] + stood_s + working_s
    world.visited = Round(
        visits.q,
        visits.home,
        np.concatenate((first.visited.time_s, time_s)),
        np.concatenate((first.visited.warming_k, warming)),
    )
    world.stamp_s = first.stamp_s[0] + world.visited.time_s
    measured_c = 21.0 + warming + 0.05 * rng.standard_normal(added)
    world.temperature_c = np.concatenate((first.temperature_c, measured_c))
    world.joint_offsets, world.markers = first.joint_offsets, first.markers
    world.marker_std_m = first.marker_std_m
    session, truth = world.measure(pair.truth.effects, NOISES[pair.noise], rng)
    rows = session.measurements
    position = np.concatenate((pair.session.measurements.position, rows.position[m:]))
    return replace(session, measurements=replace(rows, position=position)), world, truth


def separating(pair: PairSession, causes: Sequence[FoundCause]) -> SeparatingDesign:
    """Return what separates causes that were found in a session from their look-alikes."""
    planned_poses, so_far = measured_so_far(pair.session.measurements)
    pool = scene_with_other_elbows(scene()).plan(POOL_CANDIDATES, scene().rough_R, pair.rng).poses
    chain = scene().model.chain
    return separate(chain, planned_poses, pool, [BAR], MARKER_STD_M, causes, Priors(), so_far)


def visits_of(pair: PairSession, design: SeparatingDesign) -> Visits:
    """Return what is added, in the order of the choice."""
    q = np.array([design.poses[pose].solutions[place] for pose, place in design.order])
    pose = np.array([pose for pose, _ in design.order])
    return Visits(q, pose, np.zeros(len(q), bool), pair.world.visits.q[-1])


def verdict(found: Discovery, pair: PairSession, world: HiddenWorld, truth: HiddenTruth) -> str:
    """Return whether a search is right, wrong, open, or finds nothing."""
    if not found.effects:
        return 'none'
    if found.verdict == 'undetermined':
        return 'open'
    judged = judge(world, truth, found)
    named = [(effect.name, effect.joints) for effect in found.effects]
    # A look-alike may stand for the truth where nothing distinguishes them, but not the other one.
    return 'right' if judged.named_right and pair.other not in named else 'wrong'
