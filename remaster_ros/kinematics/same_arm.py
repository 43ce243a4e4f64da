# SPDX-License-Identifier: Apache-2.0
"""Comparison of a robot description with the arm of a cell, as far as motion depends on it.

A description on ``/robot_description`` may be written otherwise than the URDF of the cell: made
from xacro, with other digits or link frames, with a gripper behind the tip, on a table. Compared
are the joint axes with all joints at zero, position limits and velocity limits. Of a prismatic
joint only the direction of its axis matters, not its position.
"""

from __future__ import annotations

import numpy as np

from remaster_ros.errors import InputError, did_you_mean
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import inverse
from remaster_ros.kinematics.urdf import parse_urdf
from remaster_ros.types import FloatArray

PLACE_M = 1e-4
"""Distance between axes that count as the same, m: descriptions give four digits at least."""
TURN_RAD = 1e-4
"""Angle between axes that count as the same, rad; also the tolerance of limits, in their units."""


def difference(chain: SerialChain, description: str) -> str:
    """Return in words how a description contradicts an arm; '' if it does not.

    Axes are compared with all joints at zero, within `PLACE_M` and `TURN_RAD`; the position of the
    first joint if the description has the arm's base link, the tip if it has the arm's tip link.
    Position and velocity limits of the description may be wider than the arm's. Text that is no
    URDF is a contradiction too. ``chain``: the arm; ``description``: URDF text.
    """
    read = _read(chain, description)
    if isinstance(read, str):
        return read
    other, has_base, has_tip = read
    for i, name in enumerate(chain.joint_names):
        if chain.slides[i] != other.slides[i]:
            return f'{name} {"slides" if other.slides[i] else "turns"} there'
    points, axes = _axes(chain, has_base)
    other_points, other_axes = _axes(other, has_base)
    gaps = points - other_points
    gaps -= np.sum(gaps * axes, axis=1, keepdims=True) * axes
    far, turned = np.linalg.norm(gaps, axis=1), np.linalg.norm(axes - other_axes, axis=1)
    for i, name in enumerate(chain.joint_names):
        if turned[i] > TURN_RAD:
            return (
                f'the axis of {name} is turned there by {_degrees(2 * np.arcsin(turned[i] / 2))}'
            )
        if far[i] > PLACE_M and not chain.slides[i]:
            return f'the axis of {name} lies {1e3 * far[i]:.1f} mm elsewhere there'
    for i, name in enumerate(chain.joint_names):
        low, high, fast = other.lower[i], other.upper[i], other.velocity_limits[i]
        text = _millimetres if chain.slides[i] else _degrees
        if chain.lower[i] < low - TURN_RAD or chain.upper[i] > high + TURN_RAD:
            return f'{name} may go from {text(low)} to {text(high)} only there'
        if chain.velocity_limits[i] > fast + TURN_RAD:
            verb = 'slide' if chain.slides[i] else 'turn'
            return f'{name} may {verb} at {text(fast)}/s only there'
    if has_tip:
        T = inverse(_tip(chain, has_base)) @ _tip(other, has_base)
        if np.linalg.norm(T[:3, 3]) > PLACE_M or np.max(np.abs(T[:3, :3] - np.eye(3))) > TURN_RAD:
            return f'{chain.tip_link} lies elsewhere there with all joints at zero'
    return ''


def axes_apart(chain: SerialChain, description: str) -> float:
    """Return the root sum of squares of the angles between an arm's axes and a description's, rad.

    Of directions with all joints at zero; a large angle counts as 2 sin(angle / 2). Infinite if
    the description is no valid URDF, lacks a joint of the arm, or has them in another order.
    """
    read = _read(chain, description)
    if isinstance(read, str):
        return np.inf
    other, has_base, _ = read
    return float(np.linalg.norm(_axes(chain, has_base)[1] - _axes(other, has_base)[1]))


def _read(chain: SerialChain, description: str) -> tuple[SerialChain, bool, bool] | str:
    """Return a description's arm, and whether it has the base and the tip link of the chain.

    Or a text with the reason if it is invalid, lacks a joint, or has the joints in another order.
    """
    try:
        model = parse_urdf(description)
        links = {joint.name: link for link, joint in model.parent_joint.items()}
        missing = [name for name in chain.joint_names if name not in links]
        if missing:
            return f'it has no joint {", ".join(missing)}{did_you_mean(missing[0], links)}'
        has_base = chain.base_link in model.links
        base = chain.base_link if has_base else model.root
        # A gripper or tool changer behind the tip does not matter.
        last = links[chain.joint_names[-1]]
        has_tip = model.carrier(chain.tip_link, [last])[0] == last
        tip = chain.tip_link if has_tip else last
        other = SerialChain.from_urdf(description, base, tip)
    except InputError as error:
        return str(error)
    if other.joint_names != chain.joint_names:
        return f'its joints are {", ".join(other.joint_names)}, in this order'
    return other, has_base, has_tip


def _axes(chain: SerialChain, from_base: bool) -> tuple[FloatArray, FloatArray]:
    """Return a point of each joint axis, m, (k, 3), and its direction, (k, 3), all joints at zero.

    In the base frame if ``from_base``, else in that of the first joint.
    """
    frames = _from(chain, from_base) @ chain.frames(np.zeros(len(chain)))
    return frames[:, :3, 3], np.einsum('kij,kj->ki', frames[:, :3, :3], chain.axes)


def _tip(chain: SerialChain, from_base: bool) -> FloatArray:
    """Return the pose of the tip with all joints at zero, (4, 4).

    In the base frame if ``from_base``, else in that of the first joint.
    """
    return _from(chain, from_base) @ chain.forward(np.zeros(len(chain)))


def _from(chain: SerialChain, base: bool) -> FloatArray:
    """Return the transform of points from the base frame to the frame of comparison, (4, 4).

    That frame is the base's (so the identity) if ``base``, else the first joint's, at zero.
    """
    return np.eye(4) if base else inverse(chain.T_fixed[0])


def _degrees(angle_rad: float) -> str:
    """Return an angle, rad, as text in degrees: '1.23 deg'."""
    return f'{np.rad2deg(angle_rad):.2f} deg'


def _millimetres(way_m: float) -> str:
    """Return a way, m, as text in millimetres: '1.23 mm'."""
    return f'{1e3 * way_m:.2f} mm'
