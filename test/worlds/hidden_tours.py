# SPDX-License-Identifier: Apache-2.0
"""Where the hidden world's arm goes: planned by the robot's own software, as in a real cell.

Only the choice of configurations comes from `remaster_ros` (poses that face a sensor, all their
joint solutions, nearest first); what is measured there is the hidden world's business.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from worlds.hidden_arm import panda_arm, six_joint_arm, ur10_arm
from worlds.hidden_world import MARKER_STD_M, HiddenWorld, Visits

from remaster_ros.kinematics.collision import CollisionModel, arm_bodies
from remaster_ros.kinematics.inverse_kinematics import InverseKinematics
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import transform
from remaster_ros.planning.candidates import LineOfSight, PoseRanges, candidate_poses, plan_poses
from remaster_ros.planning.tour_order import Tour
from remaster_ros.simulation.truth import SimulatedSensor
from remaster_ros.types import FloatArray

ROBOTS = Path(__file__).parents[2] / 'config/robots'
MARKERS = {'sir': np.array([0.1, 0.0, 0.02]), 'smr': np.array([-0.1, 0.0, 0.02])}
# Name: marker, place in R, largest angle at which the marker is seen.
PLACES = {
    'mocap': ('sir', np.array([1.9, 0.0, 1.3]), 60.0),
    'tracker': ('smr', np.array([1.9, 0.3, 1.0]), 45.0),
}
CANDIDATES = {'lwr4plus': 60, 'iiwa14': 60, 'iiwa7': 75, 'six': 95, 'panda': 75, 'ur10': 75}
MADE = {'six': six_joint_arm, 'panda': panda_arm, 'ur10': ur10_arm}
# A small region; the tool hardly turns in it, nor on the plane.
LITTLE_ROLL = (-0.3, 0.3)
REGION = PoseRanges((-0.25, 0.25), (0.42, 0.55), (0.5, 0.62), LITTLE_ROLL)
PLANE = PoseRanges(roll_rad=LITTLE_ROLL)
# Markers on a plane before the sensor, to within so much.
PLANE_X_M, PLANE_STD_M = 0.35, 2e-3
# Repeatability of the arm, rad: no two visits report the very same angles.
REPEATABILITY_RAD = 2e-5


@cache
def robot(name: str) -> str:
    """Return the URDF of a shipped robot, or of one of `MADE`."""
    if name in MADE:
        return MADE[name]()
    return (ROBOTS / f'{name}.urdf').read_text(encoding='utf-8')


@cache
def visits(
    name: str,
    seed: int,
    candidates: int | None = None,
    held_values: tuple[float, ...] = (0.0,),
    where: str = 'all',
) -> Visits:
    """Plan and order a tour; the same arguments give the same one.

    Parameters
    ----------
    name
        See `robot`.
    seed
        Of the candidate poses.
    candidates
        How many to fit, and as many again held out; those that cannot be reached are dropped.
        None for as many as leave about 175 configurations of each split.
    held_values
        Values of joint 3 of an arm with seven, rad.
    where
        ``all``: the paper's poses; ``region``: in a small part of their space, the tool hardly
        turned about its axis; ``plane``: likewise, the marker of the camera on a plane.
    """
    candidates = CANDIDATES[name] if candidates is None else candidates
    rng = np.random.default_rng([seed, candidates])
    chain = SerialChain.from_urdf(robot(name), 'base_link', 'tool')
    inverse = InverseKinematics(chain, {2: held_values} if len(chain) == 7 else None)
    # The judges' worlds need no clearance: no real arm takes these paths.
    arm = CollisionModel(chain, arm_bodies(chain, [], 0.075), margin=0.005, unknown_offset=0.0)
    sights = [
        LineOfSight(sensor, place, MARKERS[marker], np.deg2rad(angle))
        for sensor, (marker, place, angle) in PLACES.items()
    ]
    plans = {
        split: plan_poses(
            inverse,
            arm,
            _candidates(candidates, where, rng),
            sights,
            np.deg2rad(1.0),
        )
        for split in ('optimization', 'validation')
    }
    tour = Tour(chain, plans)
    home = np.clip(np.full(len(chain), 0.1), chain.lower, chain.upper)
    q, pose, is_validation = [], [], []
    here = home
    while (stop := tour.next(here)) is not None:
        q.append(stop.solutions)
        pose += [stop.pose] * len(stop.solutions)
        is_validation += [stop.split == 'validation'] * len(stop.solutions)
        here = stop.solutions[-1]
    reported = np.concatenate(q)
    reported = reported + REPEATABILITY_RAD * rng.standard_normal(reported.shape)
    return Visits(reported, np.array(pose), np.array(is_validation), home)


def _candidates(count: int, where: str, rng: np.random.Generator) -> FloatArray:
    ranges = {'all': PoseRanges(), 'region': REGION, 'plane': PLANE}[where]
    poses = candidate_poses(count, ranges, PLACES['tracker'][1], rng)
    if where == 'plane':
        marker_x = (poses[:, :3, :3] @ MARKERS['sir'])[:, 0] + poses[:, 0, 3]
        poses[:, 0, 3] += PLANE_X_M + PLANE_STD_M * rng.standard_normal(count) - marker_x
    return poses


def world(
    name: str,
    rng: np.random.Generator,
    *,
    sensors: tuple[str, ...] = ('mocap',),
    tour: Visits | None = None,
    marker_std_m: float = MARKER_STD_M,
) -> HiddenWorld:
    """Draw a world: the named robot on a tour in front of the sensors.

    Parameters
    ----------
    name
        ``iiwa7``, ``lwr4plus``, ``iiwa14``, ``six``, ``panda`` or ``ur10``.
    rng
        Source of all randomness but the tour's.
    sensors
        Of `PLACES`.
    tour
        Where it goes; one of eight where None.
    marker_std_m
        How far the markers are from where they are drawn, per axis, m.
    """
    if tour is None:
        tour = visits(name, int(rng.integers(8)))
    placed = {}
    for sensor in sensors:
        marker, place, _ = PLACES[sensor]
        origin = place + 0.05 * rng.standard_normal(3)
        placed[sensor] = facing_sensor(marker, origin, rng)
    markers = {PLACES[sensor][0]: MARKERS[PLACES[sensor][0]] for sensor in sensors}
    return HiddenWorld(robot(name), tour, placed, markers, rng, marker_std_m)


def facing_sensor(marker: str, origin: FloatArray, rng: np.random.Generator) -> SimulatedSensor:
    """Return a sensor that looks at the poses from there, turned a little about its z axis."""
    return SimulatedSensor(marker, transform(_facing(origin, rng.uniform(-0.2, 0.2)), origin))


def _facing(origin: FloatArray, roll: float) -> FloatArray:
    """Return the rotation of a sensor whose z axis points at the middle of the poses."""
    z = np.array([0.0, 0.0, 0.6]) - origin
    z /= np.linalg.norm(z)
    x = np.cross((0.0, 0.0, 1.0), z)
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    return np.column_stack(
        (np.cos(roll) * x + np.sin(roll) * y, np.cos(roll) * y - np.sin(roll) * x, z)
    )
