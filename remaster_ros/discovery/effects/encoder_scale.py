"""Encoder scale: a joint turns or slides a little more than it reports, in proportion."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from remaster_ros.discovery.effects.base import Candidate, Effect
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.sizes import along_mean, number, of_joint, span_of
from remaster_ros.types import FloatArray


def candidates(context: Context) -> Iterator[Candidate]:
    """Yield a candidate for each joint that moved: δq_j = s_j q_j, q_j as measured."""
    return EFFECT.at_joints(
        context,
        context.moving,
        lambda context, joint: [context.measurements.q[:, joint - 1]],
        ['scale_{joint}'],
        drawn_from=context.joints,
    )


def _scaled(context: Context, candidate: Candidate, draws: FloatArray) -> str:
    """Phrase for how much more or less a joint moves than it reports, and over the span measured.

    ``draws``: of the scale error, (draws, 1).
    """
    joint, scale = candidate.joints[0], draws[:, 0]
    more = 'more' if scale.mean() >= 0.0 else 'less'
    span = np.ptp(context.measurements.q[:, joint - 1])
    # Of a slide in mm a metre, as screws and scales are specified.
    times, unit = (1e3, ' mm a metre') if candidate.slide else (100.0, ' %')
    share = number(times * np.abs(scale.mean()), times * scale.std(), unit)
    return (
        f'joint {joint} {"slides" if candidate.slide else "turns"} {share} {more} '
        'than it reports, '
        f'{of_joint(context, joint, along_mean(draws[:, :1]) * span)} over the '
        f'{span_of(context, joint, span)} that it took'
    )


EFFECT = Effect(
    name='encoder_scale',
    place='joint_angle',
    driver='own_angle',
    form='linear',
    equation='δq_j = s_j q_j',
    source='Mooring, Roth & Driels 1991, Fundamentals of Manipulator Calibration, ch. 2',
    unit='rad/rad',
    plausible=(1e-6, 1e-2),
    sentence='The true turn of {subject} is not what is reported (gear ratio or encoder scale).',
    separate_by='poses that move the joint through its whole range',
    remedy='Check the gear ratio and the encoder resolution that are set in the controller.',
    slide_sentence='The true way of {subject} is not what is reported (lead of the screw, pinion '
    'of the rack, or scale).',
    slide_remedy='Check the lead, the gear ratio and the resolution of the scale that are set in '
    'the controller.',
    size=_scaled,
    candidates=candidates,
)
