"""The folder ``apply`` of a discovery: zero-offsets, and what else a robot model can hold."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from remaster_ros.compensation.export import GEOMETRY_FILE, Geometry, exports
from remaster_ros.discovery.discover import Discovery
from remaster_ros.discovery.explain import FoundEffect
from remaster_ros.discovery.words import sentence_case


def applied(discovery: Discovery) -> dict[str, str]:
    """Return the files: name -> text."""
    return exports(discovery.fit, geometry_of(discovery))


def geometry_of(discovery: Discovery) -> Geometry | None:
    """Return what of the causes a robot model holds; None without causes."""
    if not discovery.groups:
        return None
    fit = discovery.fit
    values = dict(zip(fit.theta_names, fit.theta, strict=True))
    shifts, turns = np.zeros((2, len(fit.chain), 3))
    held: list[FoundEffect] = []
    left: list[FoundEffect] = []
    for effect, group in zip(discovery.effects, discovery.groups, strict=False):
        changes = [cell.model_change for cell in group]
        (left if None in changes else held).append(effect)
        for cell, change in zip(group, changes, strict=True):
            if change is not None:
                theta = np.array([values[name] for name in cell.parameters])
                shifts[change.joint] += theta @ change.shifts
                turns[change.joint] += theta @ change.turns
    remarks = ['These zero-offsets belong to a model with the causes that discovery.json lists.']
    if held:
        remarks.append(
            f'The robot model holds of them: {_named(held)}. Ways 1 and 2 go with '
            f'{GEOMETRY_FILE}, which holds these and no offsets.'
        )
    if left:
        remarks.append(
            f'Corrected in none of these files: {_named(left)}. That takes a compensation between '
            'planner and controller. Where nothing but the zero-offsets is corrected, those of '
            '"remaster fit" leave less error.'
        )
    return Geometry(shifts, turns, tuple(remarks))


def _named(effects: Sequence[FoundEffect]) -> str:
    return ', '.join(sentence_case(effect.title) for effect in effects)
