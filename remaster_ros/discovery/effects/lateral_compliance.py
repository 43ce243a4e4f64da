# SPDX-License-Identifier: Apache-2.0
"""Lateral compliance: a joint's bearing tips under gravity's moment across its axis."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from remaster_ros.discovery.effects.base import Candidate, Design, Effect, needs_gravity, turned
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.moments import switched
from remaster_ros.discovery.effects.sizes import angle, largest
from remaster_ros.types import FloatArray


def candidates(context: Context) -> Iterator[Candidate]:
    """Yield a candidate for the bearing of each joint but the first and the last.

    One compliance for both directions across the axis. The bearing of joint 1 counts as base.
    """
    links = context.links()[1:]
    for joint in links:
        yield EFFECT.candidate(
            partial(_tipped, joint=joint),
            [f'lateral_compliance_{joint}'],
            joints=(joint,),
            drawn_from=max(1, len(links)),
        )


def _moment(context: Context, joint: int) -> FloatArray:
    """Return gravity's torque across the axis of a joint (1-based), as a vector, N m, (n, 3).

    In the robot base frame R; the component along the axis is taken out.
    """
    moment = context.gravity_moment[:, joint - 1]
    axis = context.link_rotation(joint) @ context.chain.axes[joint - 1]
    across: FloatArray = moment - np.sum(moment * axis, axis=1)[:, None] * axis
    return across


def _tipped(context: Context, joint: int) -> Design:
    """Return columns of a joint (1-based) that tips across its axis under gravity's torque."""
    return turned(context, [_moment(context, joint)], context.joint_origin(joint))


def _tips(context: Context, candidate: Candidate, draws: FloatArray) -> str:
    """Phrase for the angle by which a joint tips under the largest torque across its axis.

    ``draws``: of the compliance, rad/(N m), (draws, 1).
    """
    (joint,) = candidate.joints
    moment = largest(np.linalg.norm(_moment(context, joint), axis=1))
    return f'joint {joint} tips by {angle(draws[:, 0] * moment)} under {moment:.0f} N m'


EFFECT = Effect(
    name='lateral_compliance',
    place='link_rotation',
    driver='gravity_moment',
    form='linear',
    equation='δφ_j = c_j (M_j − (M_j · a_j) a_j), M_j gravity’s moment on what joint j carries',
    source='Klimchik et al. 2015, Mech. Mach. Theory 90 (stiffness of all axes of a joint)',
    unit='rad/(N m)',
    plausible=(1e-7, 1e-4),
    sign=1,
    sentence='The weight carried tips the bearing of {subject} across its axis (play or softness '
    'of a main bearing, or a soft link).',
    separate_by='the same poses with and without a payload, with the link stretched sideways',
    remedy='Have the main bearing of the joint checked for play with a dial gauge across the '
    'axis; correct what is left by the moment.',
    size=_tips,
    candidates=candidates,
    changes=switched,
    needs=needs_gravity,
)
