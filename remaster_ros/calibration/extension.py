# SPDX-License-Identifier: Apache-2.0
"""Extension of the model by physical effects, linear in their parameters.

An effect turns joints, or displaces the marker, in each row of the measurements. The effects are
defined in `discovery.effects`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from remaster_ros.types import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Term:
    """Effect of some parameters of an extension on the angle of one joint, or on the marker."""

    where: slice  # Slice of the parameters
    # Index of the joint whose angle they change; None if they displace the marker
    at: int | None
    # Added joint angle, rad per unit, (n, c); or, for effects on links, base, marker or sensor
    # frame, derivative of the displacement in base coordinates R at ``theta0``, m per unit,
    # (n, 3, c)
    values: FloatArray


@dataclass(frozen=True)
class Start:
    """Solution near the mode, at which the effects were found."""

    joint_offsets: FloatArray  # rad, (k,)
    T_R_N: FloatArray  # Registration of each sensor, (sensors, 4, 4)
    markers: FloatArray  # In T, m, (markers, 3)
    gross: IntArray  # Indices of the rows of the measurements that were left out


@dataclass(frozen=True, eq=False)
class Extension:
    """Further parameters theta (m,): physical effects, each linear in each row.

    The marker of row n is predicted at::

        chain.positions(q + offsets + Σ turning terms: values @ theta)
            + displacement0 + Σ displacing terms: values @ (theta - theta0)

    in base coordinates R, then registered as without an extension. Rows are those of the
    `Measurements` (``Rows.source``).
    """

    names: tuple[str, ...]  # 'compliance_2', …, m names
    units: tuple[str, ...]  # 'rad/(N m)', …, m units
    # Effects of the parameters; a curve of a joint has a hundred, which concern this joint only
    terms: tuple[Term, ...]
    # Exact displacement at ``theta0`` of the displacing terms, m, (n, 3)
    displacement0: FloatArray
    theta0: FloatArray  # Point of linearisation, (m,)
    # Precision of the Gaussian prior about 0 (plausible size, smoothness), (m, m); zeros if flat
    prior_precision: FloatArray
    # Zero-offsets of the search for effects, 0 for those fixed by the gauge, rad, (k,); None if
    # unknown
    joint_offsets: FloatArray | None = None
    # Std of a Gaussian prior of the offsets about these, rad
    step_std: float = np.inf
    # Start of the search for the mode; None to find one
    start: Start | None = None
    of_motion: bool = False  # What every fit of a moving session has (`dynamics`): no causes

    def with_motion(self, other: Extension | None) -> Extension:
        """Copy with the parameters of motion of another extension appended to its own.

        The same extension if ``other`` is None or has no parameters of motion (``of_motion``).
        The other has to be linearised at 0, as parameters of motion are.
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
        """Angles that theta (..., m) adds in n rows: joint index -> rad (m for a slide), (..., n).

        ``rows``: indices of the measurements, (n,). Joints without an effect have no key.
        """
        added: dict[int, FloatArray] = {}
        for term in self.terms:
            if term.at is not None:
                angle = _product(term.values[rows], theta[..., term.where])
                added[term.at] = added[term.at] + angle if term.at in added else angle
        return added

    def shifts(self, theta: FloatArray, rows: IntArray) -> FloatArray:
        """Displacements of n rows by theta (..., m), in base coordinates R, m, (..., n, 3).

        ``displacement0`` is included. ``rows``: indices of the measurements, (n,).
        """
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
        """Add the derivative of n points by theta, m per unit, to ``result``, (n, 3, m), in place.

        Parameters
        ----------
        by_joints
            Derivative of the points by the joint angles, m/rad, (n, 3, k).
        turn
            Rotation applied to displacements, (3, 3).
        rows
            Indices of the points in the measurements, (n,).
        result
            Array to which the derivative is added.
        """
        for term in self.terms:
            part, values = result[:, :, term.where], term.values[rows]
            if term.at is None:
                part += np.einsum('ij,njc->nic', turn, values)
            else:
                part += by_joints[:, :, term.at, None] * values[:, None, :]


def _product(values: FloatArray, theta: FloatArray) -> FloatArray:
    """Product of values (n, ..., c) and theta (draws..., c) over c: (draws..., n, ...)."""
    c = values.shape[-1]
    product = theta.reshape(-1, c) @ values.reshape(-1, c).T
    return product.reshape(*theta.shape[:-1], *values.shape[:-1])
