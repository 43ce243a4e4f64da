# SPDX-License-Identifier: Apache-2.0
"""Base tipping: a foot that does not bear lets the base rock from one place to another."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from remaster_ros.discovery.effects.base import Candidate, Design, Effect, needs_gravity, turned
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.sizes import angle
from remaster_ros.types import FloatArray

# Horizontal axes about which the base may rock, over half a turn.
AXES = 12
# Shares of the configurations in which the base lies on one side.
SHARES = (0.15, 0.25, 0.35, 0.5, 0.65, 0.75, 0.85)
# Finer: so many axes and shares about the best, each a fourth as far apart.
FINER = np.arange(-4, 5) / 4.0


def candidates(context: Context) -> Iterator[Candidate]:
    """Yield candidates of a base that rocks about an axis as a torque passes a threshold.

    One for each of `AXES` horizontal axes and each of `SHARES`: the threshold, N m, is that
    quantile of gravity's torque about the axis in the rows to fit.
    """
    for degrees in np.arange(AXES) * (180.0 / AXES):
        for share in SHARES:
            yield _candidate(context, float(degrees), share)


def _candidate(context: Context, degrees: float, share: float) -> Candidate:
    """Candidate of a base that rocks about a horizontal axis, `degrees` from x of the base frame.

    The threshold of gravity's torque about the axis, N m, is its quantile `share`, from 0 to 1,
    in the rows to fit.
    """
    level = float(np.quantile(context.base_moment[context.to_fit] @ _axis(degrees), share))
    return EFFECT.candidate(
        Rocking(degrees, level),
        ['base_tipping'],
        variant=f'{degrees:.2f}° from x, at {level:.1f} N m'.replace('-', '−'),
        drawn_from=AXES * len(SHARES),
    )


def finer(context: Context, candidate: Candidate) -> Iterator[Candidate]:
    """Yield base-tipping candidates on a finer grid of axes and torque thresholds about one.

    Axes are within 15 degrees of the candidate's; thresholds are quantiles within 0.1 of its
    own. AssertionError for a candidate of another effect.
    """
    best = candidate.columns
    assert isinstance(best, Rocking)
    share = float(np.mean(context.base_moment[context.to_fit] @ best.axis <= best.level))
    for turn in FINER * (180.0 / AXES):
        for shift in FINER * 0.1:
            if 0.05 < share + shift < 0.95:
                yield _candidate(context, best.degrees + float(turn), share + float(shift))


def _axis(degrees: float) -> FloatArray:
    """Return the horizontal unit vector at an angle from x of the base frame, degrees, (3,)."""
    return np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees)), 0.0])


@dataclass(frozen=True)
class Rocking:
    """Function that makes the columns of a base that rocks as a torque passes a threshold.

    The torque is gravity's about a horizontal axis of the base frame R.
    """

    degrees: float  # Of the horizontal axis, from x of R
    level: float  # N m

    @property
    def axis(self) -> FloatArray:
        """Unit vector of the horizontal axis in the base frame R, (3,)."""
        return _axis(self.degrees)

    def __call__(self, context: Context) -> Design:
        """Return the columns of a turn by 1 rad between both rests: ± 0.5 rad about the axis."""
        side = np.where(context.base_moment @ self.axis > self.level, 0.5, -0.5)
        return turned(context, [side[:, None] * self.axis], np.zeros(3))


def _rocks(context: Context, candidate: Candidate, draws: FloatArray) -> str:
    """Text on the angle by which the base rocks, by draws, rad, (draws, 1), and on its axis."""
    return f'the base rocks by {angle(draws[:, 0])} about an axis {candidate.variant}'


EFFECT = Effect(
    name='base_tipping',
    place='base_rotation',
    driver='gravity_moment',
    form='step',
    equation='δp = ± ½ θ n × p, + where the moment of the weight about n exceeds M₀',
    source='Nordin & Gutman 2002, Automatica 38 (play between two contacts)',
    unit='rad',
    plausible=(1e-6, 1e-2),
    sign=1,
    sentence='The base rocks as the arm reaches over (a foot does not bear, or loose bolts).',
    separate_by='a dial gauge at the foot while the arm reaches from one side to the other',
    remedy='Hold a dial gauge between the ground and each foot of the stand while the arm reaches '
    'from one side to the other; level the feet, tighten the bolts, and measure again.',
    size=_rocks,
    candidates=candidates,
    needs=needs_gravity,
    in_family=lambda candidate: False,
    finer=finer,
)
