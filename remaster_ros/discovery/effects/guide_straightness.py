# SPDX-License-Identifier: Apache-2.0
"""Straightness of a guide: the carriage of a joint that slides leaves the line of its way.

Two free curves of the place, across the way. Their straight line is a tilt of the joint's axis.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from remaster_ros.discovery.effects.base import Candidate, Design, Effect, displaced
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.drivers import angle_of
from remaster_ros.discovery.effects.sizes import at_most
from remaster_ros.discovery.effects.splines import Curve
from remaster_ros.types import FloatArray

# Knots over the range of the places, as of all free forms without a name (`unnamed.FREE_KNOTS`): a
# rail errs over the distance of its bolts, or more.
KNOTS = 10


@dataclass(frozen=True, eq=False)
class Guide:
    """Guide of a prismatic joint (1-based): spline of the errors along its way."""

    joint: int
    curve: Curve
    fields: dict[str, Any]  # Of its candidates

    @classmethod
    def each(cls, context: Context) -> Iterator[Guide]:
        """Yield the guide of each prismatic joint that moved in the rows to fit."""
        sliding = [joint for joint in context.moving if context.slides(joint)]
        for joint in sliding:
            driver = angle_of(context, joint)
            curve = driver.curve(context, 1.0 / KNOTS)
            fields = {'driver': driver.name, 'joints': (joint,), 'curve': curve, 'slide': True}
            yield cls(joint, curve, {**fields, 'drawn_from': len(sliding)})

    def features(self, context: Context) -> FloatArray:
        """Return the value of each free spline at the joint's place in each row, (n, m)."""
        return self.curve.columns(context.measurements.q[:, self.joint - 1])

    def parameters(self, *stems: str) -> list[str]:
        """Return names of parameters, one for each free spline and stem: 'guide_a_1_at_+200.0mm'.

        The stems of a spline stand next to each other.
        """
        return [
            f'{stem}_{self.joint}_at_{1e3 * place:+.1f}mm'
            for place in self.curve.places.tolist()
            for stem in stems
        ]

    def penalty(self, directions: int) -> FloatArray:
        """Return the roughness penalty of `directions` curves, one for each direction.

        (m × directions) square, m: free splines of a curve. Parameters of the same spline in all
        directions stand next to each other.
        """
        found: FloatArray = np.kron(self.curve.penalty, np.eye(directions)).astype(float)
        return found


def candidates(context: Context) -> Iterator[Candidate]:
    """Yield a candidate for each slide that moved: shifts in both directions across its way."""
    for guide in Guide.each(context):
        yield EFFECT.candidate(
            partial(_shifted, guide=guide),
            guide.parameters('guide_a', 'guide_b'),
            penalty=guide.penalty(2),
            **guide.fields,
        )


def _shifted(context: Context, guide: Guide) -> Design:
    """Return columns of a carriage that leaves its line: two shifts across it for each spline."""
    axis = context.chain.axes[guide.joint - 1]
    first = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    first /= np.linalg.norm(first)
    across = np.stack((first, np.cross(axis, first)), axis=1)
    directions = context.link_rotation(guide.joint) @ across
    features = guide.features(context)
    return displaced(
        *(features[:, [i]] * directions[:, :, a] for i in range(features.shape[1]) for a in (0, 1))
    )


def _off_the_line(context: Context, candidate: Candidate, draws: FloatArray) -> str:
    """Phrase for the largest shift of a carriage across its way.

    ``draws``: of the spline heights, m, (draws, 2 times splines).
    """
    (joint,) = candidate.joints
    size = at_most(context, candidate, draws)
    return f'the carriage of joint {joint} is off its line by up to {size}'


EFFECT = Effect(
    name='guide_straightness',
    place='link_translation',
    driver='own_place',
    form='free',
    equation='δp = R_j Σ_i B_i(q_j) (a w_ia + b w_ib), a and b across the axis of the slide',
    source='ISO 230-1 (straightness error motions of a linear axis)',
    unit='m',
    plausible=(1e-5, 2e-3),
    sentence='The guide of {subject} is not straight: its carriage leaves the line of the way.',
    separate_by='poses that step the slide along its way, all other joints held',
    remedy='Have the rail aligned anew, bolt by bolt, with a laser or a straight edge.',
    size=_off_the_line,
    candidates=candidates,
)
