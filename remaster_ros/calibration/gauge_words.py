# SPDX-License-Identifier: Apache-2.0
"""Sentences about directions that the data do not determine."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import compress

import numpy as np

from remaster_ros.calibration.model import Model
from remaster_ros.calibration.priors import Prior, prior_rows
from remaster_ros.types import FloatArray

# Largest numbers of parameters of a direction that a message names and lists; only those above
# this share of the largest are named.
MOST_NAMED, MOST_LISTED = 5, 20
LEAST_SHARE = 0.2
EFFECTS_PRIOR = 'the prior on the effects'
# The share of a parameter in a direction, or its displacement.
_AMOUNT = re.compile(r' \([+-][\d.e+-]+\)|(?: tangentially)?, [\d.]+ mm per degree')
_MOST_SHOWN = 2


def counted(number: int, what: str) -> str:
    """Number and noun: '1 pose', '2 poses'."""
    return f'{number} {what}{"" if number == 1 else "s"}'


def in_words(model: Model, direction: FloatArray) -> str:
    """Sentence on parameters that change together without effect, and how to separate them.

    ``direction``: change of each parameter, rad and m, (size,), 0 for those that do not change;
    joint 1 with registrations, and the last joint with markers or bodies, are named as such.
    """
    joints = np.flatnonzero(direction[: model.joints])
    sensors = [
        index
        for index in range(len(model.sensor_names))
        if np.any(direction[model.registration(index)])
    ]
    markers = [
        index for index in range(len(model.marker_names)) if np.any(direction[model.marker(index)])
    ]
    if len(joints) == 1 and not np.any(model.theta(direction)):
        joint, amount = model.names[joints[0]], direction[joints[0]]
        effects = np.flatnonzero(direction[model.core :]) + model.core
        if len(effects) and not sensors and not markers:
            return (
                f'{joint} offset = {_shortened([model.names[index] for index in effects])} '
                'changed '
                'together; only what is known of these effects beforehand separates them'
            )
        if not sensors and not markers:
            return f'{joint} moves no marker; a marker off its axis would show it'
        slides = model.chain.slides[joints[0]]
        shifted = not any(np.any(direction[model.registration(s)][3:]) for s in sensors)
        if slides and not markers and shifted:
            # A joint that no turning joint carries slides along the same line of R throughout.
            return (
                f'{joint} offset = a shift of the '
                f'{listed([model.sensor_names[s] for s in sensors])} registration'
                f'{"s" if len(sensors) > 1 else ""} along its axis; '
                'a known base frame (base_prior) would separate them'
            )
        if slides and not sensors:
            moved = [the('marker', model.marker_names[m]) for m in markers]
            return (
                f'{joint} offset = {listed(moved)} moved along its axis, as far; a measured '
                'marker would separate them'
            )
        if joints[0] == 0 and not markers:
            return (
                f'{joint} offset = a rotation of the '
                f'{listed([model.sensor_names[s] for s in sensors])} registration'
                f'{"s" if len(sensors) > 1 else ""} about the base axis; '
                'a known base frame (base_prior) would separate them'
            )
        bodies = [
            model.body_names[index]
            for index in range(len(model.bodies))
            if np.any(direction[model.body(index)])
        ]
        if joints[0] == model.joints - 1 and not sensors and bodies:
            per_degree = 1e3 * np.radians(1.0) / abs(amount)
            far = [
                f'{the("marker", model.marker_names[m])} moved '
                f'{per_degree * np.linalg.norm(direction[model.marker(m)]):.3f} mm per degree'
                for m in markers
            ]
            return (
                f'{joint} offset = {listed(bodies)} turned on the tool about the axis of {joint}'
                f'{" and " if far else ""}{listed(far)}; a known orientation of '
                f'{listed(bodies)} on the tool'
                f'{", or a measured marker," if far else ""} would separate them'
            )
        if joints[0] == model.joints - 1 and not sensors:
            per_degree = 1e3 * np.radians(1.0) / abs(amount)
            moved = [
                f'{the("marker", model.marker_names[m])} moved tangentially, '
                f'{per_degree * np.linalg.norm(direction[model.marker(m)]):.3f} mm per degree'
                for m in markers
            ]
            return f'{joint} offset = {listed(moved)}; a measured marker would separate them'
    return (
        f'{combination_text(model, direction)} change no observation; poses that are spread '
        'further and '
        'turn the tool, or a prior on one of them, would separate them'
    )


def combination_text(model: Model, direction: FloatArray) -> str:
    """Parameters of a direction (size,) that are not 0, with their values, as text.

    'a (+0.5), b (-0.5) together'; more than 20 are shortened.
    """
    moved = [
        f'{name} ({value:+.3g})'
        for name, value in zip(model.names, direction, strict=True)
        if value != 0.0
    ]
    return f'{_shortened(moved)} together'


def _shortened(parts: Sequence[str]) -> str:
    """Parts as a list in words; of more than 20 (`MOST_LISTED`) the first 5 and 'n more'."""
    if len(parts) > MOST_LISTED:
        excess = len(parts) - MOST_NAMED
        return listed([*parts[:MOST_NAMED], f'{excess} more'])
    return listed(parts)


def in_a_line(why: str) -> str:
    """Short form of a reason of `in_words` for a terminal.

    Amounts are left out, of more than 3 names the first 2 and the number of the others are
    kept, and of the remedies at most one.
    """
    cause, *remedies = why.split('; ')
    before, sign, after = _AMOUNT.sub('', cause).partition(' = ')
    text = after if sign else before
    names = re.split(r', | and ', text)
    if len(names) > _MOST_SHOWN + 1:
        text = f'{", ".join(names[:_MOST_SHOWN])} and {len(names) - _MOST_SHOWN} more'
    remedy = next((part for part in remedies if 'separate' in part or 'show' in part), '')
    looks = f'looks like {text}' if sign else text
    return f'{looks}; {remedy}' if remedy else looks


def hardly_seen(names: Sequence[str], loadings: FloatArray) -> str:
    """Parameters with the largest loadings (f,) of a direction, with their shares, as text.

    At most 5, with loadings above a fifth of the largest, largest first; shares are relative to
    it. A single one is its name alone. ``names``: of the parameters, f.
    """
    size = np.abs(loadings) / np.max(np.abs(loadings))
    order = [index for index in np.argsort(-size)[:MOST_NAMED] if size[index] > LEAST_SHARE]
    if len(order) == 1:
        return names[order[0]]
    largest = loadings[order[0]]
    parts = [f'{names[index]} ({loadings[index] / largest:+.2f})' for index in order]
    return f'{listed(parts)}, which change together'


def the(kind: str, name: str) -> str:
    """Name after its kind: 'the sensor mocap', for ``kind`` 'sensor' and ``name`` 'mocap'.

    'the sensor' if the name is the kind; the name alone, as 'sensor_2', if it begins with it.
    Case does not matter.
    """
    if name.lower() == kind:
        return f'the {kind}'
    return name if name.lower().startswith(kind) else f'the {kind} {name}'


def listed(parts: Sequence[str]) -> str:
    """Text such as 'a', 'a and b', 'a, b and c'; '' without parts."""
    if len(parts) < 2:
        return ''.join(parts)
    return f'{", ".join(parts[:-1])} and {parts[-1]}'


def resolving_priors(
    priors: Sequence[Prior], x: FloatArray, directions: FloatArray, model: Model
) -> list[str]:
    """Descriptions of the priors that fix each of d directions (size, d), one text each.

    A prior's pull is the norm of the derivative of its residuals along the direction. A text
    names all priors with more than a thousandth of the strongest pull; `EFFECTS_PRIOR` stands
    for the prior on the parameters of effects (``model.extension``). ``x``: parameters in
    natural coordinates, rad and m, (size,).
    """
    core = replace(model, extension=None)
    names = [*(prior.description for prior in priors), EFFECTS_PRIOR]
    rows = [prior_rows(core, [prior], x[: model.core], natural=True)[1] for prior in priors]
    pulls = [np.linalg.norm(row @ directions[: model.core], axis=0) for row in rows]
    effects = model.extension_root @ model.theta(directions.T).T
    holds = np.array([*pulls, np.linalg.norm(effects, axis=0)])
    holds = holds > 1e-3 * holds.max(axis=0)
    return [listed(list(dict.fromkeys(compress(names, row)))) for row in holds.T]
