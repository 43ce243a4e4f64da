# SPDX-License-Identifier: Apache-2.0
"""Symmetric matrices of which one half is kept."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from remaster_ros.discovery import packed


def symmetric(size: int, count: int, seed: int):
    matrices = np.random.default_rng(seed).normal(size=(count, size, size))
    return matrices + matrices.transpose(0, 2, 1)


@given(st.integers(1, 12), st.integers(0, 2**32 - 1))
def test_a_packed_matrix_is_half_of_itself(size, seed):
    full_matrix = symmetric(size, 3, seed)
    half = packed.of_rows(full_matrix, 0)
    assert half.shape == (3, packed.length(size))
    assert np.array_equal(half[:, packed.diagonal(size)], np.einsum('gii->gi', full_matrix))
    for matrix, its_half in zip(full_matrix, half, strict=True):
        assert np.array_equal(np.triu(packed.upper(its_half, size)), np.triu(matrix))
        assert np.array_equal(packed.of_upper(np.asfortranarray(np.triu(matrix))), its_half)


@given(st.data(), st.integers(1, 12), st.integers(0, 2**32 - 1))
def test_rows_and_columns_are_picked_in_any_order(data, size, seed):
    full_matrix = symmetric(size, 2, seed)
    order = np.array(
        data.draw(st.permutations(range(size)))[: data.draw(st.integers(1, size))], dtype=int
    )
    chosen = packed.picked(packed.of_rows(full_matrix, 0), order)
    assert np.array_equal(chosen, packed.of_rows(full_matrix[:, order][:, :, order], 0))


@pytest.mark.parametrize('first', [0, 1, 4, 6])
def test_further_rows_follow_those_that_are_packed(first):
    full_matrix = symmetric(6, 2, 5)
    parts = (
        packed.of_rows(full_matrix[:, :first, :first], 0),
        packed.of_rows(full_matrix[:, first:], first),
    )
    assert np.array_equal(np.concatenate(parts, axis=1), packed.of_rows(full_matrix, 0))


def test_products_are_added_row_by_row_and_in_tiles() -> None:
    size, first = packed.TILE + 40, 17
    columns = np.random.default_rng(4).standard_normal((30, size))
    wanted = packed.of_rows((columns.T @ columns)[None], 0)[0]
    matrix = wanted.copy()
    packed.add_products(matrix, columns, first)
    known = packed.length(first)
    assert np.array_equal(matrix[:known], wanted[:known])
    np.testing.assert_allclose(matrix[known:], 2.0 * wanted[known:], rtol=1e-12, atol=1e-12)
