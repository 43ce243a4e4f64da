"""Zero-offsets and causes of two sessions next to each other, in standard deviations.

Both sessions have the same cells. What depends on where zero is put is compared on the range that
both have seen: a curve less its mean there, a zero-offset with what the causes add to the joint's
angle on the average there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from remaster_ros.calibration.estimate import Estimate
from remaster_ros.calibration.identifiability import WEAK_ANGLE
from remaster_ros.calibration.result import FitResult
from remaster_ros.discovery.common_range import Split
from remaster_ros.discovery.effects.base import Cell
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.drivers import driver_named
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Solution
from remaster_ros.types import FloatArray

# Fewer places leave nothing of a curve less its mean.
FEWEST_PLACES = 2


@dataclass(frozen=True)
class Compared:
    """One quantity in two sessions, in its unit.

    Attributes
    ----------
    name, unit
        Of a parameter or a joint.
    value, std
        Here.
    other_value, other_std
        In the other session.
    sigmas
        The difference, other less this, over the standard deviation of both together; NaN where
        that is zero.
    """

    name: str
    unit: str
    value: float
    std: float
    other_value: float
    other_std: float
    sigmas: float

    @classmethod
    def of(
        cls, name: str, unit: str, here: tuple[float, float], there: tuple[float, float]
    ) -> Compared:
        """Compare two pairs of value and standard deviation."""
        total = float(np.hypot(here[1], there[1]))
        sigmas = (there[0] - here[0]) / total if total > 0.0 else float('nan')
        return cls(name, unit, *here, *there, sigmas)


def rms_sigmas(rows: Sequence[Compared]) -> float:
    """Return the root mean square of the differences in standard deviations; NaN of none."""
    squares = [row.sigmas**2 for row in rows if not np.isnan(row.sigmas)]
    return float(np.sqrt(np.mean(squares))) if squares else float('nan')


def compare_offsets(
    fit: FitResult,
    found: Estimate,
    data: Residuals,
    own: Solution,
    parts: Sequence[Split],
) -> tuple[Compared, ...]:
    """Compare the zero-offsets that both sessions determine.

    Parameters
    ----------
    fit
        Of the first session, with its causes.
    found, data, own
        The other session: without causes, its residuals, and with the causes fitted to it.
    parts
        The cells of the causes on its rows.
    """
    k = found.model.joints
    by_base = _natural(data)[:k]
    # Mean of what each parameter adds to each joint's angle where it was seen.
    added = np.zeros((k, len(own.parameters)))
    here, here_draws = fit.joint_offsets.copy(), fit.joint_offset_draws.reshape(-1, k).copy()
    wheres = dict(zip(own.cells, own.slices(), strict=True))
    for part in parts:
        columns = part.within.columns(data.part)
        if columns.at is None:
            continue
        mean = columns.values[part.inside(data.part)].mean(axis=0)
        added[columns.at, wheres[part.within]] = mean
        theta, draws = _posterior(fit, part.cell)
        here[columns.at] += mean @ theta
        here_draws[:, columns.at] += draws @ mean
    there = found.model.offsets(found.model.natural(found.mode.z)) + by_base @ own.base
    there += added @ own.parameters
    joined = np.concatenate((by_base, added), axis=1)
    there_variance = np.einsum('ki,ij,kj->k', joined, own.full_covariance, joined)
    there_std = np.sqrt(there_variance)
    here_std = here_draws.std(axis=0, ddof=1)
    return tuple(
        Compared.of(
            name,
            'deg',
            (float(np.degrees(here[joint])), float(np.degrees(here_std[joint]))),
            (float(np.degrees(there[joint])), float(np.degrees(there_std[joint]))),
        )
        for joint, name in enumerate(fit.joint_names)
        if fit.identifiable[joint]
        and not found.gauge.why[joint]
        and max(here_std[joint], there_std[joint]) < WEAK_ANGLE
    )


def _natural(data: Residuals) -> FloatArray:
    """Return the step of the natural parameters per unit of each base column, (size, p)."""
    size = data.full_jacobian.shape[2]
    flat = data.full_jacobian[data.rows.source].reshape(-1, size)
    scale = np.linalg.norm(flat, axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    base = data.base.reshape(len(flat), -1)
    step: FloatArray = np.linalg.lstsq(flat / scale, base, rcond=1e-8)[0] / scale[:, None]
    return step


def compare_cell(
    fit: FitResult, part: Split, rows: Context, own: Solution
) -> tuple[Compared, ...]:
    """Compare the parameters of a cell: as they are, or a curve at its places.

    Parameters
    ----------
    fit
        Of the first session.
    part
        One of its cells on the rows of the other.
    rows
        Those rows.
    own
        The causes fitted to them.
    """
    cell = part.cell
    where = dict(zip(own.cells, own.slices(), strict=True))[part.within]
    theta, draws = _posterior(fit, cell)
    other = own.parameters[where]
    covariance = own.covariance[where, where]
    names = cell.parameters
    if cell.curve is not None:
        driver = driver_named(cell.driver, cell.joints[-1] if cell.joints else 0)
        assert driver is not None
        places = cell.curve.places
        seen = cell.curve.seen(places, 0.5)
        seen &= cell.curve.among(driver.value(rows)).seen(places, 0.5)
        if np.sum(seen) < FEWEST_PLACES:
            return ()
        heights = cell.curve.columns(places[seen])
        axes = cell.size // len(places)
        heights = np.kron(heights - heights.mean(axis=0), np.eye(axes))
        names = tuple(np.array(names)[np.repeat(seen, axes)])
        theta, draws, other = heights @ theta, draws @ heights.T, heights @ other
        covariance = heights @ covariance @ heights.T
    std, other_std = draws.std(axis=0, ddof=1), np.sqrt(np.diag(covariance))
    return tuple(
        Compared.of(
            str(name),
            cell.unit,
            (float(theta[i]), float(std[i])),
            (float(other[i]), float(other_std[i])),
        )
        for i, name in enumerate(names)
    )


def _posterior(fit: FitResult, cell: Cell) -> tuple[FloatArray, FloatArray]:
    """Return mean (m,) and draws (draws, m) of a cell's parameters."""
    index = {name: i for i, name in enumerate(fit.theta_names)}
    chosen = [index[name] for name in cell.parameters]
    return fit.theta[chosen], fit.theta_draws[..., chosen].reshape(-1, len(chosen))
