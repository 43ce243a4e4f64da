# SPDX-License-Identifier: Apache-2.0
"""Proposals for the cell file of an unknown arm: the held joint, the ranges of poses, the marker.

Everything is tried on the arm itself: the inverse kinematics with each joint held, and the tool
poses facing a sensor that the arm can reach within its limits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.kinematics.bodies import Body
from remaster_ros.kinematics.collision import arm_bodies
from remaster_ros.kinematics.inverse_kinematics import (
    FEWEST_JOINTS,
    FREE_JOINTS,
    OWN_CONFIGURATIONS,
    InverseKinematics,
)
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import apply, inverse
from remaster_ros.planning.candidates import PoseRanges
from remaster_ros.types import FloatArray

# Mean number of solutions of a pose below which a joint is held at several values (added, rad).
FEW_SOLUTIONS = 1.5
OTHER_VALUES = tuple(np.radians((-40.0, 0.0, 40.0)).tolist())
# Positions at which a prismatic joint is held, as shares of its travel.
SHARES = (0.25, 0.5, 0.75)
# Least number of 3,000 random poses that face a sensor if the arm can face it; else the share of
# poses within the proposed angle.
FACING, MOST = 30, 0.95
# Least distance of a marker from the tool plate, and from the last link, m.
LEAST_MARKER_M = 0.05
CLEAR_M = 0.03
# Reach from which links have the default radius of cell files, m; smaller arms are scaled down.
FULL_SIZE_M = 0.9


@dataclass(frozen=True)
class HeldJoint:
    """The joint of a 7-axis arm to hold at fixed values for inverse kinematics, if any."""

    joint: int | None  # Its index; None if the arm has at most six joints
    values_held: tuple[float, ...]  # rad or m
    # Mean number of joint solutions of a pose, unreachable poses included
    solutions: float
    # Name of each joint tried -> mean number of solutions, or why it is not held
    tried: Mapping[str, float | str]
    kinematics: InverseKinematics  # With this joint held

    def values(self) -> dict[int, tuple[float, ...]]:
        """Return {index of the held joint: its values}, as `InverseKinematics` takes them.

        {} if no joint is held.
        """
        return {} if self.joint is None else {self.joint: self.values_held}


def propose_held_joint(chain: SerialChain, facing: FloatArray) -> HeldJoint:
    """Return the joint that gives poses the most joint solutions if it is held.

    No joint is held (`HeldJoint.joint` None) if the arm has `FEWEST_JOINTS` to six joints. Of
    seven, a joint is preferred that leaves an arm with a closed form, or near one: solutions
    are then found a hundred times as fast, and none is missed. A prismatic joint is held at
    `SHARES` of its travel; another one at up to three values if poses have fewer than
    `FEW_SOLUTIONS` on average.

    ``facing``: tool poses to try, (n, 4, 4), such as those drawn from `widest_ranges`.

    Raises InputError if the arm has fewer than three or more than seven joints, or is singular
    at all configurations whichever joint is held.
    """
    if FEWEST_JOINTS <= len(chain) <= FREE_JOINTS:
        kinematics = InverseKinematics(chain, {})
        return HeldJoint(None, (), _mean_solutions(kinematics, facing), {}, kinematics)
    if len(chain) != FREE_JOINTS + 1:
        raise InputError(
            f"robot '{chain.name}' has {len(chain)} joints between '{chain.base_link}' and "
            f"'{chain.tip_link}'; poses are planned for {FEWEST_JOINTS} to {FREE_JOINTS}, or for "
            f'{FREE_JOINTS + 1} with one held. '
            'Other links are named by --base-link and --tip-link. As it is, '
            f'{OWN_CONFIGURATIONS}'
        )
    tried: dict[str, float | str] = {}
    usable: dict[int, InverseKinematics] = {}
    for joint, name in enumerate(chain.joint_names):
        try:
            usable[joint] = InverseKinematics(chain, {joint: (_resting(chain, joint),)})
        except InputError:
            tried[name] = 'singular everywhere'
    if not usable:
        raise InputError(
            f"robot '{chain.name}' is singular everywhere, whichever joint is held; "
            f'{OWN_CONFIGURATIONS}'
        )
    near_closed_form = {joint: k for joint, k in usable.items() if k.method != 'many starts'}
    best: tuple[float, int] | None = None
    for joint, kinematics in usable.items():
        name = chain.joint_names[joint]
        if near_closed_form and joint not in near_closed_form:
            tried[name] = 'no closed form near'
            continue
        count = tried[name] = _mean_solutions(kinematics, facing)
        if best is None or count > best[0]:
            best = count, joint
    assert best is not None
    count, joint = best
    kinematics, tried = usable[joint], {name: tried[name] for name in chain.joint_names}
    if chain.slides[joint]:
        low, high = chain.lower[joint], chain.upper[joint]
        # Rounded to millimetres, as in cell files.
        values = tuple(round(low + share * (high - low), 3) for share in SHARES)
        kinematics = InverseKinematics(chain, {joint: values})
        count = _mean_solutions(kinematics, facing)
    elif count < FEW_SOLUTIONS:
        value, span = kinematics.held[joint][0], (chain.lower[joint], chain.upper[joint])
        values = tuple(value + step for step in OTHER_VALUES if span[0] < value + step < span[1])
        kinematics = InverseKinematics(chain, {joint: values})
        count = _mean_solutions(kinematics, facing)
    return HeldJoint(joint, kinematics.held[joint], count, tried, kinematics)


def _resting(chain: SerialChain, joint: int) -> float:
    """Return a position to hold a joint at, rad or m.

    0 if that is at least a fifth of the range from both limits, or there are no limits; else
    the middle of the range, rounded to 5 degrees. Of a prismatic joint always the middle, not
    rounded. ``joint``: its index.
    """
    low, high = chain.lower[joint], chain.upper[joint]
    if chain.slides[joint]:
        return float(low + high) / 2
    if not np.isfinite(high - low):
        return 0.0
    margin = 0.2 * (high - low)
    middle = float(np.round(np.degrees(0.5 * (low + high)) / 5.0) * np.radians(5.0))
    return 0.0 if low + margin < 0.0 < high - margin else middle


def _random_joints(chain: SerialChain, count: int, rng: np.random.Generator) -> FloatArray:
    """Return uniformly random joint positions within the limits, rad or m, (count, k).

    Limits of revolute joints are cut to ±pi (`usual_range`). Collisions are not checked.
    """
    return rng.uniform(*chain.usual_range, (count, len(chain)))


def _mean_solutions(kinematics: InverseKinematics, poses: FloatArray) -> float:
    """Return the mean number of usable joint solutions of tool poses (n, 4, 4), n >= 1.

    Unreachable poses count as 0.
    """
    solutions = kinematics.solutions_of_each(poses)
    return float(np.mean([len(kinematics.usable(q)) for q in solutions]))


@dataclass(frozen=True)
class Reach:
    """Extent of the workspace of an arm: its radius, and its lowest and highest tool position."""

    reach_m: float  # Largest distance of the tool from the first joint's axis, m
    # Lowest and highest tool position, m
    low_m: float
    high_m: float


def reach_of(chain: SerialChain, rng: np.random.Generator) -> Reach:
    """Return the extent of the workspace, estimated from 3,000 random configurations."""
    places = chain.forward(_random_joints(chain, 3000, rng))[:, :3, 3]
    first = chain.T_fixed[0]
    radius = np.linalg.norm((places - first[:3, 3])[:, :2], axis=1)
    return Reach(float(radius.max()), float(places[:, 2].min()), float(places[:, 2].max()))


def link_radius(reach: Reach, full_size: float) -> float:
    """Return a collision radius for an arm's links, m, rounded to mm.

    ``full_size``: radius for arms with a reach of `FULL_SIZE_M` or more, m; for smaller arms
    it is reduced in proportion to the reach.
    """
    return round(full_size * min(reach.reach_m / FULL_SIZE_M, 1.0), 3)


def facing_angle_deg(
    chain: SerialChain,
    sensor_R: FloatArray,
    max_angle_deg: float,
    rng: np.random.Generator,
) -> float:
    """Return the largest angle between tool axis and line to a sensor at usable poses, degrees.

    `max_angle_deg` if at least `FACING` of 3,000 random poses face the sensor within it. Else
    the arm cannot turn its tool so far, like a SCARA, whose tool stays upright: then an angle,
    in steps of 5, at most 180, within which a share `MOST` of its poses face the sensor.
    ``sensor_R``: its position in the robot base frame R, m, (3,).
    """
    T = chain.forward(_random_joints(chain, 3000, rng))
    to_sensor = sensor_R - T[:, :3, 3]
    cosines = np.sum(T[:, :3, 2] * to_sensor, axis=1) / np.linalg.norm(to_sensor, axis=1)
    angles = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
    if np.sum(angles <= max_angle_deg) >= FACING:
        return max_angle_deg
    return float(min(5.0 * np.ceil(np.quantile(angles, MOST) / 5.0), 180.0))


def widest_ranges(reach: Reach, floor_z: float | None) -> PoseRanges:
    """Return ranges of poses that cover the whole workspace above the floor.

    ``floor_z``: height of the floor, m, None for none; a tenth of the reach above it is kept.
    Radii begin at 0.15 times the reach.
    """
    lowest = reach.low_m if floor_z is None else max(reach.low_m, floor_z + 0.1 * reach.reach_m)
    return PoseRanges(
        azimuth_rad=(-np.pi, np.pi),
        radius_m=(0.15 * reach.reach_m, reach.reach_m),
        height_m=(lowest, reach.high_m),
    )


def ranges_around(places: FloatArray) -> PoseRanges:
    """Return ranges for candidate poses around the middle of reachable tool positions.

    Quantiles 0.1 to 0.9 of radius and height, in steps of 1 cm; 0.05 to 0.95 of azimuth, in
    steps of 5 degrees, or a whole turn if that is wider than 300 degrees. The roll is any.
    ``places``: positions of the tool in the base frame, m, (n, 3), n >= 1.
    """
    radius = np.quantile(np.linalg.norm(places[:, :2], axis=1), (0.1, 0.9))
    height = np.quantile(places[:, 2], (0.1, 0.9))
    azimuth = np.quantile(np.arctan2(places[:, 1], places[:, 0]), (0.05, 0.95))
    wide = azimuth[1] - azimuth[0] > np.radians(300.0)
    return PoseRanges(
        azimuth_rad=(0.0, 2.0 * np.pi) if wide else _rounded(azimuth, np.radians(5.0)),
        radius_m=_rounded(radius, 0.01),
        height_m=_rounded(height, 0.01),
    )


def marker_height(chain: SerialChain, bodies: Sequence[Body], link_radius: float) -> float:
    """Return a coordinate on the tool's Z axis at which a marker is clear of the arm, m.

    Positive in front of the last link; negative if Z points back along the arm. At least
    `CLEAR_M` from the last and the previous link, rounded up to cm, and at least
    `LEAST_MARKER_M`. ``bodies``: the collision geometry; ``link_radius``: of the links in the
    line of sight, m.
    """
    # The previous link ends at the last joint's origin.
    T_T_joint = inverse(chain.T_fixed[-1])
    ends = [T_T_joint[2, 3] + link_radius, link_radius - T_T_joint[2, 3]]
    previous_link, (front, back) = list(ends), ends
    for body in bodies:
        if body.link == len(chain):
            z = apply(T_T_joint, body.outline)[:, 2]
            front, back = max(front, z.max()), max(back, -z.min())
    for body in arm_bodies(chain, bodies, link_radius):
        if body.link == len(chain) - 1:
            outline = body.outline - chain.T_fixed[-2][:3, 3]
            points = apply(T_T_joint, outline @ chain.T_fixed[-2][:3, :3])
            points = points[np.hypot(*points[:, :2].T) < link_radius + CLEAR_M]
            previous_link = [
                max([e, *s]) for e, s in zip(previous_link, (points[:, 2], -points[:, 2]))
            ]
    points_back = max(back, previous_link[1]) < max(front, previous_link[0])
    clear = np.ceil(100.0 * ((back if points_back else front) + CLEAR_M)) / 100.0
    return float(max(LEAST_MARKER_M, clear) * (-1.0 if points_back else 1.0))


def _rounded(values: FloatArray, step: float) -> tuple[float, float]:
    """Return the two ends of a range, each rounded to the nearest multiple of a step."""
    low, high = np.round(values / step) * step
    return float(low), float(high)
