# SPDX-License-Identifier: Apache-2.0
"""A serial chain of joints from a URDF: kinematics with zero-offsets, gravity torques.

The true joint angle is the reported one plus the zero-offset, everywhere. All methods take any
number of leading dimensions in ``q``, ``points`` and ``joint_offsets``, and broadcast them.

A prismatic joint has metres in all arrays in which a revolute joint has radians (`units`); text
for users is in mm and degrees (`shown_units`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from remaster_ros.errors import InputError, did_you_mean
from remaster_ros.kinematics.transforms import (
    apply,
    inverse,
    rotation_vector_to_matrix,
    transform,
    with_z_along,
)
from remaster_ros.kinematics.urdf import UrdfJoint, UrdfModel, parse_urdf
from remaster_ros.types import BoolArray, FloatArray

# Accepted excess of a reported angle over a joint's limits: both are rounded.
LIMIT_TOLERANCE_RAD = np.deg2rad(1.0)
# Lever arm that converts limits of angles into lengths for prismatic joints, m: an error of d at a
# prismatic joint moves a marker by d, one of an angle a at distance r by a r. It is on the short
# side, a few tenths of an arm's reach, so that limits are too strict rather than too loose.
LEVER_M = 0.25


@dataclass(frozen=True, eq=False)
class SerialChain:
    """Kinematic chain of the moving joints between two links of a robot, base to tip.

    Fixed joints are merged into the fixed transforms between the moving ones.
    """

    name: str  # The robot's name in the URDF
    joint_names: tuple[str, ...]  # Names of the k joints
    # Links whose frames are R and T
    base_link: str
    tip_link: str
    # Joint limits, rad or m, (k,); infinite for continuous joints
    lower: FloatArray
    upper: FloatArray
    velocity_limits: FloatArray  # rad/s or m/s, (k,); infinite if the URDF gives none
    # Fixed transform before each joint, and from the last link to the tip, (k + 1, 4, 4)
    T_fixed: FloatArray
    axes: FloatArray  # Unit joint axes in the joint frames, (k, 3)
    # Mass that moves with each joint (its link and everything fixed to it), kg, (k,), and the
    # centre of mass in the link's frame, m, (k, 3)
    masses: FloatArray
    centers_of_mass: FloatArray
    # False if no moving link has a mass: gravity torques cannot be computed
    has_inertials: bool
    slides: BoolArray  # Whether each joint is prismatic, (k,)

    @classmethod
    def from_urdf(
        cls,
        text: str,
        base_link: str | None = None,
        tip_link: str | None = None,
    ) -> SerialChain:
        """Read the chain from URDF text.

        Joints off the chain (such as a gripper's fingers) count as fixed at zero: their masses
        belong to the link that carries them.

        Parameters
        ----------
        text
            Contents of the URDF file.
        base_link
            Link whose frame is R; None for the root link.
        tip_link
            Link whose frame is the tool frame T; None for the only link without children.

        Raises
        ------
        InputError
            If the text is no URDF, a link is missing, the tip is not below the base, several links
            have no children and no tip is named, a joint between them is floating, planar or a
            mimic joint, or limits are missing or reversed.
        """
        model = parse_urdf(text)
        base_link = model.root if base_link is None else base_link
        if tip_link is None:
            leaves = model.leaves()
            if len(leaves) != 1:
                raise InputError(
                    f'URDF: the arm has several ends ({", ".join(leaves)}); name the tip link'
                )
            tip_link = leaves[0]
        joints = _joints_between(model, base_link, tip_link)

        moving: list[UrdfJoint] = []
        T_fixed = [np.eye(4)]
        for joint in joints:
            T_fixed[-1] = T_fixed[-1] @ joint.origin
            if joint.kind != 'fixed':
                _require_kind(joint)
                moving.append(joint)
                T_fixed.append(np.eye(4))
        if not moving:
            raise InputError(
                f"URDF: no joint moves between '{base_link}' and '{tip_link}'; name other links"
            )

        first_moments, masses = _carried_masses(model, moving)
        with_mass = np.where(masses > 0.0, masses, 1.0)
        lower, upper, velocity_limits = np.transpose([_limits(joint) for joint in moving])
        return cls(
            name=model.name,
            joint_names=tuple(joint.name for joint in moving),
            base_link=base_link,
            tip_link=tip_link,
            lower=lower,
            upper=upper,
            velocity_limits=velocity_limits,
            T_fixed=np.array(T_fixed),
            axes=np.array([joint.axis for joint in moving]),
            masses=masses,
            centers_of_mass=first_moments / with_mass[:, None],
            has_inertials=bool(masses.any()),
            slides=np.array([joint.kind == 'prismatic' for joint in moving]),
        )

    def __len__(self) -> int:
        """Return the number of moving joints, k."""
        return len(self.joint_names)

    @cached_property
    def per_radian(self) -> FloatArray:
        """Amount of each joint's unit that counts as a radian, (k,): 1 rad, or `LEVER_M` in m."""
        return np.where(self.slides, LEVER_M, 1.0)

    @property
    def limit_tolerance(self) -> FloatArray:
        """Accepted excess of a reported position over its limits, rad or m, (k,)."""
        return LIMIT_TOLERANCE_RAD * self.per_radian

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of each joint's position in all arrays, k names: rad or m."""
        return tuple('m' if slides else 'rad' for slides in self.slides)

    @property
    def torque_units(self) -> tuple[str, ...]:
        """Unit of the `gravity_torque` of each joint, k names: (N m) or N."""
        return tuple('N' if slides else '(N m)' for slides in self.slides)

    @property
    def shown_units(self) -> tuple[str, ...]:
        """Unit in which a joint's position is displayed, k names: deg or mm."""
        return tuple('mm' if slides else 'deg' for slides in self.slides)

    @cached_property
    def shown_scale(self) -> FloatArray:
        """Factor from each joint's unit to its displayed unit, (k,): deg/rad or mm/m."""
        return np.where(self.slides, 1e3, np.degrees(1.0))

    @cached_property
    def usual_range(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper limits, rad or m, (k,) each; of revolute joints clipped to [-pi, pi]."""
        turn = np.where(self.slides, np.inf, np.pi)
        return np.maximum(self.lower, -turn), np.minimum(self.upper, turn)

    def shown_limits(self, joint: int) -> str:
        """Return the limits of a joint as text in deg or mm, without the unit: '-90 to 90'.

        ``joint``: index from 0; an infinite limit is 'without end'.
        """
        factor, ends = self.shown_scale[joint], (self.lower[joint], self.upper[joint])
        return ' to '.join(f'{factor * e:.0f}' if np.isfinite(e) else 'without end' for e in ends)

    def shown_offset(self, joint: int, value: float, digits: int = 2) -> str:
        """Return an offset of a joint (rad or m) as text, in deg or mm with the unit.

        ``digits``: decimals of a value in degrees; one in mm has one fewer, as 1 mm at the tool is
        about as much as 0.1 degrees.
        """
        digits = max(digits - bool(self.slides[joint]), 0)
        return f'{self.shown_scale[joint] * value:.{digits}f} {self.shown_units[joint]}'

    def with_offsets(self, joint_offsets: FloatArray) -> SerialChain:
        """Return the chain with zero-offsets (rad or m, (k,)) built into its fixed transforms.

        Its `frames` take reported joint angles and give true frames; its limits are those of the
        reported angles: the given ones minus the offsets.
        """
        T_fixed = self.T_fixed.copy()
        T_fixed[:-1] = T_fixed[:-1] @ self.motions(np.asarray(joint_offsets, dtype=float))
        return replace(
            self,
            T_fixed=T_fixed,
            lower=self.lower - joint_offsets,
            upper=self.upper - joint_offsets,
        )

    def within_limits(self, q: ArrayLike, tolerance: float | FloatArray = 0.0) -> BoolArray:
        """Whether all joints of configurations q (..., k) are within their limits, (...).

        ``tolerance``: accepted distance beyond the limits, rad or m, one number or (k,); negative
        keeps a margin. NaN is outside.
        """
        q = np.asarray(q, dtype=float)
        inside = (q >= self.lower - tolerance) & (q <= self.upper + tolerance)
        return np.all(inside, axis=-1)

    def frames(self, q: ArrayLike, joint_offsets: ArrayLike | None = None) -> FloatArray:
        """Return the frame of each joint's link in R, T_R_link (..., k, 4, 4).

        Parameters
        ----------
        q
            Joint angles, rad, (..., k).
        joint_offsets
            Zero-offsets added to q, rad, (..., k); None for the nominal robot.
        """
        angles = self._checked(q)
        if joint_offsets is not None:
            angles = angles + np.asarray(joint_offsets, dtype=float)
        steps = self.T_fixed[:-1] @ self.motions(angles)
        frames, frame = np.empty_like(steps), np.eye(4)
        for i in range(len(self)):
            frame = frames[..., i, :, :] = frame @ steps[..., i, :, :]
        return frames

    def motions(self, q: FloatArray) -> FloatArray:
        """Return the transform of each joint at positions q (..., k), rad or m, (..., k, 4, 4).

        It is the motion about or along the joint's axis alone, without `T_fixed`.
        """
        vectors = q[..., None] * self.axes
        if not self.slides.any():
            return transform(rotation_vector_to_matrix(vectors), np.zeros(3))
        slides = self.slides[:, None]
        turns = rotation_vector_to_matrix(np.where(slides, 0.0, vectors))
        return transform(turns, np.where(slides, vectors, 0.0))

    def forward(self, q: ArrayLike, joint_offsets: ArrayLike | None = None) -> FloatArray:
        """Return the tool pose T_R_T, (..., 4, 4); arguments as of `frames`."""
        return self.frames(q, joint_offsets)[..., -1, :, :] @ self.T_fixed[-1]

    def within_turns(self, q: FloatArray) -> FloatArray:
        """Return joint angles (n, k) moved by up to two whole turns to lie within the limits.

        Angles that no such turn brings within the limits, and prismatic joints, are unchanged.
        """
        low, high = self.lower - self.limit_tolerance, self.upper + self.limit_tolerance
        turned = q.copy()
        for turns in (-1, 1, -2, 2):
            other = q + np.where(self.slides, 0.0, turns * 2.0 * np.pi)
            outside = ~((turned >= low) & (turned <= high))
            turned = np.where(outside & (other >= low) & (other <= high), other, turned)
        return turned

    def positions(
        self,
        q: ArrayLike,
        points: ArrayLike,
        joint_offsets: ArrayLike | None = None,
        turns: Mapping[int, FloatArray] | None = None,
    ) -> FloatArray:
        """Return the positions in R of points of the tool frame, m, (..., 3).

        Fast forward kinematics for the fit: rotates vectors instead of multiplying matrices, and
        combines the sines of q (n, k) and of joint_offsets (B, 1, k) by the addition theorem, so
        that a batch of offsets costs no trigonometry over its whole shape, except for joints with
        an entry in `turns`.

        Parameters
        ----------
        q
            Joint angles, rad, (..., k).
        points
            Points in the tool frame T, m, (..., 3).
        joint_offsets
            Zero-offsets, rad, (..., k).
        turns
            Additional motion of some joints: joint index -> rad or m, (...).
        """
        q, extra = self._checked(q), turns or {}
        offsets = np.zeros(len(self)) if joint_offsets is None else np.asarray(joint_offsets)
        # Coordinates are the first axis: each rotation works on whole arrays.
        vectors = np.moveaxis(np.asarray(points, dtype=float), -1, 0)
        for i in range(len(self), -1, -1):
            step = self.T_fixed_z[i]
            vectors = (step[:3, :3] @ vectors.reshape(3, -1)).reshape(vectors.shape)
            vectors += step[:3, 3].reshape(3, *(1,) * (vectors.ndim - 1))
            if i == 0:
                break
            if self.slides[i - 1]:
                along = vectors[2] + q[..., i - 1] + offsets[..., i - 1] + extra.get(i - 1, 0.0)
                across = (np.broadcast_to(vectors[axis], along.shape) for axis in (0, 1))
                vectors = np.stack((*across, along))
                continue
            sine, cosine = np.sin(q[..., i - 1]), np.cos(q[..., i - 1])
            if joint_offsets is not None or i - 1 in extra:
                added = offsets[..., i - 1] + extra.get(i - 1, 0.0)
                s, c = np.sin(added), np.cos(added)
                sine, cosine = sine * c + cosine * s, cosine * c - sine * s
            x = cosine * vectors[0] - sine * vectors[1]
            y = sine * vectors[0] + cosine * vectors[1]
            if x.shape == vectors.shape[1:]:
                vectors[0], vectors[1] = x, y
            else:
                vectors = np.stack((x, y, np.broadcast_to(vectors[2], x.shape)))
        return np.stack(tuple(vectors), axis=-1)

    def position_jacobian(
        self, q: ArrayLike, points: ArrayLike, joint_offsets: ArrayLike | None = None
    ) -> FloatArray:
        """Return the Jacobian of `positions` by q, equal to that by the zero-offsets, (..., 3, k).

        Column i is axis_i × (p − o_i), m/rad, for a revolute joint, and axis_i, m/m, for a
        prismatic one.
        """
        frames = self.frames(q, joint_offsets)
        tip = frames[..., -1, :, :] @ self.T_fixed[-1]
        return self.velocities(frames, apply(tip, points))

    def velocities(self, frames: FloatArray, points: FloatArray) -> FloatArray:
        """Return the position Jacobian of points in R, (..., 3, k).

        ``frames``: the link frames of `frames`, (..., k, 4, 4); ``points``: m, in R, (..., 3).
        """
        arms, axes = points[..., None, :] - frames[..., :3, 3], self.axes_in_base(frames)
        moved = np.cross(axes, arms)
        if self.slides.any():
            moved = np.where(self.slides[:, None], axes, moved)
        return np.swapaxes(moved, -1, -2)

    def gravity_torque(self, q: ArrayLike, gravity: ArrayLike = (0.0, 0.0, -9.81)) -> FloatArray:
        """Return gravity's torque about each joint, axis · (r × m g), N m, (..., k).

        Summed over all links that the joint carries. Positive if gravity drives the joint in its
        positive direction; a motor that holds the arm still applies the negative. Of a prismatic
        joint the force along its axis, N. Zeros if the URDF has no masses (`has_inertials`).

        Parameters
        ----------
        q
            Joint angles, rad, (..., k).
        gravity
            Acceleration in R, m/s², (3,).
        """
        frames = self.frames(q)
        centers = apply(frames, self.centers_of_mass)
        moments = self.masses[:, None] * centers
        # Sums over the joint's link and all links beyond.
        carried_moment = np.cumsum(moments[..., ::-1, :], axis=-2)[..., ::-1, :]
        carried_mass = np.cumsum(self.masses[::-1])[::-1]
        arms = carried_moment - carried_mass[:, None] * frames[..., :3, 3]
        torque = np.cross(arms, np.asarray(gravity, dtype=float))
        if self.slides.any():
            force = carried_mass[:, None] * np.asarray(gravity, dtype=float)
            torque = np.where(self.slides[:, None], force, torque)
        return np.sum(self.axes_in_base(frames) * torque, axis=-1)

    def axes_in_base(self, frames: FloatArray) -> FloatArray:
        """Return the joint axes in R, unit vectors (..., k, 3), of link frames (..., k, 4, 4)."""
        return (frames[..., :3, :3] @ self.axes[:, :, None])[..., 0]

    def _checked(self, q: ArrayLike) -> FloatArray:
        """Return joint angles as an array (..., k); raise ValueError if the last size is not k."""
        q = np.asarray(q, dtype=float)
        if q.ndim == 0 or q.shape[-1] != len(self):
            raise ValueError(f'q has shape {q.shape}; its last size must be {len(self)}')
        return q

    @cached_property
    def T_fixed_z(self) -> FloatArray:
        """Fixed transforms between joints if every joint axis is Z of its frame, (k + 1, 4, 4).

        `T_fixed` of the same arm with its joint frames rotated.
        """
        onto_axes = [np.eye(3), *map(with_z_along, self.axes), np.eye(3)]
        turns = transform(onto_axes, np.zeros(3))
        return inverse(turns[:-1]) @ self.T_fixed @ turns[1:]


def _joints_between(model: UrdfModel, base_link: str, tip_link: str) -> list[UrdfJoint]:
    """Return the joints from base to tip, in that order; raise InputError if there is no way."""
    for link in (base_link, tip_link):
        if link not in model.links:
            raise InputError(
                f"URDF: there is no link '{link}'; it has {', '.join(model.links)}"
                + did_you_mean(link, model.links)
            )
    joints = []
    link = tip_link
    while link != base_link:
        if link not in model.parent_joint:
            raise InputError(f"URDF: link '{tip_link}' does not hang on link '{base_link}'")
        joint = model.parent_joint[link]
        joints.append(joint)
        link = joint.parent
    return joints[::-1]


def _require_kind(joint: UrdfJoint) -> None:
    """Raise InputError if a joint of the arm is floating, planar or a mimic joint."""
    if joint.kind not in ('revolute', 'continuous', 'prismatic'):
        raise InputError(
            f"URDF: joint '{joint.name}' is {joint.kind}; "
            'only revolute, continuous, prismatic and fixed joints are supported between base and '
            'tip'
        )
    if joint.mimic:
        raise InputError(
            f"URDF: joint '{joint.name}' mimics another joint; that is not supported on the arm"
        )


def _limits(joint: UrdfJoint) -> tuple[float, float, float]:
    """Return lower, upper and velocity limit of a joint, rad or m and per s.

    A velocity limit of 0 counts as infinite. Raises InputError if position limits are missing.
    """
    velocity = joint.velocity or np.inf
    if velocity < 0.0:
        raise InputError(f"URDF: the velocity limit of joint '{joint.name}' is negative")
    if joint.kind == 'continuous':
        return -np.inf, np.inf, velocity
    if joint.lower is None or joint.upper is None:
        raise InputError(
            f"URDF: joint '{joint.name}' has no position limits; write <limit lower upper>"
        )
    if joint.lower >= joint.upper:
        raise InputError(
            f"URDF: joint '{joint.name}' has limits {joint.lower} to {joint.upper} "
            f'{"m" if joint.kind == "prismatic" else "rad"}; '
            'the lower must be below the upper'
        )
    return joint.lower, joint.upper, velocity


def _carried_masses(model: UrdfModel, moving: list[UrdfJoint]) -> tuple[FloatArray, FloatArray]:
    """Return first moments (kg m, (k, 3)) and masses (kg, (k,)) that move with each joint.

    A first moment is in the frame of the joint's link; `moving` are the k joints.
    """
    index = {joint.child: i for i, joint in enumerate(moving)}
    first_moments, masses = np.zeros((len(moving), 3)), np.zeros(len(moving))
    for link in model.links.values():
        carrier, T_carrier_link = model.carrier(link.name, index)
        if carrier in index:
            i = index[carrier]
            masses[i] += link.mass
            first_moments[i] += link.mass * apply(T_carrier_link, link.center_of_mass)
    return first_moments, masses
