"""Cholesky's factor and solution of the kernels, against NumPy's."""

from __future__ import annotations

import numpy as np
import pytest
from marcha.algorithms.numerics import cholesky


@pytest.mark.parametrize("n", [1, 2, 6, 12])
def test_factor_and_solution_are_numpys(n: int) -> None:
    rng = np.random.default_rng(n)
    half = rng.normal(size=(n, n + 3))
    matrix, rhs = half @ half.T, rng.normal(size=n)
    factor, x = matrix.copy(), rhs.copy()
    assert cholesky.factorize(factor, n)
    cholesky.solve(factor, n, x)
    np.testing.assert_allclose(np.tril(factor), np.linalg.cholesky(matrix), rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(x, np.linalg.solve(matrix, rhs), rtol=1e-7, atol=1e-9)


def test_what_is_not_positive_definite_is_refused() -> None:
    assert not cholesky.factorize(np.array([[1.0, 9.0], [2.0, 3.0]]), 2)


def test_only_the_leading_block_and_the_lower_triangle_count() -> None:
    matrix = np.array([[4.0, np.nan, np.nan], [2.0, 5.0, np.nan], [np.nan, np.nan, np.nan]])
    x = np.array([2.0, 3.0, 7.0])
    assert cholesky.factorize(matrix, 2)
    cholesky.solve(matrix, 2, x)
    np.testing.assert_allclose(x, [0.25, 0.5, 7.0])
