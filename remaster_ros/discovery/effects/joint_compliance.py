"""Joint compliance: gravity's torque winds a joint up."""

from __future__ import annotations

from collections.abc import Iterator

from remaster_ros.discovery.effects.base import Candidate, Effect, needs_gravity
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.moments import switched
from remaster_ros.discovery.effects.sizes import largest, of_joint
from remaster_ros.types import FloatArray


def candidates(context: Context) -> Iterator[Candidate]:
    """Yield a candidate for each joint: δq_j = c_j τ_j, τ_j: gravity's torque (slide: force)."""
    return EFFECT.at_joints(
        context,
        range(1, context.joints + 1),
        lambda context, joint: [context.gravity_torque[:, joint - 1]],
        ['compliance_{joint}'],
        drawn_from=context.joints,
    )


def _turned(context: Context, candidate: Candidate, draws: FloatArray) -> str:
    """Phrase for a joint's deflection under its largest gravity torque (force, if it slides).

    ``draws``: of the compliance, rad/(N m) or m/N, (draws, 1).
    """
    joint = candidate.joints[0]
    torque = largest(context.gravity_torque[:, joint - 1])
    moved = of_joint(context, joint, draws[:, 0] * torque)
    verb, unit = ('slides', 'N') if candidate.slide else ('turns', 'N m')
    return f'joint {joint} {verb} {moved} under {torque:.0f} {unit}'


EFFECT = Effect(
    name='joint_compliance',
    place='joint_angle',
    driver='gravity_torque',
    form='linear',
    equation='δq_j = c_j τ_j(q), τ = axis · Σ (r × m g)',
    source='Spong 1987, J. Dyn. Sys. Meas. Control 109; Klodmann et al. 2011 (DLR LWR)',
    unit='rad/(N m)',
    plausible=(1e-6, 1e-3),
    sign=1,
    sentence='The weight carried winds up {subject} (soft gearbox or bearing).',
    separate_by='the same poses with and without a payload on the tool',
    remedy='Have the gearbox and the bearing of the joint checked for play and wear; correct '
    'what is left by the torque, and state the payload.',
    slide_sentence='The weight carried pushes {subject} along (a soft belt, rack or screw).',
    slide_remedy='Have belt, rack or screw and its bearings checked for play and wear; correct '
    'what is left by the force, and state the payload.',
    size=_turned,
    candidates=candidates,
    changes=switched,
    needs=needs_gravity,
)
