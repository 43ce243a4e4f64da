# SPDX-License-Identifier: Apache-2.0
"""Further parameters of the model: what physical effects add, linear in each observation.

An effect is what it does to each row of the measurements: it turns joints, or it displaces the
marker. Which effects there are is defined in `discovery.effects`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from remaster_ros.types import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Term:
    """What some of the parameters do, in one place."""

    where: slice  # Which parameters, in order
    # Index of the joint whose angle they add to; None where they displace the marker
    at: int | None
    # Added joint angle, rad per unit, (n, c), or displacement in base coordinates R, m per unit,
    # (n, 3, c): of all that does not enter through a joint angle (links, base, marker, sensor
    # frame), the derivative at ``theta0``
    values: FloatArray


@dataclass(frozen=True)
class Start:
    """Where the effects were found: a solution near the mode."""

    joint_offsets: FloatArray  # rad, (k,)
    T_R_N: FloatArray  # Registration of each sensor, (sensors, 4, 4)
    markers: FloatArray  # In T, m, (markers, 3)
    gross: IntArray  # Indices of the rows of the measurements that were left out


@dataclass(frozen=True, eq=False)
class Extension:
    """Further parameters theta (m,): physical effects, each row deviating linearly in them.

    The marker of row n is predicted at::

        chain.positions(q + offsets + Σ turning terms: values @ theta)
        + displacement0 + Σ displacing terms: values @ (theta - theta0)

    in base coordinates R, then registered as without an extension. Rows are those of the
    `Measurements` (``Rows.source``).
    """

    names: tuple[str, ...]  # 'compliance_2', …, m names
    units: tuple[str, ...]  # 'rad/(N m)', …, m units
    # What they do. A curve of a joint has a hundred parameters, which concern this joint alone.
    terms: tuple[Term, ...]
    # Exact value at ``theta0`` of what the displacing terms are derivatives of, m, (n, 3)
    displacement0: FloatArray
    theta0: FloatArray  # Where it was linearised, (m,)
    # Gaussian prior about 0 (plausible size, smoothness); zeros where flat, (m, m)
    prior_precision: FloatArray
    # Zero-offsets that the effects were searched with, those that the gauge held at 0, rad, (k,);
    # None where nothing is known of them
    joint_offsets: FloatArray | None = None
    # How far from there offsets beside the effects may be: a Gaussian prior, rad
    step_std: float = np.inf
    # Where to begin the search for the mode; None where that is to be found, too
    start: Start | None = None
    of_motion: bool = False  # What every fit of a moving session has (`dynamics`): no causes

    def with_motion(self, other: Extension | None) -> Extension:
        """Return these parameters and behind them those of motion, if another extension has any.

        That has to be linearised at 0, as parameters of motion are.
        """
        if other is None or not other.of_motion:
            return self
        count, more = len(self.names), len(other.names)
        precision = np.zeros((count + more, count + more))
        precision[:count, :count] = self.prior_precision
        precision[count:, count:] = other.prior_precision
        moved = (
            replace(term, where=slice(term.where.start + count, term.where.stop + count))
            for term in other.terms
        )
        return replace(
            self,
            names=self.names + other.names,
            units=self.units + other.units,
            terms=(*self.terms, *moved),
            theta0=np.concatenate((self.theta0, other.theta0)),
            prior_precision=precision,
        )

    def turns(self, theta: FloatArray, rows: IntArray) -> dict[int, FloatArray]:
        """Return the angles that theta (..., m) adds in n rows: joint -> rad, (..., n)."""
        added: dict[int, FloatArray] = {}
        for term in self.terms:
            if term.at is not None:
                angle = _product(term.values[rows], theta[..., term.where])
                added[term.at] = added[term.at] + angle if term.at in added else angle
        return added

    def shifts(self, theta: FloatArray, rows: IntArray) -> FloatArray:
        """Return the displacements of n rows by theta (..., m), in R, m, (..., n, 3)."""
        step = theta - self.theta0
        shift = np.zeros((*theta.shape[:-1], len(rows), 3))
        for term in self.terms:
            if term.at is None:
                shift += _product(term.values[rows], step[..., term.where])
        shift += self.displacement0[rows]
        return shift

    def derivative(
        self, by_joints: FloatArray, turn: FloatArray, rows: IntArray, result: FloatArray
    ) -> None:
        """Add the derivative of n points by theta, m per unit, to ``result``, (n, 3, m).

        Parameters
        ----------
        by_joints
            Derivative of the points by the joint angles, m/rad, (n, 3, k).
        turn
            Rotation that displacements are turned by, (3, 3).
        rows
            Their indices in the measurements, (n,).
        """
        for term in self.terms:
            part, values = result[:, :, term.where], term.values[rows]
            if term.at is None:
                part += np.einsum('ij,njc->nic', turn, values)
            else:
                part += by_joints[:, :, term.at, None] * values[:, None, :]


def _product(values: FloatArray, theta: FloatArray) -> FloatArray:
    """Return values (n, ..., c) times theta (draws..., c): (draws..., n, ...), one product."""
    c = values.shape[-1]
    product = theta.reshape(-1, c) @ values.reshape(-1, c).T
    return product.reshape(*theta.shape[:-1], *values.shape[:-1])
