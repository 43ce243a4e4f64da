"""Marker offset: the marker is not at its stated place on the tool."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from remaster_ros.discovery.effects.base import Candidate, Design, Effect, displaced
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.sizes import up_to


def candidates(context: Context) -> Iterator[Candidate]:
    """Yield a candidate for each marker: a shift along each axis of the tool frame.

    As the offsets model fits the markers already, it is judged by how far that fit moved a marker
    against its stated accuracy.
    """
    for index, name in enumerate(context.marker_names):
        yield EFFECT.candidate(
            partial(_moved, marker=index),
            [f'{axis}_{name}' for axis in 'xyz'],
            drawn_from=len(context.marker_names),
            subject=name,
        )


def _moved(context: Context, marker: int) -> Design:
    """Return columns of a marker's shift along each tool axis; 0 in rows of other markers."""
    mine = (context.marker == marker)[:, None]
    return displaced(*(context.tool[:, :3, axis] * mine for axis in range(3)))


EFFECT = Effect(
    name='marker_offset',
    place='marker',
    driver='constant',
    form='constant',
    equation='δp = R_tool(q) d',
    source='eq. 8 of Van Wyk et al. with the marker as a parameter',
    unit='m',
    plausible=(1e-5, 2e-2),
    sentence='{subject} is not at its stated place on the tool.',
    separate_by='the marker measured against the tool plate, or the last joint turned by itself',
    remedy='Correct the place of the marker in session.yaml, or measure it against the tool '
    'plate.',
    size=up_to('{subject} is off'),
    candidates=candidates,
    moves_the_fit=True,
)
