"""Estimates with an unknown principal point, of photos that may be cropped."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cadalign import (
    Alignment,
    Camera,
    Model,
    RansacOptions,
    Result,
    View,
    align,
    fit,
    fit_batch,
)
from cadalign.cli import main
from cadalign.errors import InputError
from cadalign.evaluation.simulation import Problem, simulate_problem
from cadalign.geometry.metrics import rotation_error
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.io.observation import Observation

CENTERED = Camera(640, 480, 600.0, 600.0, 319.5, 239.5)
SIGMA = 40.0


def cropped(seed: int, points: int, noise_px: float = 1.0) -> Problem:
    """A problem whose principal point is off the image's centre as the prior says."""
    rng = np.random.default_rng(seed)
    x, y = rng.normal(0.0, SIGMA, 2)
    camera = Camera(640, 480, 600.0, 600.0, 319.5 + x, 239.5 + y)
    return simulate_problem(rng, points=points, noise_px=noise_px, camera=camera)


def fitted(problem: Problem, **options: object) -> Result:
    chosen = {"principal_sigma": SIGMA, **options}
    return fit(problem.points_3d, problem.points_2d, CENTERED, **chosen)  # type: ignore[arg-type]


@pytest.mark.long
@pytest.mark.parametrize("points", [8, 20, 60])
def test_principal_point_is_found_as_well_as_stated(points: int) -> None:
    inside, errors, ratios, without = [], [], [], []
    for seed in range(60):
        problem = cropped(seed, points)
        result = fitted(problem)
        assert result.principal_std is not None
        assert result.std is not None
        truth = problem.camera
        off = [result.camera.cx - truth.cx, result.camera.cy - truth.cy]
        inside += (np.abs(off) < 1.96 * np.array(result.principal_std)).tolist()
        errors.append(rotation_error(est=result.alignment, gt=problem.alignment))
        ratios.append(errors[-1] / result.std.rotation_deg)
        plain = fit(problem.points_3d, problem.points_2d, CENTERED)
        without.append(rotation_error(est=plain.alignment, gt=problem.alignment))
    assert 0.90 <= np.mean(inside) <= 0.99
    assert 0.7 < np.sqrt(np.mean(np.square(ratios))) < 1.25
    assert np.median(errors) < 0.85 * np.median(without)


def test_result_is_the_minimum_over_the_principal_point() -> None:
    problem = cropped(3, 20)
    result = fitted(problem)

    def cost(camera: Camera) -> float:
        known = fit(problem.points_3d, problem.points_2d, camera)
        off = np.array([camera.cx - CENTERED.cx, camera.cy - CENTERED.cy]) / SIGMA
        return float((known.residuals**2).sum() + (off**2).sum())

    here = cost(result.camera)
    for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        moved = Camera(640, 480, 600, 600, result.camera.cx + x, result.camera.cy + y)
        assert cost(moved) > here
    assert result.cost == pytest.approx(here, rel=1e-5)


def test_exact_keypoints_give_it_back() -> None:
    problem = cropped(5, 30, noise_px=0.0)
    result = fitted(problem, sigma=1e-3)
    assert result.camera.cx == pytest.approx(problem.camera.cx, abs=1e-2)
    assert result.camera.cy == pytest.approx(problem.camera.cy, abs=1e-2)
    assert "  principal    (" in str(result)


def test_it_goes_with_focal_length_noise_outliers_and_batches() -> None:
    problem = cropped(6, 40)
    both = fitted(problem, focal="estimate")
    assert both.std is not None
    assert abs(np.log(both.camera.fx / 600)) < 4 * both.std.focal
    assert fitted(problem, sigma=None).sigma == pytest.approx(1.0, rel=0.35)
    assert fitted(problem, loss="huber").principal_std is not None
    spoiled = problem.points_2d.copy()
    spoiled[:6] += 150.0
    robust = fit(
        problem.points_3d,
        spoiled,
        CENTERED,
        principal_sigma=SIGMA,
        ransac=RansacOptions(max_reproj_error=12.0),
    )
    assert not robust.inliers[:6].any()
    (one,) = fit_batch([problem.points_3d], [problem.points_2d], CENTERED, principal_sigma=SIGMA)
    assert isinstance(one, Result)
    assert one.camera == fitted(problem).camera


def test_result_and_option_survive_their_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    problem = cropped(7, 15)
    result = fitted(problem)
    again = Result.from_json(result.to_json())
    assert again.principal_std == result.principal_std
    assert again.options is not None
    assert again.options.principal_sigma == SIGMA
    path = tmp_path / "crop.json"
    Observation(problem.points_3d, problem.points_2d, CENTERED).save(path)
    assert main(["fit", str(path), "--principal-sigma", "40", "--json"]) == 0
    written = json.loads(capsys.readouterr().out)
    assert written["principal_std"] == pytest.approx(result.principal_std)
    similar = ["fit", str(path), "--shape-sigma", ".1", "--principal-sigma", "40", "--json"]
    assert main(similar) == 0
    assert json.loads(capsys.readouterr().out)["principal_std"] is not None


def seen_by_cropped(seed: int, views: int, shape_sigma: float) -> tuple[Model, list[View], Camera]:
    """A model that is only similar, seen from some sides by a camera off the image's centre."""
    rng = np.random.default_rng(seed)
    x, y = rng.normal(0.0, SIGMA, 2)
    camera = Camera(640, 480, 600.0, 600.0, 319.5 + x, 239.5 + y)
    points = rng.uniform(-0.5, 0.5, (20, 3))
    shape = points + shape_sigma * rng.normal(size=points.shape)
    scale = np.array([1.0, *np.exp(rng.normal(0, 0.15, 2))])
    seen = []
    for _ in range(views):
        turn = rotation_from_vector(rng.normal(0, 1.5, 3))
        pose = Alignment(turn, [*rng.uniform(-0.4, 0.4, 2), rng.uniform(2, 3)], scale)
        seen.append(View(CENTERED, camera.project(pose.apply(shape)) + rng.normal(size=(20, 2))))
    kind = {"shape_sigma": shape_sigma} if shape_sigma else {}
    return Model(points_3d=points, stretch_sigma=0.2, **kind), seen, camera


@pytest.mark.parametrize(
    ("views", "shape_sigma"), [(1, 0.0), (1, 0.03), (2, 0.03)], ids=["exact", "similar", "two"]
)
def test_align_finds_it_as_well_as_stated(views: int, shape_sigma: float) -> None:
    inside = []
    for seed in range(25):
        model, seen, camera = seen_by_cropped(seed, views, shape_sigma)
        result = align(model, seen, principal_sigma=SIGMA)
        assert result.principal_std is not None
        off = [result.camera.cx - camera.cx, result.camera.cy - camera.cy]
        inside += (np.abs(off) < 1.96 * np.array(result.principal_std)).tolist()
        plain = align(model, [replace(view, camera=result.camera) for view in seen])
        np.testing.assert_allclose(plain.alignment.translation, result.alignment.translation)
        assert plain.std is not None
        assert result.std is not None
        assert result.std.rotation_deg > plain.std.rotation_deg
    assert 0.87 <= np.mean(inside) <= 1.0


def test_align_of_an_exact_model_is_fit() -> None:
    problem = cropped(6, 40)
    view = View(CENTERED, problem.points_2d)
    found = align(Model(points_3d=problem.points_3d), view, principal_sigma=SIGMA)
    expected = fitted(problem)
    assert found.camera.cx == pytest.approx(expected.camera.cx)
    assert found.principal_std == pytest.approx(expected.principal_std)


def test_align_estimates_the_focal_length_with_it() -> None:
    model, seen, _ = seen_by_cropped(4, 2, 0.02)
    unknown = Camera.without_focal(640, 480)
    views = [replace(view, camera=unknown) for view in seen]
    result = align(model, views, focal="estimate", principal_sigma=SIGMA)
    assert result.std is not None
    assert abs(np.log(result.camera.fx / 600)) < 3 * result.std.focal
    assert result.cameras[0] == result.cameras[1]


def test_align_refuses_what_a_camera_measures_otherwise() -> None:
    model, seen, camera = seen_by_cropped(0, 2, 0.02)
    other = [seen[0], replace(seen[1], camera=camera)]
    with pytest.raises(InputError, match=r"principal_sigma: the camera of views\[1\] differs"):
        align(model, other, principal_sigma=SIGMA)
    for name, kind in (("mask", bool), ("image", np.uint8)):
        pictured = replace(
            seen[0], **{name: np.ones((480, 640, 3)[: 3 if name == "image" else 2], dtype=kind)}
        )
        with pytest.raises(InputError, match=rf"views\[0\].{name}: the principal point is"):
            align(model, pictured, principal_sigma=SIGMA)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"principal_sigma": -1.0}, "principal_sigma: "),
        ({"method": "aepnp"}, "method: the method 'aepnp' supports neither loss, stretch, scale"),
    ],
)
def test_wrong_options_are_refused(options: dict[str, object], message: str) -> None:
    with pytest.raises(InputError) as caught:
        fitted(cropped(0, 10), **options)
    assert str(caught.value).startswith(message)


def test_views_that_are_left_out_are_named_as_without_it() -> None:
    model, seen, _ = seen_by_cropped(0, 2, 0.0)
    two = replace(seen[0], points_2d=seen[0].pixels[:2], ids=seen[0].keypoint_ids[:2])
    views = [seen[0], two, seen[1]]
    known, shifted = (align(model, views, principal_sigma=each) for each in (None, 1e-3))
    assert known.warnings == shifted.warnings
    assert known.warnings
    assert [each.view for each in known.evidence] == [each.view for each in shifted.evidence]
    alone = align(model, views[:2], principal_sigma=SIGMA)
    assert np.isfinite(alone.sensitivity().by_points_2d).all()


def test_keypoints_of_a_similar_model_are_as_uncertain_in_both_frames() -> None:
    model, seen, _ = seen_by_cropped(0, 1, 0.02)
    known, shifted = (align(model, seen, principal_sigma=each) for each in (None, SIGMA))
    for name in ("points_covariance", "points_cam_covariance"):
        before, after = getattr(known, name), getattr(shifted, name)
        assert np.trace(after.sum(axis=0)) > 1.01 * np.trace(before.sum(axis=0))
