"""`fit_batch`: bit for bit what single fits give, and no problem spoils another."""

from __future__ import annotations

import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from cadalign import Camera, RansacOptions, Result, Results, View, fit, fit_batch
from cadalign.errors import CadalignError, DegenerateError, InputError
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
        assert isinstance(result, Result)
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
@pytest.mark.parametrize("workers", [1, 2])
def test_batch_is_identical_to_single_fits(options: dict[str, Any], workers: int) -> None:
    batch = run(RAGGED, workers=workers, **options)
    assert batch.errors == {}
    assert batch.solved.all()
    assert_like_single_fits(batch, RAGGED, **options)


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("ransac", [None, RansacOptions()])
def test_results_go_to_other_processes(workers: int, ransac: RansacOptions | None) -> None:
    batch = run(problems_of([20, 20, 20]), workers=workers, ransac=ransac)
    again = pickle.loads(pickle.dumps(batch))
    for result, single in zip(again, batch, strict=True):
        assert isinstance(result, Result)
        assert isinstance(single, Result)
        assert result.to_dict() | {"stats": None} == single.to_dict() | {"stats": None}


def test_points_behind_a_lens_are_handled_alike() -> None:
    problems = problems_of([8, 12, 9], camera=LENS)
    assert_like_single_fits(run(problems), problems)


def test_stacked_arrays_are_the_same_as_lists() -> None:
    problems = problems_of([9] * 6)
    lists = run(problems)
    stacked = fit_batch(
        np.stack([p.points_3d for p in problems]),
        np.stack([p.points_2d for p in problems]),
        problems[0].camera,
    )
    for name in ("rotation", "translation", "scale", "rms"):
        assert (getattr(stacked, name) == getattr(lists, name)).all()


@pytest.mark.parametrize("workers", [2, 3, 50, -1])
def test_number_of_workers_does_not_matter(workers: int) -> None:
    one, many = run(RAGGED), run(RAGGED, workers=workers)
    for name in ("rotation", "translation", "scale", "rms"):
        assert (getattr(many, name) == getattr(one, name)).all()


def test_every_problem_may_have_its_own_camera() -> None:
    rng = np.random.default_rng(1)
    cameras = [RAGGED[0].camera, LENS, Camera(1000, 800, 1500.0, 1500.0, 499.5, 399.5)]
    problems = [simulate_problem(rng, points=10, noise_px=0.5, camera=c) for c in cameras]
    for workers in (1, 2):
        assert_like_single_fits(run(problems, cameras, workers=workers), problems)


def test_every_problem_may_have_its_own_sigma() -> None:
    rng = np.random.default_rng(2)
    sigmas = [
        0.5,
        2,
        rng.uniform(0.5, 3, 7),
        np.tile(np.diag([1.0, 4.0]), (100, 1, 1)),
        np.full(10, 1.5),
        1.0,
    ]
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


@pytest.mark.parametrize("sigma", [np.float64(2.0), np.float32(2.0), np.array(2.0)])
def test_sigma_may_be_a_numpy_number(sigma: Any) -> None:
    assert (run(RAGGED, sigma=sigma).scale == run(RAGGED, sigma=2.0).scale).all()


@pytest.mark.parametrize("lens", [None, LENS])
def test_problem_without_solution_gets_its_error_and_the_rest_goes_on(lens: Camera | None) -> None:
    problems = problems_of([10, 3, 8, 12], **({} if lens is None else {"camera": lens}))
    flat = problems[2].points_3d.copy()
    flat[:, 2] = 0.1
    batch = fit_batch(
        [problems[0].points_3d, problems[1].points_3d, flat, problems[3].points_3d],
        [p.points_2d for p in problems],
        problems[0].camera,
        method="aepnp",
    )
    assert sorted(batch.errors) == [1, 2]
    assert batch.solved.tolist() == [True, False, False, True]
    for b, text in (
        (1, "points_3d: 3 keypoints are too few for the method 'aepnp'; give at least 6"),
        (
            2,
            "points_3d: the points lie in the plane z = 0.1; "
            "a linear solver needs keypoints that span a volume",
        ),
    ):
        assert str(batch.errors[b]) == text
        with pytest.raises(DegenerateError, match="points_3d"):
            batch.alignment(b)
        for array in (batch.rotation, batch.translation, batch.scale, batch.rms):
            assert np.isnan(array[b]).all()
    for b in (0, 3):
        alone = fit(
            problems[b].points_3d, problems[b].points_2d, problems[b].camera, method="aepnp"
        )
        assert batch.alignment(b) == alone.alignment
        assert batch.rms[b] == pytest.approx(alone.rms)


@pytest.mark.parametrize("workers", [1, 3])
@pytest.mark.parametrize("method", ["optimal", "aepnp", "aepnp-paper", "epnp"])
def test_errors_are_those_of_single_fits(method: str, workers: int) -> None:
    problems = problems_of([10, 2, 9, 0, 12, 5])
    batch = run(problems, method=method, workers=workers)
    for b, problem in enumerate(problems):
        if b in batch.errors:
            with pytest.raises(CadalignError) as caught:
                fit(problem.points_3d, problem.points_2d, problem.camera, method=method)
            assert str(batch.errors[b]) == str(caught.value)
            assert type(batch.errors[b]) is type(caught.value)
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


@pytest.mark.parametrize("method", ["optimal", "aepnp"])
@pytest.mark.parametrize("workers", [1, -1])
def test_no_problems_give_no_results(method: str, workers: int) -> None:
    batch = fit_batch([], [], RAGGED[0].camera, method=method, workers=workers)
    assert len(batch) == 0
    assert batch.rotation.shape == (0, 3, 3)
    assert batch.errors == {}


@pytest.mark.parametrize("options", [{"focal": "estimate"}, {"sigma": None}, {"method": "aepnp"}])
@pytest.mark.parametrize("lens", ["perspective", "fisheye"])
def test_no_problems_give_no_results_with_any_option(options: dict[str, Any], lens: str) -> None:
    camera = Camera(640, 480, 400.0, 400.0, 319.5, 239.5, lens=lens)
    assert len(fit_batch([], [], camera, **options)) == 0


def test_input_is_not_changed() -> None:
    points_3d = np.stack([p.points_3d for p in problems_of([9] * 4)])
    points_2d = np.stack([p.points_2d for p in problems_of([9] * 4)])
    copies = points_3d.copy(), points_2d.copy()
    fit_batch(points_3d, points_2d, RAGGED[0].camera)
    assert (points_3d == copies[0]).all()
    assert (points_2d == copies[1]).all()


def first_with(row: int, value: float) -> list[np.ndarray]:
    points = [p.points_3d.copy() for p in RAGGED]
    points[3][row, 0] = value
    return points


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (
            {"points_3d": first_with(17, np.nan)},
            "points_3d[3]: NaN or infinite values in row 17; remove or repair these",
        ),
        (
            {"points_2d": [p.points_2d for p in RAGGED[:5]]},
            "points_2d: 6 problems but 5 sets of image points",
        ),
        (
            {"points_2d": [p.points_2d for p in RAGGED[::-1]]},
            "points_2d[0]: 6 model points but 64 image points; "
            "row i of both must be the same keypoint",
        ),
        (
            {"points_3d": [p.points_3d[:, :2] for p in RAGGED]},
            "points_3d[0]: shape (6, 2), expected (n, 3)",
        ),
        ({"camera": [LENS] * 5}, "camera: 6 problems but 5 cameras"),
        ({"camera": [LENS] * 5 + [None]}, "camera: expected a cadalign.Camera, got NoneType"),
        ({"sigma": [1.0] * 5}, "sigma: 6 problems but 5 values"),
        ({"workers": 0}, "workers: must be >= 1, or -1 for all cores, not 0"),
        ({"workers": -2}, "workers: must be >= 1, or -1 for all cores, not -2"),
        ({"workers": 2.5}, "workers: must be >= 1, or -1 for all cores, not 2.5"),
        ({"workers": "2"}, "workers: must be >= 1, or -1 for all cores, not '2'"),
        (
            {"points_3d": None},
            "points_3d: expected a sequence of one entry per problem, got NoneType",
        ),
        (
            {"method": "best"},
            "method: unknown method 'best'; known are optimal, aepnp, aepnp-paper, epnp",
        ),
    ],
)
def test_wrong_arguments_are_refused(change: dict[str, Any], text: str) -> None:
    arguments: dict[str, Any] = {
        "points_3d": [p.points_3d for p in RAGGED],
        "points_2d": [p.points_2d for p in RAGGED],
        "camera": RAGGED[0].camera,
    } | change
    with pytest.raises(InputError) as caught:
        fit_batch(**arguments)
    assert str(caught.value) == text


def test_stack_with_nan_names_the_problem_and_the_row() -> None:
    points_3d = np.stack([p.points_3d for p in problems_of([9] * 4)])
    points_3d[2, 5, 1] = np.nan
    with pytest.raises(InputError) as caught:
        fit_batch(points_3d, np.ones((4, 9, 2)), RAGGED[0].camera)
    assert str(caught.value) == (
        "points_3d[2]: NaN or infinite values in row 5; remove or repair these"
    )


@pytest.mark.parametrize("sigma", [0.0, -1.0, np.nan])
def test_wrong_sigma_of_one_problem_is_refused_by_name(sigma: float) -> None:
    with pytest.raises(InputError, match="sigma"):
        run(RAGGED, sigma=[1.0, sigma, 1.0, 1.0, 1.0, 1.0])


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


def test_scores_without_ransac_are_refused() -> None:
    problems = problems_of([8, 9])
    with pytest.raises(InputError, match="scores: given without ransac"):
        run(problems, scores=[np.ones(8), np.ones(9)])
    with pytest.raises(InputError, match="scores: 2 problems but 1 sets"):
        run(problems, scores=[np.ones(8)], ransac=RansacOptions())


@pytest.mark.parametrize("fewer", ["points_3d", "points_2d"])
def test_arrays_of_problems_with_unequal_numbers_of_points_are_refused(fewer: str) -> None:
    camera = Camera(640, 480, 600.0, 600.0, 319.5, 239.5)
    models = np.random.default_rng(0).uniform(-1, 1, (3, 8, 3))
    images = camera.project((models + [0, 0, 5]).reshape(-1, 3)).reshape(3, 8, 2)
    models, images = (models[:, :7], images) if fewer == "points_3d" else (models, images[:, :7])
    with pytest.raises(InputError, match=r"points_2d\[0\]: . model points but . image points"):
        fit_batch(models, images, camera)
