"""Real roots of polynomials with known roots."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import polynomial as P

from cadalign.solvers.polynomial import ROOTS_ROWS, real_roots


def roots_of(coefficients: np.ndarray, *, reach: float = 1.0) -> np.ndarray:
    degree = len(coefficients) - 1
    memory = np.empty((ROOTS_ROWS + 1, 2 * degree))
    memory[1, : degree + 1] = coefficients
    count = real_roots(memory, 1, degree, reach, 1e-7)
    return np.sort(memory[2, :count])


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(2, 8))
def test_roots_inside_the_interval_are_found(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    # At least 0.05 apart, some outside (-1, 1).
    roots = -1.5 + np.cumsum(rng.uniform(0.05, 3 / count, count))
    coefficients = rng.uniform(0.5, 2) * P.polyfromroots(roots)
    expected = roots[(roots > -1) & (roots < 1)]
    found = roots_of(coefficients)
    assert len(found) == len(expected)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-7)


@given(seed=st.integers(0, 2**32 - 1), pairs=st.integers(1, 3))
def test_complex_roots_are_ignored(seed: int, pairs: int) -> None:
    rng = np.random.default_rng(seed)
    real = np.sort(rng.uniform(-0.9, 0.9, 2))
    if real[1] - real[0] < 0.05:
        return
    coefficients = P.polyfromroots(real)
    for _ in range(pairs):
        center, height = rng.uniform(-0.8, 0.8), rng.uniform(0.2, 1)
        coefficients = P.polymul(coefficients, [center**2 + height**2, -2 * center, 1])
    np.testing.assert_allclose(roots_of(coefficients), real, rtol=0, atol=1e-8)


@pytest.mark.parametrize("lift", [0.0, 1e-12, -1e-12])
def test_double_root_is_found_even_where_rounding_lifts_it_off_zero(lift: float) -> None:
    coefficients = P.polyfromroots([0.3, 0.3, -0.6])
    coefficients[0] += lift
    found = roots_of(coefficients)
    np.testing.assert_allclose(found[np.abs(found + 0.6).argmin()], -0.6, atol=1e-9)
    others = found[np.abs(found - 0.3) < 1e-4]
    assert len(others) >= 1
    assert len(found) == 1 + len(others)


@pytest.mark.parametrize("size", [1e-150, 1e-6, 1e6, 1e150])
def test_roots_do_not_depend_on_the_polynomials_size(size: float) -> None:
    roots = np.array([-0.7, -0.2, 0.1, 0.4, 0.8])
    found = roots_of(size * P.polyfromroots(roots))
    np.testing.assert_allclose(found, roots, rtol=0, atol=1e-9)


@given(seed=st.integers(0, 2**32 - 1), reach=st.floats(0.1, 10))
def test_roots_are_those_within_reach(seed: int, reach: float) -> None:
    rng = np.random.default_rng(seed)
    roots = np.sort(rng.uniform(-12, 12, 6))
    if np.diff(roots).min() < 0.1 or np.abs(np.abs(roots) - reach).min() < 1e-3:
        return
    found = roots_of(P.polyfromroots(roots), reach=reach)
    np.testing.assert_allclose(found, roots[np.abs(roots) < reach], rtol=0, atol=1e-6)
