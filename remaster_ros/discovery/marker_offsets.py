"""Markers that are not at their stated place: judged by how far the fit moved them.

The offsets model fits the markers, so a wrong one leaves no residuals. Let I be the information of
the data alone on a marker's position, everything else fitted, and d̂ their estimate. If the stated
place is right to s per axis, then u = I (d̂ − stated) ~ N(0, I + s² I²).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy
from scipy.special import expit

from remaster_ros.calibration.estimate import Estimate
from remaster_ros.calibration.gauge_words import the
from remaster_ros.calibration.noise import Noise
from remaster_ros.discovery.effects.base import Candidate
from remaster_ros.discovery.effects.marker_offset import EFFECT as MARKER_OFFSET
from remaster_ros.discovery.effects.sizes import number
from remaster_ros.discovery.explain import FoundEffect, Parameter
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.surface import KIND_ODDS
from remaster_ros.types import BoolArray, FloatArray, Priors, Session

# The prior pulls the fitted marker back: its true place may be this many times further off.
FURTHER = 3.0
# Family-wise error over all markers.
SIGNIFICANCE = 0.002
# A direction counts where the data determine it so many times better than the session states it,
# in variance.
KNOWN_BETTER = 4.0
# Directions of columns below this share of the largest are rounding.
ROUNDING = 1e-9
# An axis of the tool with this share in directions that the data leave open is called hidden.
HIDDEN = 0.1


def moved_markers(
    found: Estimate, data: Residuals, noise: Noise, causes: Sequence[Candidate]
) -> tuple[FoundEffect, ...]:
    """Return an effect for every marker whose fitted place is beyond its stated accuracy.

    () if there is none. ``found``: fit with offsets; ``data``: its residuals; ``causes``:
    candidates that are fitted beside the markers.
    """
    model, problem = found.model, found.problem
    x = model.natural(found.mode.z)
    jacobian = model.natural_jacobian(x, data.rows)
    columns = data.columns(causes)
    joined = np.concatenate((jacobian, columns), axis=2)
    white = data.noise_model.whitened(joined, noise).reshape(3 * len(data), -1)
    error = data.noise_model.whitened(data.errors, noise).ravel()
    std = max(problem.session.marker_std_m, 1e-6)
    effects = []
    for index, name in enumerate(problem.marker_names):
        where = model.marker(index)
        other_columns = np.delete(white, np.arange(where.start, where.stop), axis=1)
        marker_columns = white[:, where]
        marker_columns = marker_columns - _projected(other_columns, marker_columns)
        information = marker_columns.T @ marker_columns
        # Estimate of the data alone: the fitted place plus the step without the prior.
        moved = x[where] - problem.markers[index]
        pull = marker_columns.T @ error + information @ moved
        values, axes = np.linalg.eigh(information)
        seen = values * std**2 > KNOWN_BETTER
        if not seen.any():
            continue
        u = axes[:, seen].T @ pull
        spread = np.diag(values[seen])
        square = float(u @ np.linalg.solve(spread + np.diag((values[seen] * std) ** 2), u))
        p_value = float(scipy.special.chdtrc(seen.sum(), square))
        if p_value * len(problem.marker_names) > SIGNIFICANCE:
            continue
        inverse = axes[:, seen] / values[seen]
        by_data = inverse @ u
        covariance = inverse @ spread @ inverse.T + _unseen(
            by_data, problem.markers[index], axes, seen
        )
        blind = np.sum(axes[:, ~seen] ** 2, axis=1) > HIDDEN
        effects.append(_effect(name, by_data, covariance, blind, p_value, square, int(seen.sum())))
    return tuple(effects)


def loosened(session: Session, moved: Sequence[FoundEffect]) -> Priors | None:
    """Return marker priors wide enough for the offsets found; None if no marker moved.

    Only the markers of ``moved`` have one, at their stated place.
    """
    places = {}
    for effect in moved:
        if effect.name == MARKER_OFFSET.name:
            name = effect.parameters[0].name.removeprefix('x_')
            std = float(np.hypot(session.marker_std_m, FURTHER * (effect.size_m or 0.0)))
            places[name] = (session.markers[name], std)
    return Priors(markers=places) if places else None


def _unseen(moved: FloatArray, place: FloatArray, axes: FloatArray, seen: BoolArray) -> FloatArray:
    """Return the covariance of a marker's place due to directions that the data leave open.

    m², (3, 3). In each open direction the standard deviation is that of the estimated move in
    one of the determined directions. ``moved``: estimated move, m, (3,); ``place``: stated, in
    the tool frame, m, (3,); ``axes``: orthonormal directions as columns; ``seen``: mask of those
    that the data determine.
    """
    typical = np.sum(moved**2) / max(1, int(seen.sum()))
    hidden = axes[:, ~seen]
    covariance = typical * hidden @ hidden.T
    radius = np.linalg.norm(place[:2])
    if hidden.shape[1] and radius > 0.0:
        inward = np.append(place[:2] / radius, 0.0)
        covariance += 0.5 * (typical / radius) ** 2 * np.outer(inward, inward)
    return covariance


def _projected(basis: FloatArray, columns: FloatArray) -> FloatArray:
    """Return the projection of columns (r, c) on the span of the columns of a basis, (r, b).

    The columns of the basis may be linearly dependent.
    """
    scale = np.linalg.norm(basis, axis=0)
    unit = basis / np.where(scale > 0.0, scale, 1.0)
    # By pivoted QR: the singular values would take three times as long.
    fit, *_ = scipy.linalg.lstsq(
        unit, columns, cond=ROUNDING, check_finite=False, lapack_driver='gelsy'
    )
    explained: FloatArray = unit @ fit
    return explained


def _effect(
    name: str,
    moved: FloatArray,
    covariance: FloatArray,
    blind: BoolArray,
    p_value: float,
    square: float,
    rank: int,
) -> FoundEffect:
    """Description of a marker that is not at its stated place, as a cause.

    ``moved``: by how much, m, (3,), with its ``covariance``, (3, 3); ``blind``: axes of the
    tool along which the poses determine the move only in part; ``square``, ``rank``:
    chi-square of the move and its degrees of freedom.
    """
    effect = MARKER_OFFSET
    cause = effect.sentence.format(subject=the('marker', name))
    cause = cause[:1].upper() + cause[1:]
    if blind.any():
        unseen = ' and '.join(axis for axis, hidden in zip('xyz', blind, strict=True) if hidden)
        cause += (
            f' How far along {unseen} of the tool these poses determine only in part: '
            'around the last axis it trades with the zero-offset.'
        )
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    way = float(np.linalg.norm(moved))
    off = number(1e3 * way, 1e3 * float(np.sqrt(moved @ covariance @ moved)) / way, ' mm')
    return FoundEffect(
        name=effect.name,
        joints=(),
        place=effect.place,
        driver=effect.driver,
        form=effect.form,
        parameters=tuple(
            Parameter(f'{axis}_{name}', float(v), float(s), effect.unit)
            for axis, v, s in zip('xyz', moved, std, strict=True)
        ),
        p_value=p_value,
        log_evidence_gain=0.5 * (square - rank),
        probability=float(expit(0.5 * (square - rank) + np.log(KIND_ODDS))),
        confusable_with=(),
        cause=cause,
        size_m=way,
        sizes=(f'{name} is {off} away from it',),
        remedy=effect.remedy,
        title='Marker offset' if name == 'marker' else f'Marker offset of {name}',
        of_measurement=True,
    )
