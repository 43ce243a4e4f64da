"""Further parameters of the model: what physical effects add, linear in each observation.

An effect is what it does to each row of the measurements: it turns joints, or it displaces the
marker. Nothing here knows which effect it is; `core.effects` does.
"""

from __future__ import annotations

from dataclasses import dataclass

from remaster_ros.core.types import FloatArray


@dataclass(frozen=True, eq=False)
class Extension:
    """Further parameters theta (m,): physical effects, each row deviating linearly in them.

    The marker of row n is predicted at::

        chain.positions(q + offsets + joint @ theta)
        + displacement0 + displacement @ (theta - theta0)

    in base coordinates R, then registered as without an extension. Rows are those of the
    `Measurements` (``Rows.source``).

    Attributes
    ----------
    names
        'compliance_2', …, m names.
    units
        'rad/(N m)', …, m units.
    joint
        Added to the reported joint angles, rad per unit of theta, (n, k, m).
    displacement
        All that does not enter through a joint angle (links, base, marker, sensor frame): its
        derivative by theta at ``theta0`` in base coordinates, m per unit, (n, 3, m).
    displacement0
        Its exact value at ``theta0``, m, (n, 3).
    theta0
        Where it was linearised, (m,).
    prior_precision
        Gaussian prior about 0 (plausible size, smoothness); zeros where flat, (m, m).
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    joint: FloatArray
    displacement: FloatArray
    displacement0: FloatArray
    theta0: FloatArray
    prior_precision: FloatArray
