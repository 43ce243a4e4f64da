# SPDX-License-Identifier: Apache-2.0
"""Combinations of parameters that the data do not determine, and their resolution.

The null space of the data's Jacobian (without priors) over all parameter groups, computed for the
data at hand. A direction that a proper prior resolves is left to the prior; any other is fixed by
holding one joint at zero. Directions that the data determine badly are reported as well.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from msgspec import Struct

from remaster_ros.calibration.gauge_words import (
    EFFECTS_PRIOR,
    combination_text,
    in_words,
    resolving_priors,
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
# prediction nor a prior is linear. For a prismatic joint angles count by `LEVER_M`, here and
# below.
UNKNOWN_ANGLE = np.radians(5.0)
# An offset with a standard deviation above this, and this many times that of the median one, is
# reported as badly determined, with the parts of its direction above this share of the largest.
WEAK_ANGLE = np.radians(0.2)
WEAK_FACTOR = 5.0
WEAK_SHARE = 0.1
# A mastering is off by tenths of a degree: an offset known worse than this is not measured.
OPEN_ANGLE = np.radians(1.0)
# An offset that a prior determines counts as identifiable if its standard deviation is at most
# this factor times the median of those that the data determine.
AS_GOOD_AS_SEEN = 2.0
# Entries of a direction below this share of its largest are rounding errors.
NEGLIGIBLE = 1e-5
# Rows whose derivatives are in memory at once.
BLOCK_ROWS = 2_000


class GaugeDirection(Struct, frozen=True):
    """Combination of parameters that can change without any change in the data."""

    # Change of each parameter, rad and m, the largest entry 1. Registrations are corrections of
    # the robot's points on their way to the sensor, along the axes of R and about its origin (see
    # `model`).
    combination: Mapping[str, float]
    why: str  # The same as a sentence for the report
    fixed_by: str  # Prior or joint at zero that decides the result along the direction


@dataclass(frozen=True)
class Gauge:
    """Parameter combinations that the data do not determine, and the parameters held for them."""

    directions: tuple[GaugeDirection, ...]  # One per dimension of the null space
    # Indices of the joints held at zero and of the effects held where they were linearised, (h,)
    held: IntArray
    # Reason for each joint whose offset the data do not determine; '' for the others, k strings
    why: tuple[str, ...]


def find_gauge(
    model: Model,
    x: FloatArray,
    rows: Rows,
    priors: Sequence[Prior],
) -> Gauge:
    """Find the null space at a solution, name it, and fix the directions that no prior fixes.

    Parameters
    ----------
    model, rows, priors
        The model, the fitted rows, and prior knowledge.
    x
        Natural parameters, (size,).

    Raises
    ------
    InsufficientDataError
        A registration or a marker is not determined, so that holding a joint does not help.
    """
    scale, null, pivots, weak = _null_space(model, x, rows)
    _, by_x = prior_rows(model, priors, x, natural=True)
    fixed_pivots = _unresolved(by_x @ null, pivots, model, scale)

    directions, why = [], [''] * model.joints
    resolving = resolving_priors(priors, x, null, model)
    for column, pivot in enumerate(pivots):
        if pivot in fixed_pivots:
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
    return Gauge(tuple(directions), np.array(sorted(fixed_pivots), dtype=np.int64), tuple(why))


def known_offsets(
    chain: SerialChain, why: tuple[str, ...], by_data: FloatArray, std: FloatArray
) -> tuple[BoolArray, tuple[str, ...]]:
    """Mask of the identifiable offsets, (k,), and the reason for each joint, k strings.

    Identifiable is an offset that the data determine, or that a prior determines to at most
    `AS_GOOD_AS_SEEN` times the median standard deviation of those that the data determine. An
    offset with a ``std`` above a degree never is, and none is if the data determine none.
    ``why``: reason for each joint that the data do not determine, '' for the others, which is
    returned with a reason added for offsets that only the std rules out. ``by_data``: standard
    deviations by the model, ``std``: with unmodelled errors added, rad or m, (k,).
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
    """Parameters of a direction (size,) that are not zero: name -> value, to 9 decimals."""
    return {
        name: round(float(value), 9)
        for name, value in zip(model.names, combination, strict=True)
        if value != 0.0
    }


def _badly_determined(
    model: Model, direction: FloatArray, joint: int, std: float, scale: FloatArray
) -> GaugeDirection:
    """Gauge direction along which a joint's offset has a large ``std``, rad or m.

    ``joint``: index from 0; ``scale``: root of the information on each parameter alone, (size,);
    in its units the direction's parts below a tenth of its largest (`WEAK_SHARE`) are left out.
    """
    size = np.abs(direction * scale)
    main = np.where(size > WEAK_SHARE * size.max(), direction, 0.0)
    main[joint] = direction[joint]
    combination = _about_origin(model, main, scale)
    words = (
        f'{combination_text(model, combination)} hardly change the observations; poses that are '
        'spread '
        f'further and turn the tool, or a prior on {model.names[joint]}, would separate them'
    )
    known = f'the data, though {model.names[joint]} only to {model.chain.shown_offset(joint, std)}'
    return GaugeDirection(_entries(model, combination), words, known)


def _null_space(
    model: Model, x: FloatArray, rows: Rows
) -> tuple[FloatArray, FloatArray, list[int], list[tuple[FloatArray, int, float]]]:
    """Null space of the data's Jacobian at natural parameters x, (size,).

    Returns the scale of each parameter (root of its information), (size,); a basis of d
    directions, (size, d), that the data do not determine, or an angle in them to no better than
    5 degrees; their pivots, the index of the parameter that stands for each; and badly
    determined joints, each with the direction, (size,), index and standard deviation, rad or m.
    """
    triangle = _triangle(model, x, rows)
    scale = np.linalg.norm(triangle, axis=0)
    # Parameters that the data do not determine have the scale of their prior, else the largest
    # one.
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
    """Triangle R of the decomposition J = Q R of the data's Jacobian, at most (size, size).

    Rows of J are divided by the robust spread of their sensor's errors. Computed from blocks of
    rows, so that memory does not grow with their number. ``x``: natural parameters, (size,).
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
    """Directions along which an angle has a standard deviation above a limit, the worst first.

    Returns (direction, (size,), 1 at the angle; parameter index of the angle; its std, rad or
    m) of each; [] if there is none. After each one its angle is taken as fixed, too. The std,
    rad, must reach ``limit``, rad, and also the smaller of `OPEN_ANGLE` and ``factor`` times
    the median std of the angles. ``triangle``: R of the QR decomposition of the data's
    Jacobian with the effects' prior, columns divided by ``scale``, (size,); ``pivots``:
    parameters taken as fixed; ``angles``: mask of the parameters that count as angles, zeros of
    prismatic joints among them; ``per_radian``: amount of each parameter that counts as a
    radian, (size,): 1 except for prismatic joints, in m.
    """
    found = []
    active = ~np.isin(np.arange(len(scale)), pivots)
    while np.any(active & angles):
        root = np.linalg.inv(np.linalg.qr(triangle[:, active], mode='r'))
        covariance = (root @ root.T) / np.outer(scale[active], scale[active])
        std_rad = np.sqrt(np.diag(covariance)) / per_radian[active]
        std = np.where(angles[active], std_rad, 0.0)
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
    """Mask of the parameters that count as angles, (size,): offsets and rotations.

    Zeros of joints that slide, and rotations of sensors and bodies, are among them; effects are
    not.
    """
    angles = np.arange(model.size) < model.joints
    for sensor in range(len(model.sensor_names)):
        angles[model.registration(sensor)][3:] = True
    angles[model.markers_end : model.core] = True
    return angles


def _per_radian(model: Model) -> FloatArray:
    """Amount of each parameter that counts as a radian, (size,): 1 except for prismatic joints."""
    return np.append(model.chain.per_radian, np.ones(model.size - model.joints))


def _kinds(model: Model) -> tuple[IntArray, ...]:
    """Indices of the parameters by kind, in the order in which kinds are taken as pivots.

    Four arrays: effects; joint offsets; markers and rotations of bodies; registrations.
    """
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
    """Basis (size, d) of a null space in reduced echelon form, and the pivot of each direction.

    A pivot is the index of a parameter that is 1 in its direction and 0 in all others. It is
    taken from the first of the ``kinds`` (indices of parameters, by preference) that have a
    part in the direction, and is the largest part of that kind. ``work``: the basis in units
    of the ``scale``, (size,), changed in place; the result is in units of the parameters. Any
    rotation of the basis spans the same space; in this form each direction has few parameters.
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
        pivot_row = work[pivot].copy()
        pivot_row[column] = 0.0
        work -= np.outer(work[:, column], pivot_row)
    null = work / scale[:, None]
    null /= null[pivots, np.arange(len(pivots))]
    return null[:, np.argsort(pivots)], sorted(pivots)


def _unresolved(
    by_direction: FloatArray, pivots: list[int], model: Model, scale: FloatArray
) -> set[int]:
    """Pivots of directions that no prior resolves, all of them joints or effects, to be fixed.

    A pivot is unresolved if its standard deviation by the priors is above a limit: 5 degrees
    (`UNKNOWN_ANGLE`) for an angle; 1000 m for another core parameter; for an effect, of any
    unit, a million times the std that the data would give if it were the only unknown (1 /
    ``scale``). ``by_direction``: derivative of the priors' whitened residuals along each
    direction, (m, d). Raises InsufficientDataError if only registrations or markers are
    unresolved.
    """
    limit = np.where(_angles(model), UNKNOWN_ANGLE * _per_radian(model), 1e3)
    limit[model.core :] = 1e6 / scale[model.core :]
    fixed_pivots: set[int] = set()
    while True:
        active = [column for column, pivot in enumerate(pivots) if pivot not in fixed_pivots]
        std = _standard_deviations(by_direction[:, active])
        loose = {pivots[c]: s for c, s in zip(active, std, strict=True) if s > limit[pivots[c]]}
        if not loose:
            return fixed_pivots
        # All of the effects are held at once: their units cannot be compared.
        effects = {pivot for pivot in loose if pivot >= model.core}
        joints = {pivot: s for pivot, s in loose.items() if pivot < model.joints}
        if not effects and not joints:
            raise InsufficientDataError(
                f'the observations do not determine {", ".join(model.names[p] for p in loose)}; '
                'measure poses that are spread further and turn the tool'
            )
        fixed_pivots |= effects or {
            max(joints, key=lambda j: joints[j] / model.chain.per_radian[j])
        }


def _standard_deviations(by_direction: FloatArray) -> FloatArray:
    """Standard deviation by the priors along each of d directions, (d,); inf without any.

    ``by_direction``: derivative of the priors' m whitened residuals along each, (m, d).
    """
    norm = np.linalg.norm(by_direction, axis=0)
    has_prior = norm > 0.0
    unit = by_direction[:, has_prior] / norm[has_prior]
    values, vectors = np.linalg.eigh(unit.T @ unit)
    # Directions that only one and the same prior holds are nearly free of each other.
    variance = (vectors**2) @ (1.0 / np.maximum(values, 1e-14))
    std = np.full(len(norm), np.inf)
    std[has_prior] = np.sqrt(variance) / norm[has_prior]
    return std


def _about_origin(model: Model, direction: FloatArray, scale: FloatArray) -> FloatArray:
    """Direction (size,) with registrations about the origin of R in place of the centroids.

    Entries below 1e-5 of the largest (`NEGLIGIBLE`; at first in units of ``scale``) are set to 0;
    if an entry exceeds 1, the largest is scaled to 1.
    """
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
