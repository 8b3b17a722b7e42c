"""`fit_batch`: equal to single fits, bit for bit, and independent of failed problems."""

from __future__ import annotations

import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from cadalign import Camera, RansacOptions, Results, View, fit, fit_batch
from cadalign.errors import CadalignError
from cadalign.evaluation.simulation import SimulatedProblem, simulate_problem

LENS = Camera(640, 480, 500.0, 520.0, 310.0, 250.0, (-0.2, 0.05, 0.002, -0.001))


def problems_of(counts: list[int], *, seed: int = 0, **options: Any) -> list[SimulatedProblem]:
    rng = np.random.default_rng(seed)
    options = {"noise_px": 1.0} | options
    return [simulate_problem(rng, points=count, **options) for count in counts]


def run(problems: list[SimulatedProblem], camera: Any = None, **options: Any) -> Results:
    return fit_batch(
        [p.points_3d for p in problems],
        [p.points_2d for p in problems],
        camera if camera is not None else problems[0].camera,
        **options,
    )


def assert_like_single_fits(
    batch: Results,
    problems: list[SimulatedProblem],
    each: list[dict[str, Any]] | None = None,
    **options: Any,
) -> None:
    assert len(batch) == len(problems)
    for b, problem in enumerate(problems):
        own = options if each is None else options | each[b]
        single = fit(problem.points_3d, problem.points_2d, problem.camera, **own)
        assert (batch.rotation[b] == single.alignment.rotation).all()
        assert (batch.translation[b] == single.alignment.translation).all()
        assert (batch.scale[b] == single.alignment.scale).all()
        assert batch.alignment(b) == single.alignment
        assert batch.rms[b] == pytest.approx(single.rms, rel=1e-12)
        result = batch[b]
        assert result.to_dict() | {"stats": None} == single.to_dict() | {"stats": None}


RAGGED = problems_of([6, 20, 7, 100, 10, 64])


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"method": "aepnp"},
        {"method": "aepnp-paper"},
        {"method": "epnp"},
        {"sigma": 2.0},
        {"sigma": None},
        {"loss": "huber"},
        {"loss": "cauchy", "loss_scale": 1.0, "sigma": None},
        {"stretch": "y"},
        {"stretch_sigma": 0.3},
        {"stretch_sigma": 0.3, "sigma": None},
    ],
    ids=str,
)
def test_batch_is_identical_to_single_fits_whatever_the_workers(options: dict[str, Any]) -> None:
    for workers in (1, 2, 50):
        batch = run(RAGGED, workers=workers, **options)
        assert batch.errors == {}
        assert batch.solved.all()
    assert_like_single_fits(batch, RAGGED, **options)
    for name in ("rotation", "translation", "scale", "rms"):
        assert (getattr(batch, name) == getattr(run(RAGGED, **options), name)).all()


@pytest.mark.parametrize("ransac", [None, RansacOptions()])
def test_results_go_to_other_processes(ransac: RansacOptions | None) -> None:
    batch = run(problems_of([20, 20, 20]), ransac=ransac)
    again = pickle.loads(pickle.dumps(batch))
    for result, single in zip(again, batch, strict=True):
        assert result.to_dict() | {"stats": None} == single.to_dict() | {"stats": None}


def test_stacked_arrays_are_the_same_as_lists_and_are_not_changed() -> None:
    problems = problems_of([9] * 6)
    lists = run(problems)
    given = [np.stack([getattr(p, name) for p in problems]) for name in ("points_3d", "points_2d")]
    copies = [each.copy() for each in given]
    stacked = fit_batch(*given, problems[0].camera)
    np.testing.assert_array_equal(given[0], copies[0])
    np.testing.assert_array_equal(given[1], copies[1])
    for name in ("rotation", "translation", "scale", "rms"):
        assert (getattr(stacked, name) == getattr(lists, name)).all()


def test_every_problem_may_have_its_own_camera() -> None:
    rng = np.random.default_rng(1)
    cameras = [RAGGED[0].camera, LENS, Camera(1000, 800, 1500.0, 1500.0, 499.5, 399.5)]
    problems = [simulate_problem(rng, points=10, noise_px=0.5, camera=c) for c in cameras]
    for workers in (1, 2):
        assert_like_single_fits(run(problems, cameras, workers=workers), problems)


def test_every_problem_may_have_its_own_sigma() -> None:
    rng = np.random.default_rng(2)
    sigmas: list[Any] = [0.5, 2, rng.uniform(0.5, 3, 7)]
    sigmas += [np.tile(np.diag([1.0, 4.0]), (100, 1, 1)), np.full(10, 1.5), 1.0]
    each = [{"sigma": sigma} for sigma in sigmas]
    for workers in (1, 2):
        assert_like_single_fits(run(RAGGED, sigma=sigmas, workers=workers), RAGGED, each)


def test_sigmas_may_be_changed_afterwards() -> None:
    sigmas = [np.ones(len(each.points_3d)) for each in RAGGED]
    batch, view = run(RAGGED, sigma=sigmas), View(RAGGED[0].camera, RAGGED[0].points_2d)
    view = replace(view, sigma=sigmas[0])
    for sigma in sigmas:
        sigma *= 100
    assert batch[0].std.rotation_deg == run(RAGGED, sigma=1.0)[0].std.rotation_deg
    assert (np.asarray(view.sigma) == 1.0).all()


@pytest.mark.parametrize("sigma", [np.float32(2.0), np.array(2.0)])
def test_sigma_may_be_a_numpy_number(sigma: Any) -> None:
    assert (run(RAGGED, sigma=sigma).scale == run(RAGGED, sigma=2.0).scale).all()


@pytest.mark.parametrize("workers", [1, 3])
@pytest.mark.parametrize("method", ["optimal", "aepnp", "aepnp-paper", "epnp"])
def test_errors_are_those_of_single_fits(method: str, workers: int) -> None:
    problems = problems_of([10, 2, 9, 0, 12, 5, 8])
    problems[-1].points_3d[:, 2] = 0.1
    batch = run(problems, method=method, workers=workers)
    assert batch.solved.tolist() == [b not in batch.errors for b in range(7)]
    for b, problem in enumerate(problems):
        if b in batch.errors:
            with pytest.raises(CadalignError) as caught:
                fit(problem.points_3d, problem.points_2d, problem.camera, method=method)
            assert str(batch.errors[b]) == str(caught.value)
            assert type(batch.errors[b]) is type(caught.value)
            for array in (batch.rotation, batch.translation, batch.scale, batch.rms):
                assert np.isnan(array[b]).all()
            with pytest.raises(type(caught.value)):
                batch.alignment(b)
        else:
            single = fit(problem.points_3d, problem.points_2d, problem.camera, method=method)
            assert batch.alignment(b) == single.alignment


def test_rms_does_not_suffer_from_other_problems() -> None:
    (noisy,) = problems_of([1000], noise_px=30.0)
    (exact,) = problems_of([10], noise_px=0.0)
    batch = run([noisy, exact], method="aepnp")
    alone = fit(exact.points_3d, exact.points_2d, exact.camera, method="aepnp")
    assert batch.rms[0] > 10
    assert batch.rms[1] == pytest.approx(alone.rms, rel=1e-9, abs=0.0)


@pytest.mark.parametrize("options", [{"focal": "estimate"}, {"sigma": None}, {"method": "aepnp"}])
@pytest.mark.parametrize("lens", ["perspective", "fisheye"])
def test_no_problems_give_no_results_with_any_option(options: dict[str, Any], lens: str) -> None:
    camera = Camera(640, 480, 400.0, 400.0, 319.5, 239.5, lens=lens)
    batch = fit_batch([], [], camera, workers=-1, **options)
    assert len(batch) == 0
    assert batch.rotation.shape == (0, 3, 3)
    assert batch.errors == {}


def test_threads_agree_where_all_of_a_share_fail() -> None:
    good = problems_of([20, 20])
    rng = np.random.default_rng(0)
    bad = [
        SimulatedProblem(
            rng.normal(size=(20, 3)), rng.uniform(0, 400, (20, 2)), p.camera, p.alignment, None
        )
        for p in good
    ]
    batch = run([*good, *bad], focal="estimate", ransac=RansacOptions(max_iterations=20), workers=2)
    assert batch.solved.tolist() == [True, True, False, False]
