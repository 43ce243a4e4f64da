"""Link length: a joint's axis lies elsewhere on the link before it than drawn."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from remaster_ros.discovery.effects.base import (
    Candidate,
    Design,
    Effect,
    ModelChange,
    displaced,
)
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.sizes import along_mean, length
from remaster_ros.types import FloatArray


def candidates(context: Context) -> Iterator[Candidate]:
    """Yield a candidate for each link from joint j to j + 1 and each of its `link_directions`."""
    for link in context.links():
        directions = link_directions(context, link)
        for axis, direction in directions.items():
            yield EFFECT.candidate(
                partial(_shifted, link=link, direction=direction),
                [f'length_{link}' if axis == 'along' else f'offset_{axis}_{link}'],
                joints=(link,),
                drawn_from=len(context.links()) * len(directions),
                variant=axis,
                model_change=ModelChange(link, direction[None], np.zeros((1, 3))),
            )


def _shifted(context: Context, link: int, direction: FloatArray) -> Design:
    """Return the column of a shift along a direction of the link's frame, m per m.

    ``link``: 1-based, of the joint that moves it; ``direction``: unit vector, (3,).
    """
    return displaced(context.link_rotation(link) @ direction)


def link_directions(context: Context, link: int) -> dict[str, FloatArray]:
    """Return unit vectors of a link's frame by name: 'along' the link, and axes 'x', 'y', 'z'.

    Axes parallel to the link are left out; 'along' is, if the link is shorter than 1 mm.
    """
    shift = context.chain.T_fixed[link][:3, 3]
    length = np.linalg.norm(shift)
    axes = dict(zip('xyz', np.eye(3), strict=True))
    if length < 1e-3:
        return axes
    along = shift / length
    parallel = {name for name, axis in axes.items() if abs(axis @ along) > 0.999}
    return {
        'along': along,
        **{name: axis for name, axis in axes.items() if name not in parallel},
    }


def _longer(context: Context, candidate: Candidate, draws: FloatArray) -> str:
    """Phrase for how much longer or shorter a link is than modelled, or how far off it ends.

    ``draws``: of the length or shift along an axis, m, (draws, 1).
    """
    link, value, size = candidate.joints[0], draws[:, 0], length(along_mean(draws[:, :1]))
    if candidate.variant == 'along':
        longer = 'longer' if value.mean() >= 0.0 else 'shorter'
        return f'link {link} is {size} {longer} than the model'
    side = '+' if value.mean() >= 0.0 else '−'
    return f'link {link} ends {size} off, along {side}{candidate.variant} of its frame'


EFFECT = Effect(
    name='link_length',
    place='link_translation',
    driver='constant',
    form='constant',
    equation='δp = R_j(q) d, d in the frame of the link that joint j moves',
    source='Hayati & Mirmirani 1985, J. Robotic Systems 2; Everett et al. 1987',
    unit='m',
    plausible=(1e-5, 5e-3),
    sentence='After {subject} the link is longer, shorter or offset against its drawing.',
    separate_by='poses that fold and stretch the arm, with the tool turned at each',
    remedy='Load apply/robot_model.urdf: lengths, with the zero-offsets that belong to them.',
    size=_longer,
    candidates=candidates,
    in_family=lambda candidate: candidate.size == 1,
)
