"""Joint error curve: an error that follows the joint's own angle, or place, in any shape."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from remaster_ros.discovery.effects.base import Candidate, Design, Effect
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.drivers import angle_of
from remaster_ros.discovery.effects.sizes import ARC_MINUTE, MM, number
from remaster_ros.discovery.effects.splines import Curve
from remaster_ros.types import FloatArray

# The finest: gearbox errors have structure down to a few degrees; finer overfits any session.
FINEST_KNOTS = np.radians(4.0)
# Of what is plausible the most.
LARGEST_RAD = 5e-3
# Draws of the curve from which the uncertainty of its size is taken.
DRAWS = 200
# A shape with a name that explains as much is the better answer.
RARITY = 10
# Below this many configurations per knot the curve is coarser.
ROWS_PER_KNOT = 6.0


def candidates(context: Context) -> Iterator[Candidate]:
    """Yield a candidate for each joint that moved: a spline of its error over its own position."""
    configurations = len(np.unique(context.measurements.configuration[context.to_fit]))
    for joint in context.moving:
        driver, unit = angle_of(context, joint), context.chain.per_radian[joint - 1]
        curve = driver.curve(context, ROWS_PER_KNOT / configurations, unit * FINEST_KNOTS)
        shown = context.chain.shown_units[joint - 1]
        places = context.chain.shown_scale[joint - 1] * curve.places
        yield EFFECT.candidate(
            partial(_splines, joint=joint, curve=curve),
            [f'curve_{joint}_at_{place:+.1f}{shown}' for place in places],
            driver=driver.name,
            unit=driver.unit,
            largest=unit * LARGEST_RAD,
            slide=context.slides(joint),
            joints=(joint,),
            drawn_from=RARITY * context.joints,
            penalty=curve.penalty,
            curve=curve,
        )


def _splines(context: Context, joint: int, curve: Curve) -> Design:
    """Return columns of a curve of a joint's error over its own position, one for each height.

    Added joint position, rad or m per unit, (n, m); ``joint``: 1-based.
    """
    return Design(joint - 1, curve.columns(context.measurements.q[:, joint - 1]))


def _range(context: Context, candidate: Candidate, draws: FloatArray) -> str:
    """Phrase for the range and RMS of a joint's error curve, arc minutes (mm of a slide)."""
    joint = candidate.joints[0]
    values = candidate.columns(context).values
    unit_value, unit, digits = (MM, ' mm', 3) if candidate.slide else (ARC_MINUTE, '′', 1)
    middle = values @ draws.mean(axis=0) / unit_value
    rms = np.sqrt(np.mean((draws[:DRAWS] @ values.T / unit_value) ** 2, axis=1))
    ends = ' to '.join(f'{end:+.{digits}f}{unit}' for end in (middle.min(), middle.max()))
    size = number(float(np.sqrt(np.mean(middle**2))), float(rms.std()), unit)
    return f'joint {joint} errs by {ends}, {size} RMS'.replace('-', '−')


EFFECT = Effect(
    name='joint_error_curve',
    place='joint_angle',
    driver='own_angle',
    form='free',
    equation='δq_j = Σ_i w_i B_i(q_j), cubic B-splines, mean 0, smoothness by the evidence',
    source='Eilers & Marx 1996, Statistical Science 11 (P-splines)',
    unit='rad',
    plausible=(1e-6, LARGEST_RAD),
    sentence='The error of {subject} follows the angle of the same joint (gearbox or encoder).',
    separate_by='poses that step the joint through its range, all else held; '
    'with and without a payload',
    remedy='Correct the angle by the curve that was found, within the angles that were '
    'measured; where it grows from session to session, have gearbox and encoder '
    'checked.',
    slide_sentence='The error of {subject} follows the place of the same joint (pitch of its '
    'screw, rack or scale).',
    slide_remedy='Correct the place by the curve that was found, within the places that were '
    'measured; where it grows from session to session, have screw or rack checked.',
    size=_range,
    candidates=candidates,
)
