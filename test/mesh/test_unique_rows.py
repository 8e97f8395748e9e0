"""Rows of integers as numbers: the same order, the same groups."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from graspd_core.mesh.topology import packed_rows

_SHAPES = array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=12).map(lambda shape: (shape[0], 1 + shape[1] % 3))
# Few values, so that rows repeat; or up to where three of them have no room in one number.
_VALUES = st.integers(-3, 3) | st.integers(-(2**40), 2**40)


@given(arrays(np.int64, _SHAPES, elements=_VALUES))
def test_rows_and_their_numbers_sort_and_group_alike(rows: np.ndarray):
    by_rows = np.unique(rows, axis=0, return_index=True, return_inverse=True, return_counts=True)
    by_numbers = np.unique(packed_rows(rows), return_index=True, return_inverse=True, return_counts=True)
    for expected, found in zip(by_rows[1:], by_numbers[1:], strict=True):
        np.testing.assert_array_equal(expected.reshape(-1), found)
    np.testing.assert_array_equal(by_rows[0], rows[by_numbers[1]])


@pytest.mark.parametrize("columns", [1, 3])
def test_no_rows_give_no_numbers(columns: int):
    assert packed_rows(np.zeros((0, columns), dtype=np.int64)).shape == (0,)
