"""Symmetric matrices of which one half is kept, row by row up to the diagonal.

Matrices of some hundred parameters are read again and again; half of each is read in half the
time. In the words of LAPACK this is the upper half, column by column.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.linalg.lapack import dtpttr, dtrttp

from remaster_ros.types import FloatArray, IntArray

# Columns whose products are computed at once: what is beyond the diagonal is for nothing, and each
# time the other columns are read again.
TILE = 128


def length(size: int) -> int:
    """Return the number of elements of a packed matrix of `size` rows."""
    return size * (size + 1) // 2


def diagonal(size: int) -> IntArray:
    """Return the indices of the diagonal in a packed matrix, (size,)."""
    return np.cumsum(np.arange(1, size + 1)) - 1


def of_rows(rows: FloatArray, first: int) -> FloatArray:
    """Return some last rows of symmetric matrices in packed form, (…, elements).

    Of each row the elements up to the diagonal. ``rows``: all rows from index ``first`` on,
    (…, size − first, size).
    """
    size = rows.shape[-1]
    up_to_diagonal = np.arange(size) <= np.arange(first, size)[:, None]
    return rows[..., up_to_diagonal]


def add_products(matrix: FloatArray, columns: FloatArray, first: int) -> None:
    """Add X'X to a packed matrix in place, only in its rows from index ``first`` on.

    ``columns``: X, (r, size).
    """
    size = columns.shape[1]
    for start in range(first, size, TILE):
        end = min(start + TILE, size)
        rows = columns[:, start:end].T @ columns[:, :end]
        matrix[length(start) : length(end)] += of_rows(rows, start)


def picked(matrices: FloatArray, order: IntArray) -> FloatArray:
    """Return packed matrices of some rows and the same columns, in a given order, (m, elements).

    ``matrices``: (m, length); ``order``: indices of the rows to pick. Not to be changed in place:
    the result may be a view.
    """
    if np.array_equal(order, np.arange(len(order))):
        return matrices[:, : length(len(order))]
    i, j = _half(len(order))
    row, other = order[i], order[j]
    high = np.maximum(row, other)
    chosen: FloatArray = np.take(matrices, high * (high + 1) // 2 + np.minimum(row, other), axis=1)
    return chosen


def upper(matrix: FloatArray, size: int) -> FloatArray:
    """Return the first rows and columns of a packed matrix as an upper triangle, (size, size).

    Column-major; elements below the diagonal have no meaning.
    """
    square: FloatArray = dtpttr(size, matrix[: length(size)])[0]
    return square


def of_upper(matrix: FloatArray) -> FloatArray:
    """Return a symmetric matrix in packed form; only its upper triangle counts.

    ``matrix``: column-major, (size, size).
    """
    half: FloatArray = dtrttp(matrix)[0]
    return half


@lru_cache(maxsize=8)
def _half(size: int) -> tuple[IntArray, IntArray]:
    """Return row and column of each element of a packed matrix, (length,) each; cached."""
    i, j = np.tril_indices(size)
    return i.astype(np.int32), j.astype(np.int32)
