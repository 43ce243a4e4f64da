# SPDX-License-Identifier: Apache-2.0
"""Poses from sixteen numbers: 4×4 matrices, row by row or column by column."""

from __future__ import annotations

import numpy as np

from remaster_ros.types import FloatArray

SIZE = 4
COUNT = SIZE * SIZE
# Tolerance of a rotation matrix that is written with three digits.
_ROUNDING = 2e-3


def rigid(numbers: FloatArray) -> FloatArray | None:
    """Rigid motions, (n, 4, 4), from sixteen numbers each, (n, 16); None unless all are rigid.

    Numbers are row by row, or column by column as libfranka writes them: the place of 0 0 0 1
    decides. The product of a rotation matrix and its transpose may be 2e-3 off the identity.
    """
    T = numbers.reshape(-1, SIZE, SIZE)
    for each in (T, T.swapaxes(1, 2)):
        R = each[:, :3, :3]
        turns = np.abs(R @ R.swapaxes(1, 2) - np.eye(3)).max() < _ROUNDING
        if turns and np.all(each[:, 3] == [0, 0, 0, 1]) and np.all(np.linalg.det(R) > 0.0):
            return each
    return None
