# SPDX-License-Identifier: Apache-2.0
"""Pitch of a guide: the carriage of a joint that slides turns along its way.

Three free curves of the place: roll, pitch and yaw, about the axes of the joint's frame.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from remaster_ros.discovery.effects.base import Candidate, Design, Effect, turned
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.guide_straightness import Guide
from remaster_ros.discovery.effects.sizes import along_mean, angle
from remaster_ros.types import FloatArray


def candidates(context: Context) -> Iterator[Candidate]:
    """Yield candidates for each slide that moved: turns about x, y, z, and about each alone."""
    for guide in Guide.each(context):
        for axes in ('xyz', *'xyz'):
            yield EFFECT.candidate(
                partial(_turned, guide=guide, axes=axes),
                guide.parameters(*(f'guide_r{axis}' for axis in axes)),
                penalty=guide.penalty(len(axes)),
                variant=axes,
                **{**guide.fields, 'drawn_from': guide.fields['drawn_from'] * len('xyz')},
            )


def _turned(context: Context, guide: Guide, axes: str) -> Design:
    """Return columns of a carriage that turns along its way: a spline of the place for each axis.

    ``axes``: letters of axes of the joint's frame, such as 'xyz'. Axes of a spline stand next to
    each other; turns are about the joint's origin, rad per unit.
    """
    features, frame = guide.features(context), context.link_rotation(guide.joint)
    turns = [
        features[:, [i]] * frame[:, :, 'xyz'.index(axis)]
        for i in range(features.shape[1])
        for axis in axes
    ]
    return turned(context, turns, context.joint_origin(guide.joint))


def _turns_by(context: Context, candidate: Candidate, draws: FloatArray) -> str:
    """Phrase for the largest angle by which a carriage turns along its way.

    ``draws``: of the spline heights, rad, (draws, splines times axes).
    """
    (joint,) = candidate.joints
    assert candidate.curve is not None
    features = candidate.curve.columns(context.measurements.q[:, joint - 1])
    heights = draws.reshape(len(draws), -1, len(candidate.variant))
    row = int(np.argmax(np.linalg.norm(features @ heights.mean(axis=0), axis=1)))
    there = np.einsum('i,dia->da', features[row], heights)
    return f'the carriage of joint {joint} turns by up to {angle(along_mean(there))}'


EFFECT = Effect(
    name='guide_pitch',
    place='link_rotation',
    driver='own_place',
    form='free',
    equation='δφ = R_j Σ_i B_i(q_j) w_i, w_i a turn about the axes of the frame of the slide',
    source='ISO 230-1 (angular error motions of a linear axis: roll, pitch, yaw)',
    unit='rad',
    plausible=(1e-5, 2e-3),
    sentence='The guide of {subject} is bent or twisted: its carriage turns along the way.',
    separate_by='the same places of the slide with the marker near its carriage and far from it',
    remedy='Have the rail aligned anew (bent or twisted between its bolts) with a level along it.',
    size=_turns_by,
    candidates=candidates,
    in_family=lambda candidate: len(candidate.variant) > 1,
)
