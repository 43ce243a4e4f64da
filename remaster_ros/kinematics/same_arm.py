# SPDX-License-Identifier: Apache-2.0
"""Whether a robot description is that of the arm of a chain, as far as motion goes.

A description on ``/robot_description`` may be written otherwise than the URDF of the cell: made
from xacro, with other digits or frames of its links, with a gripper behind the tip, on a table.
What counts is where the axes of the joints lie at zero, and how far and how fast they may turn or
slide. Of a joint that slides the direction alone counts: it carries what is beyond it wherever its
axis lies.
"""

from __future__ import annotations

import numpy as np

from remaster_ros.errors import InputError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import inverse
from remaster_ros.kinematics.urdf import parse_urdf
from remaster_ros.types import FloatArray

PLACE_M = 1e-4
"""Two axes are the same up to this distance, m: descriptions give four digits at least."""
TURN_RAD = 1e-4
"""And up to this angle, rad; limits too, in rad and rad/s, or m and m/s."""


def difference(chain: SerialChain, description: str) -> str:
    """Return how a description contradicts an arm, ''.

    The place of the first joint is compared where the description has the link of the arm's base,
    the tip where it has that of its tip. Limits of the description may be wider than the arm's,
    which then uses a part of them.

    Parameters
    ----------
    chain
        The arm.
    description
        URDF text.
    """
    read = _read(chain, description)
    if isinstance(read, str):
        return read
    other, has_base, has_tip = read
    for i, name in enumerate(chain.joint_names):
        if chain.slides[i] != other.slides[i]:
            return f'{name} {"slides" if other.slides[i] else "turns"} there'
    # A place and a direction of each axis.
    (places, own), (others, theirs) = _axes(chain, has_base), _axes(other, has_base)
    apart = places - others
    apart -= np.sum(apart * own, axis=1, keepdims=True) * own
    far, turned = np.linalg.norm(apart, axis=1), np.linalg.norm(own - theirs, axis=1)
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
    """Return how far the axes of a description are turned from those of an arm, rad.

    Root of the sum of the squares; infinite where it is another arm.
    """
    read = _read(chain, description)
    if isinstance(read, str):
        return np.inf
    other, has_base, _ = read
    return float(np.linalg.norm(_axes(chain, has_base)[1] - _axes(other, has_base)[1]))


def _read(chain: SerialChain, description: str) -> tuple[SerialChain, bool, bool] | str:
    """Return the arm of a description, and whether it has base and tip; or why it is another."""
    try:
        model = parse_urdf(description)
        links = {joint.name: link for link, joint in model.parent_joint.items()}
        missing = [name for name in chain.joint_names if name not in links]
        if missing:
            return f'it has no joint {", ".join(missing)}'
        has_base = chain.base_link in model.links
        base = chain.base_link if has_base else model.root
        # A gripper or a tool changer behind the tip does not matter, nor that there is none.
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
    """Return a point of each axis, m, and its direction, (k, 3) each, all joints at zero.

    In the base's frame, or in that of the first joint.
    """
    frames = _from(chain, from_base) @ chain.frames(np.zeros(len(chain)))
    return frames[:, :3, 3], np.einsum('kij,kj->ki', frames[:, :3, :3], chain.axes)


def _tip(chain: SerialChain, from_base: bool) -> FloatArray:
    """Return the tip's frame, (4, 4), all joints at zero; in which frame as `_axes`."""
    return _from(chain, from_base) @ chain.forward(np.zeros(len(chain)))


def _from(chain: SerialChain, base: bool) -> FloatArray:
    """Return what brings a place in the base's frame into the one that is compared in, (4, 4)."""
    return np.eye(4) if base else inverse(chain.T_fixed[0])


def _degrees(angle_rad: float) -> str:
    return f'{np.rad2deg(angle_rad):.2f} deg'


def _millimetres(way_m: float) -> str:
    return f'{1e3 * way_m:.2f} mm'
