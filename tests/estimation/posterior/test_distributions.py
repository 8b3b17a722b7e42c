"""Quantiles of the chi-squared and the F distribution against SciPy's."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import chdtri, fdtri

from cadalign.estimation.uncertainty.residuals import chi_square_quantile, f_quantile

probabilities = st.sampled_from([0.5, 0.32, 0.05, 0.01])


@given(st.integers(1, 12), st.floats(0.6, 1e5), probabilities)
def test_quantiles_of_f_are_scipys(first: int, second: float, probability: float) -> None:
    expected = fdtri(first, second, 1 - probability)
    found = f_quantile(first, second, probability)
    assert found == pytest.approx(expected, rel=1e-7 if second < 1 else 1e-9)


@given(st.integers(1, 60), probabilities)
def test_quantiles_of_chi_square_are_scipys(freedom: int, probability: float) -> None:
    expected = chdtri(freedom, probability)
    assert chi_square_quantile(freedom, probability) == pytest.approx(expected, rel=1e-12)
