# SPDX-License-Identifier: Apache-2.0
"""What a cell file may hold for an arm that is not known yet: which joint is held, which poses.

Everything is tried on the arm itself: the inverse kinematics with each joint held, and which tool
poses that face a sensor the arm can take within its limits.
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

# With fewer joint solutions of a pose on average the joint is held at several values, rad.
FEW_SOLUTIONS = 1.5
OTHER_VALUES = tuple(np.radians((-40.0, 0.0, 40.0)).tolist())
# A joint that slides is held at these shares of its way: what it carries is to be measured there.
SHARES = (0.25, 0.5, 0.75)
# Of 3,000 places of an arm so many face a sensor, or it is taken not to.
FACING, MOST = 30, 0.95
# A marker in front of the tool plate, and how far it is kept from the last link, m.
LEAST_MARKER_M = 0.05
CLEAR_M = 0.03
# Arms that reach farther are taken to have links of the thickness that cell files have where they
# give none, m; smaller arms are built alike.
FULL_SIZE_M = 0.9


@dataclass(frozen=True)
class HeldJoint:
    """Which joint to hold so that poses have joint solutions, and how these are found."""

    joint: int | None  # Its index; None where the arm has at most six
    values_held: tuple[float, ...]  # Where it is held, rad or m
    # Mean number of joint solutions of a pose, those that cannot be reached among them
    solutions: float
    # Name of each joint that was tried -> that number, or why it is not held
    tried: Mapping[str, float | str]
    kinematics: InverseKinematics  # All joint solutions, with this joint held

    def values(self) -> dict[int, tuple[float, ...]]:
        """Return what `InverseKinematics` takes."""
        return {} if self.joint is None else {self.joint: self.values_held}


def propose_held_joint(chain: SerialChain, facing: FloatArray) -> HeldJoint:
    """Find the joint whose holding gives poses the most joint solutions.

    A joint that leaves an arm with a closed form, or one near it, is held before any other: the
    solutions are then found a hundred times as fast, and none is missed.

    Parameters
    ----------
    facing
        Tool poses to try it on, (n, 4, 4), such as those drawn from `widest_ranges`.

    Raises
    ------
    InputError
        An arm with fewer than three or more than seven joints, or one that is singular
        everywhere; with the reason.
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
    able: dict[int, InverseKinematics] = {}
    for joint, name in enumerate(chain.joint_names):
        try:
            able[joint] = InverseKinematics(chain, {joint: (_resting(chain, joint),)})
        except InputError:
            tried[name] = 'singular everywhere'
    if not able:
        raise InputError(
            f"robot '{chain.name}' is singular everywhere, whichever joint is held; "
            f'{OWN_CONFIGURATIONS}'
        )
    near = {joint: k for joint, k in able.items() if k.method != 'many starts'}
    best: tuple[float, int] | None = None
    for joint, kinematics in able.items():
        name = chain.joint_names[joint]
        if near and joint not in near:
            tried[name] = 'no closed form near'
            continue
        count = tried[name] = _mean_solutions(kinematics, facing)
        if best is None or count > best[0]:
            best = count, joint
    assert best is not None
    count, joint = best
    kinematics, tried = able[joint], {name: tried[name] for name in chain.joint_names}
    if chain.slides[joint]:
        low, high = chain.lower[joint], chain.upper[joint]
        # To millimetres, as cell files have them.
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
    """Return 0 where it is well inside the limits of a joint, else their middle, rad or m."""
    low, high = chain.lower[joint], chain.upper[joint]
    if chain.slides[joint]:
        return float(low + high) / 2
    if not np.isfinite(high - low):
        return 0.0
    margin = 0.2 * (high - low)
    middle = float(np.round(np.degrees(0.5 * (low + high)) / 5.0) * np.radians(5.0))
    return 0.0 if low + margin < 0.0 < high - margin else middle


def _random_joints(chain: SerialChain, count: int, rng: np.random.Generator) -> FloatArray:
    return rng.uniform(*chain.usual_range, (count, len(chain)))


def _mean_solutions(kinematics: InverseKinematics, poses: FloatArray) -> float:
    found = kinematics.solutions_of_each(poses)
    return float(np.mean([len(kinematics.usable(q)) for q in found]))


@dataclass(frozen=True)
class Reach:
    """How far an arm reaches."""

    reach_m: float  # From the axis of the first joint, m
    # Heights that the tool takes, m
    low_m: float
    high_m: float


def reach_of(chain: SerialChain, rng: np.random.Generator) -> Reach:
    """Return how far the tool gets from the axis of the first joint, and at which heights."""
    places = chain.forward(_random_joints(chain, 3000, rng))[:, :3, 3]
    first = chain.T_fixed[0]
    radius = np.linalg.norm((places - first[:3, 3])[:, :2], axis=1)
    return Reach(float(radius.max()), float(places[:, 2].min()), float(places[:, 2].max()))


def link_radius(reach: Reach, full_size: float) -> float:
    """Return how thick links are, m, given what they are in arms of full size."""
    return round(full_size * min(reach.reach_m / FULL_SIZE_M, 1.0), 3)


def turned_to(
    chain: SerialChain,
    sensor_R: FloatArray,
    max_angle_deg: float,
    rng: np.random.Generator,
) -> float:
    """Return the angle within which the tool can face a sensor, degrees.

    That is `max_angle_deg`, but for an arm that cannot turn its tool so, like a SCARA, whose tool
    stays upright: it has an angle within which nearly all of its places face the sensor.
    """
    T = chain.forward(_random_joints(chain, 3000, rng))
    to_sensor = sensor_R - T[:, :3, 3]
    cosines = np.sum(T[:, :3, 2] * to_sensor, axis=1) / np.linalg.norm(to_sensor, axis=1)
    angles = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
    if np.sum(angles <= max_angle_deg) >= FACING:
        return max_angle_deg
    return float(min(5.0 * np.ceil(np.quantile(angles, MOST) / 5.0), 180.0))


def widest_ranges(reach: Reach, floor_z: float | None) -> PoseRanges:
    """Return ranges of poses everywhere around an arm."""
    lowest = reach.low_m if floor_z is None else max(reach.low_m, floor_z + 0.1 * reach.reach_m)
    return PoseRanges(
        azimuth_rad=(-np.pi, np.pi),
        radius_m=(0.15 * reach.reach_m, reach.reach_m),
        height_m=(lowest, reach.high_m),
    )


def ranges_around(places: FloatArray) -> PoseRanges:
    """Return ranges around the middle of places that an arm can take, m, (n, 3)."""
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
    """Return where on the tool's Z axis a marker is clear of the arm, m.

    It is in front of the last link, or behind it where Z points back along the arm.

    Parameters
    ----------
    bodies
        The collision geometry.
    link_radius
        How thick links are for the line of sight, m.
    """
    # The last joint's origin ends the link before it.
    T_T_joint = inverse(chain.T_fixed[-1])
    ends = [T_T_joint[2, 3] + link_radius, link_radius - T_T_joint[2, 3]]
    before, (ahead, back) = list(ends), ends
    for body in bodies:
        if body.link == len(chain):
            z = apply(T_T_joint, body.outline)[:, 2]
            ahead, back = max(ahead, z.max()), max(back, -z.min())
    for body in arm_bodies(chain, bodies, link_radius):
        if body.link == len(chain) - 1:
            outline = body.outline - chain.T_fixed[-2][:3, 3]
            points = apply(T_T_joint, outline @ chain.T_fixed[-2][:3, :3])
            points = points[np.hypot(*points[:, :2].T) < link_radius + CLEAR_M]
            before = [max([e, *s]) for e, s in zip(before, (points[:, 2], -points[:, 2]))]
    points_back = max(back, before[1]) < max(ahead, before[0])
    clear = np.ceil(100.0 * ((back if points_back else ahead) + CLEAR_M)) / 100.0
    return float(max(LEAST_MARKER_M, clear) * (-1.0 if points_back else 1.0))


def _rounded(values: FloatArray, step: float) -> tuple[float, float]:
    low, high = np.round(values / step) * step
    return float(low), float(high)
