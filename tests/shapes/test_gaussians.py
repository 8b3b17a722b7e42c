"""Gaussians of vectors with missing entries, compared with complete data and SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from cadalign.arrays import FloatArray
from cadalign.shapes.gaussians import (
    Gaussians,
    Vectors,
    learn_gaussian,
    learn_mixture,
    log_likelihoods,
)


def correlated(rng: np.random.Generator, count: int, entries: int) -> FloatArray:
    return rng.normal(size=(count, entries)) @ rng.normal(size=(entries, entries)) + 3.0


def vectors_of(values: FloatArray) -> Vectors:
    return Vectors(values, np.ones(len(values)))


@given(st.integers(0, 2**32 - 1), st.integers(1, 6))
def test_complete_vectors_give_their_mean_and_covariance(seed: int, entries: int) -> None:
    values = correlated(np.random.default_rng(seed), 40, entries)
    model = learn_gaussian(vectors_of(values), strength=0.0, floor=0.0, rounds=3)
    assert model.means[0] == pytest.approx(values.mean(axis=0), abs=1e-5)
    expected = np.cov(values.T, bias=True).reshape(entries, entries)
    assert model.covariances[0] == pytest.approx(expected, abs=1e-5 * np.abs(expected).max() + 1e-6)


@pytest.mark.long
@given(st.integers(0, 2**32 - 1))
def test_log_likelihoods_are_the_marginal_densities(seed: int) -> None:
    rng = np.random.default_rng(seed)
    roots = rng.normal(size=(2, 4, 4))
    covariances = roots @ roots.transpose(0, 2, 1) + 0.1 * np.eye(4)
    model = Gaussians(np.array([0.3, 0.7]), rng.normal(size=(2, 4)), covariances)
    values = rng.normal(size=(12, 4))
    values[rng.random(values.shape) < 0.4] = np.nan
    values[:, 0] = 0.5
    for value, found in zip(values, log_likelihoods(vectors_of(values), model), strict=True):
        seen = np.flatnonzero(~np.isnan(value))
        density = sum(
            weight * multivariate_normal(mean[seen], each[np.ix_(seen, seen)]).pdf(value[seen])
            for weight, mean, each in zip(model.weights, model.means, covariances, strict=True)
        )
        assert found == pytest.approx(np.log(density), rel=1e-9)


@pytest.mark.long
def test_missing_entries_are_recovered_from_the_others() -> None:
    rng = np.random.default_rng(0)
    values = correlated(rng, 4000, 4)
    holes = values.copy()
    holes[rng.random(values.shape) < 0.3] = np.nan
    holes[np.isnan(holes).all(axis=1), 0] = values[np.isnan(holes).all(axis=1), 0]
    model = learn_gaussian(vectors_of(holes), strength=0.0, floor=1e-6, rounds=100)
    covariance = np.cov(values.T)
    assert np.abs(model.means[0] - values.mean(axis=0)).max() < 0.1
    assert np.abs(model.covariances[0] - covariance).max() < 0.1 * np.abs(covariance).max()


@pytest.mark.slow
def test_every_iteration_increases_the_likelihood() -> None:
    rng = np.random.default_rng(1)
    values = correlated(rng, 100, 5)
    values[:60, 4] = np.nan
    values[30:90, 2] = np.nan
    vectors = vectors_of(values)
    totals = [
        log_likelihoods(
            vectors, learn_gaussian(vectors, strength=0.0, floor=0.0, rounds=rounds)
        ).sum()
        for rounds in range(2, 12)
    ]
    assert (np.diff(totals) > -1e-3).all()


def test_a_rare_entry_keeps_a_large_deviation() -> None:
    values = np.random.default_rng(2).normal(size=(300, 4))
    values[1:, 3] = np.nan
    model = learn_gaussian(vectors_of(values), strength=0.0, floor=1e-3, rounds=25)
    assert 0.3 < np.sqrt(model.covariances[0][3, 3]) < 1.5


def test_an_entry_without_data_does_not_affect_the_others() -> None:
    values = np.random.default_rng(2).normal(size=(50, 3))
    values[:, 1] = np.nan
    model = learn_gaussian(vectors_of(values), strength=0.0, floor=1e-3, rounds=25)
    assert np.isfinite(model.means).all()
    assert model.covariances[0][1, 1] > 0.1


def test_a_mixture_finds_two_clusters() -> None:
    rng = np.random.default_rng(3)
    values = np.vstack([rng.normal(0, 0.2, (150, 3)), rng.normal(2, 0.1, (50, 3))])
    values[::7, 1] = np.nan
    vectors = vectors_of(values)
    common = learn_gaussian(vectors, strength=0.0, floor=1e-3, rounds=25)
    labels = (values[:, 0] > 1.5).astype(np.int64)
    model = learn_mixture(vectors, labels, common, strength=0.1, floor=1e-3, rounds=20)
    assert model.weights == pytest.approx([0.75, 0.25], abs=0.01)
    assert model.means[1] == pytest.approx([2, 2, 2], abs=0.1)
