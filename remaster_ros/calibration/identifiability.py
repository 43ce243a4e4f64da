# SPDX-License-Identifier: Apache-2.0
"""Which combinations of parameters the data do not determine, and what fixes each of them.

The null space of the data's Jacobian (priors left out) over every parameter group, found
numerically for the data at hand. A direction that a proper prior resolves is left to the prior;
any other is fixed by holding one joint at zero. Directions that the data determine badly are
reported as well.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from remaster_ros.calibration.gauge_words import (
    EFFECTS_PRIOR,
    in_words,
    resolving_priors,
    together,
)
from remaster_ros.calibration.grouped_rows import Rows
from remaster_ros.calibration.initial_guess import robust_spread
from remaster_ros.calibration.model import Model
from remaster_ros.calibration.priors import Prior, prior_rows
from remaster_ros.errors import InsufficientDataError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.linear_algebra import svd
from remaster_ros.types import BoolArray, FloatArray, IntArray

# Singular values (of unit columns, relative to the largest) that are rounding errors.
ROUNDING = 1e-9
# An angle with a larger standard deviation counts as unknown: over such a range neither the
# prediction nor a prior is linear. Of a joint that slides as much as such an angle does at
# `LEVER_M`, here and in what follows.
UNKNOWN_ANGLE = np.radians(5.0)
# An offset with a standard deviation above this, and this many times that of the median one, is
# reported as badly determined, with the parts of its direction above this share of the largest.
WEAK_ANGLE = np.radians(0.2)
WEAK_FACTOR = 5.0
WEAK_SHARE = 0.1
# A mastering is off by tenths of a degree: an offset known worse than this is not measured.
OPEN_ANGLE = np.radians(1.0)
# An offset that a prior determines counts as identifiable where its standard deviation is at most
# so many times the median of those that the data determine.
AS_GOOD_AS_SEEN = 2.0
# Entries of a direction below this share of its largest are rounding errors.
NEGLIGIBLE = 1e-5
# Rows whose derivatives are at hand at a time.
BLOCK_ROWS = 2_000


@dataclass(frozen=True)
class GaugeDirection:
    """A combination of parameters that can change without any change in the data."""

    # How far each parameter moves, rad and m, the largest entry 1. Registrations are corrections
    # of the robot's points on their way to the sensor, along the axes of R and about its origin
    # (see `model`).
    combination: Mapping[str, float]
    why: str  # The same as a sentence for the report
    fixed_by: str  # What decides where on the direction the result lies


@dataclass(frozen=True)
class Gauge:
    """All of the directions, and what follows for the joints."""

    directions: tuple[GaugeDirection, ...]  # One per dimension of the null space
    # Indices of the joints held at zero and of the effects held where they were linearised, (h,)
    held: IntArray
    # For each joint what the data do not distinguish its offset from; '' where it is determined, k
    # strings
    why: tuple[str, ...]


def find_gauge(
    model: Model,
    x: FloatArray,
    rows: Rows,
    priors: Sequence[Prior],
) -> Gauge:
    """Find the null space at a solution, name it, and fix what no prior does.

    Parameters
    ----------
    model, rows, priors
        What is fitted, to which rows, and what is known beforehand.
    x
        Natural parameters, (size,).

    Raises
    ------
    InsufficientDataError
        Where a registration or a marker is not determined: holding a joint does not help.
    """
    scale, null, pivots, weak = _null_space(model, x, rows)
    _, by_x = prior_rows(model, priors, x, natural=True)
    held = _unresolved(by_x @ null, pivots, model, scale)

    directions, why = [], [''] * model.joints
    resolving = resolving_priors(priors, x, null, model)
    for column, pivot in enumerate(pivots):
        if pivot in held:
            at = x[pivot] if pivot >= model.core else 0.0
            fixed_by = f'{model.names[pivot]} = {at:g}'
        else:
            fixed_by = resolving[column]
            if EFFECTS_PRIOR in fixed_by:
                # How large such errors are is known: how well the offsets then are is in `weak`.
                continue
        combination = _about_origin(model, null[:, column], scale)
        words = in_words(model, combination)
        directions.append(GaugeDirection(_entries(model, combination), words, fixed_by))
        for joint in np.flatnonzero(combination[: model.joints]):
            text = f'the data do not determine it: {words}; fixed by {fixed_by}'
            why[joint] = f'{why[joint]}; {text}' if why[joint] else text
    for along, worst, std in weak:
        directions.append(_badly_determined(model, along, worst, std, scale))
        if std > OPEN_ANGLE * model.chain.per_radian[worst] and not why[worst]:
            known = f'the data determine it only to {model.chain.shown_offset(worst, std)}'
            why[worst] = f'{known}: {directions[-1].why}'
    return Gauge(tuple(directions), np.array(sorted(held), dtype=np.int64), tuple(why))


def known_offsets(
    chain: SerialChain, why: tuple[str, ...], by_data: FloatArray, std: FloatArray
) -> tuple[BoolArray, tuple[str, ...]]:
    """Return which offsets are identifiable, (k,), and why the others are not.

    Those that the data determine, or a prior nearly as well; none that is known to no better than
    a degree once all is counted.

    ``chain``: the k joints; ``why``: of each joint why the data do not determine its offset, ''
    where they do; ``by_data, std``: standard deviation by the model, and with what is known to be
    left out of it, rad or m, (k,).
    """
    by_data = by_data / chain.per_radian
    seen = np.array([not text for text in why])
    if not seen.any():
        return seen, why
    known: BoolArray = seen | (by_data <= AS_GOOD_AS_SEEN * np.median(by_data[seen]))
    left_open = std > OPEN_ANGLE * chain.per_radian
    reasons = tuple(
        f'with what the model leaves out it is known only to {shown}: poses '
        'that are spread further and turn the tool would tell more'
        if hardly and not text
        else text
        for text, shown, hardly in zip(
            why,
            (chain.shown_offset(joint, width, 1) for joint, width in enumerate(std)),
            left_open,
            strict=True,
        )
    )
    return known & ~left_open, reasons


def _entries(model: Model, combination: FloatArray) -> dict[str, float]:
    return {
        name: round(float(value), 9)
        for name, value in zip(model.names, combination, strict=True)
        if value != 0.0
    }


def _badly_determined(
    model: Model, direction: FloatArray, joint: int, std: float, scale: FloatArray
) -> GaugeDirection:
    """Describe a direction along which a joint's offset has a large ``std``, rad or m."""
    size = np.abs(direction * scale)
    main = np.where(size > WEAK_SHARE * size.max(), direction, 0.0)
    main[joint] = direction[joint]
    combination = _about_origin(model, main, scale)
    words = (
        f'{together(model, combination)} hardly change the observations; poses that are spread '
        f'further and turn the tool, or a prior on {model.names[joint]}, would separate them'
    )
    known = f'the data, though {model.names[joint]} only to {model.chain.shown_offset(joint, std)}'
    return GaugeDirection(_entries(model, combination), words, known)


def _null_space(
    model: Model, x: FloatArray, rows: Rows
) -> tuple[FloatArray, FloatArray, list[int], list[tuple[FloatArray, int, float]]]:
    """Return the scale of each parameter, a basis of the null space, (size, d), and its pivots.

    Last come the badly determined joints: direction, index and standard deviation, rad or m.
    """
    triangle = _triangle(model, x, rows)
    scale = np.linalg.norm(triangle, axis=0)
    # The scale of what the data do not determine is that of its prior, else the largest of all.
    unseen = np.full(model.size, scale.max())
    if model.extension is not None:
        known = np.sqrt(np.diag(model.extension.prior_precision))
        unseen[model.core :] = np.where(known > 0.0, known, scale.max())
    scale = np.where(scale > ROUNDING * scale.max(), scale, unseen)
    triangle = triangle / scale
    _, singular, vectors = svd(triangle, full_matrices=True)
    rank = np.count_nonzero(singular >= ROUNDING * singular[0])
    basis, pivots = _reduce(vectors[rank:].T.copy(), scale, _kinds(model))
    # For what is badly determined a prior on effects counts as data: it separates them.
    root = np.zeros((len(model.extension_root), model.size))
    root[:, model.core :] = model.extension_root
    triangle = np.asarray(np.linalg.qr(np.concatenate((triangle, root / scale)), 'r'))
    for direction, pivot, _ in _nearly_null(
        triangle, scale, pivots, _angles(model), _per_radian(model), UNKNOWN_ANGLE
    ):
        basis = np.column_stack((basis, direction))
        pivots.append(pivot)
    joints = np.arange(model.size) < model.joints
    weak = _nearly_null(
        triangle, scale, pivots, joints, _per_radian(model), WEAK_ANGLE, WEAK_FACTOR
    )
    return scale, basis, pivots, weak


def _triangle(model: Model, x: FloatArray, rows: Rows) -> FloatArray:
    """Return R of the data's Jacobian J = Q R in units of their spread, (size, size) at most.

    From blocks of rows, so that memory does not grow with their number.
    """
    errors = rows.target - model.predict(model.pinned(x), rows)
    spread = np.ones(len(model.sensor_names) + len(rows.turning))
    spread[[sensor for sensor, _ in rows.spans]] = robust_spread(errors, rows)
    triangle = np.zeros((0, model.size))
    for first, last in rows.blocks(BLOCK_ROWS):
        block = rows.of_groups(first, last)
        derivative = model.natural_jacobian(x, block)
        for sensor, span in block.spans:
            derivative[span] /= spread[sensor]
        stacked = np.concatenate((triangle, derivative.reshape(-1, model.size)))
        triangle = np.asarray(np.linalg.qr(stacked, mode='r'))
    return triangle


def _nearly_null(
    triangle: FloatArray,
    scale: FloatArray,
    pivots: list[int],
    angles: BoolArray,
    per_radian: FloatArray,
    limit: float,
    factor: float = 0.0,
) -> list[tuple[FloatArray, int, float]]:
    """Return the directions along which an angle has a standard deviation above a limit, rad.

    The zeros of joints that slide are among the angles, ``per_radian`` of the parameters' units,
    (size,). It is above a factor times the median of all angles as well, or above `OPEN_ANGLE`.
    With the pivots of the null space held the rest has a covariance; its column of the worst angle
    is how everything moves with that angle. Then that one is held too.
    """
    found = []
    active = ~np.isin(np.arange(len(scale)), pivots)
    while np.any(active & angles):
        root = np.linalg.inv(np.linalg.qr(triangle[:, active], mode='r'))
        covariance = (root @ root.T) / np.outer(scale[active], scale[active])
        own = np.sqrt(np.diag(covariance)) / per_radian[active]
        std = np.where(angles[active], own, 0.0)
        worst = int(np.argmax(std))
        typical = float(np.median(std[angles[active]]))
        if std[worst] < limit or std[worst] < min(factor * typical, OPEN_ANGLE):
            break
        direction = np.zeros(len(scale))
        direction[active] = covariance[worst] / covariance[worst, worst]
        pivot = int(np.flatnonzero(active)[worst])
        found.append((direction, pivot, float(std[worst] * per_radian[pivot])))
        active[pivot] = False
    return found


def _angles(model: Model) -> BoolArray:
    """Return which of the model's parameters are angles, (size,); effects are not counted."""
    angles = np.arange(model.size) < model.joints
    for sensor in range(len(model.sensor_names)):
        angles[model.registration(sensor)][3:] = True
    angles[model.markers_end : model.core] = True
    return angles


def _per_radian(model: Model) -> FloatArray:
    """Return how much of each parameter counts as a radian, (size,): 1 but of what slides."""
    return np.append(model.chain.per_radian, np.ones(model.size - model.joints))


def _kinds(model: Model) -> tuple[IntArray, ...]:
    """Return the indices of effects, joints, tools and registrations: the order of pivots."""
    end = model.joints + 6 * len(model.sensor_names)
    return (
        np.arange(model.core, model.size),
        np.arange(model.joints),
        np.arange(end, model.core),
        np.arange(model.joints, end),
    )


def _reduce(
    work: FloatArray, scale: FloatArray, kinds: tuple[IntArray, ...]
) -> tuple[FloatArray, list[int]]:
    """Bring a basis (size, d) to reduced echelon form: one pivot each, 1 there, 0 in the others.

    The basis comes in units of the scale (size,) and is returned in those of the parameters. So
    each direction has few parameters: any rotation of the basis spans the same space.
    """
    pivots: list[int] = []
    for column in range(work.shape[1]):
        size = np.abs(work[:, column:])
        least = NEGLIGIBLE * size.max()
        for kind in kinds:
            part = size[kind]
            if part.max(initial=0.0) > least:
                break
        row, offset = divmod(int(np.argmax(part)), part.shape[1])
        pivot = int(kind[row])
        pivots.append(pivot)
        work[:, [column, column + offset]] = work[:, [column + offset, column]]
        work[:, column] /= work[pivot, column]
        others = work[pivot].copy()
        others[column] = 0.0
        work -= np.outer(work[:, column], others)
    null = work / scale[:, None]
    null /= null[pivots, np.arange(len(pivots))]
    return null[:, np.argsort(pivots)], sorted(pivots)


def _unresolved(
    by_direction: FloatArray, pivots: list[int], model: Model, scale: FloatArray
) -> set[int]:
    """Return the pivots that no prior resolves; all of them must be joints or effects, to be held.

    A pivot counts as unknown from a certain standard deviation by the priors on. For an effect, of
    any unit, that is a million times what the data would leave it if it were alone.
    """
    limit = np.where(_angles(model), UNKNOWN_ANGLE * _per_radian(model), 1e3)
    limit[model.core :] = 1e6 / scale[model.core :]
    held: set[int] = set()
    while True:
        active = [column for column, pivot in enumerate(pivots) if pivot not in held]
        std = _standard_deviations(by_direction[:, active])
        loose = {pivots[c]: s for c, s in zip(active, std, strict=True) if s > limit[pivots[c]]}
        if not loose:
            return held
        # All of the effects are held at once: their units cannot be compared.
        effects = {pivot for pivot in loose if pivot >= model.core}
        joints = {pivot: s for pivot, s in loose.items() if pivot < model.joints}
        if not effects and not joints:
            raise InsufficientDataError(
                f'the observations do not determine {", ".join(model.names[p] for p in loose)}; '
                'measure poses that are spread further and turn the tool'
            )
        held |= effects or {max(joints, key=lambda j: joints[j] / model.chain.per_radian[j])}


def _standard_deviations(by_direction: FloatArray) -> FloatArray:
    """Return how far priors (m rows) let each direction (d columns) go, (d,); inf without any."""
    norm = np.linalg.norm(by_direction, axis=0)
    held = norm > 0.0
    unit = by_direction[:, held] / norm[held]
    values, vectors = np.linalg.eigh(unit.T @ unit)
    # Directions that only one and the same prior holds are nearly free of each other.
    variance = (vectors**2) @ (1.0 / np.maximum(values, 1e-14))
    std = np.full(len(norm), np.inf)
    std[held] = np.sqrt(variance) / norm[held]
    return std


def _about_origin(model: Model, direction: FloatArray, scale: FloatArray) -> FloatArray:
    """Turn corrections about the centroids into ones about the origin of R; scale and clean up."""
    size = np.abs(direction * scale)
    moved = np.where(size > NEGLIGIBLE * size.max(), direction, 0.0)
    for sensor, centroid in enumerate(model.centroid):
        part = moved[model.registration(sensor)]
        part[:3] -= np.cross(part[3:], centroid)
    moved[np.abs(moved) < NEGLIGIBLE * np.abs(moved).max()] = 0.0
    # The pivot has the value 1 already; it stays positive where it is as large as any other.
    largest = np.abs(moved).max()
    if largest > 1.0 + 1e-6:
        moved /= moved[np.argmax(np.abs(moved))]
    return moved
