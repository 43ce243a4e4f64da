# SPDX-License-Identifier: Apache-2.0
"""Sixteen numbers that are a pose: a 4×4 matrix, row by row or column by column."""

from __future__ import annotations

import numpy as np

from remaster_ros.types import FloatArray

SIZE = 4
COUNT = SIZE * SIZE
# Of a rotation written with three digits.
_ROUNDING = 2e-3


def rigid(numbers: FloatArray) -> FloatArray | None:
    """Return rigid motions (n, 4, 4) of their numbers (n, 16); None where they are none.

    The row 0 0 0 1 tells how the numbers stand; libfranka writes columns.
    """
    T = numbers.reshape(-1, SIZE, SIZE)
    for each in (T, T.swapaxes(1, 2)):
        R = each[:, :3, :3]
        turns = np.abs(R @ R.swapaxes(1, 2) - np.eye(3)).max() < _ROUNDING
        if turns and np.all(each[:, 3] == [0, 0, 0, 1]) and np.all(np.linalg.det(R) > 0.0):
            return each
    return None
