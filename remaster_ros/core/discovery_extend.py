"""From chosen cells to an `Extension` of the model that is sampled."""

from __future__ import annotations

import numpy as np

from remaster_ros.core.discovery_evidence import Solution
from remaster_ros.core.discovery_noise import Residuals
from remaster_ros.core.extension import Extension


def extension_of(residuals: Residuals, solution: Solution) -> Extension:
    """Return the cells of a solution as further parameters, linearised where it has them."""
    scene = residuals.scene
    m = len(solution.parameters)
    joint = np.zeros((len(scene), scene.joints, m))
    displacement = np.zeros((len(scene), 3, m))
    for cell, where in zip(solution.cells, solution.slices(), strict=True):
        columns = cell.columns(scene)
        if columns.at is None:
            displacement[:, :, where] = columns.values
        else:
            joint[:, columns.at, where] = columns.values
    names = tuple(name for cell in solution.cells for name in cell.parameters)
    units = tuple(cell.unit for cell in solution.cells for _ in cell.parameters)
    return Extension(
        names,
        units,
        joint,
        displacement,
        displacement @ solution.parameters,
        solution.parameters,
        solution.prior_precision(),
    )
