"""Base compliance: the arm's weight tips the stand it is bolted to."""

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
    """Yield two candidates: one compliance for all directions; one each about axes x and y."""
    x, y, z = np.eye(3)
    for variant, axes, parameters in (
        ('isotropic', [x + y + z], ['base_compliance']),
        ('by axis', [x, y], ['base_compliance_x', 'base_compliance_y']),
    ):
        yield EFFECT.candidate(
            partial(_tipped, axes=axes), parameters, drawn_from=2, variant=variant
        )


def _tipped(context: Context, axes: list[FloatArray]) -> Design:
    """Return columns of a base that turns in proportion to gravity's torque, rad/(N m).

    One column for each of ``axes``, (3,): the torque's components are multiplied by it.
    """
    return turned(context, [context.base_moment * axis for axis in axes], np.zeros(3))


def _tips(context: Context, candidate: Candidate, draws: FloatArray) -> str:
    """Phrase for the angle by which the base tips under the largest torque of the arm's weight.

    ``draws``: of the compliance, rad/(N m), (draws, 1), or about x and y, (draws, 2).
    """
    moment = largest(np.linalg.norm(context.base_moment, axis=1))
    about = candidate.parameters if candidate.size > 1 else ('',)
    return ' and '.join(
        f'base and first links tip by {angle(draws[:, i] * moment)} under {moment:.0f} N m'
        + (f' about {name[-1]}' if name else '')
        for i, name in enumerate(about)
    )


EFFECT = Effect(
    name='base_compliance',
    place='base_rotation',
    driver='gravity_moment',
    form='linear',
    equation='δp = (c M(q)) × p, M = Σ r × m g about the origin of R',
    source='Nubiola & Bonev 2013, Robot. Comput.-Integr. Manuf. 29 (base and stiffness)',
    unit='rad/(N m)',
    plausible=(1e-7, 1e-4),
    sign=1,
    sentence='Base or first links give way under the weight of the arm (loose bolts, a soft '
    'stand, or the arm itself).',
    separate_by='the same poses at several angles of joint 1, with and without a payload',
    remedy='Hold a dial gauge between the ground and the foot of the arm while it stretches. A '
    'foot that tips shows loose bolts or a soft stand: tighten or stiffen them. Where it does not '
    'tip, or another arm of the type on another stand gives way as much, it is the arm: its '
    'bearings and first links give way, no bolt changes that, and it can only be corrected.',
    size=_tips,
    candidates=candidates,
    changes=switched,
    needs=needs_gravity,
)
