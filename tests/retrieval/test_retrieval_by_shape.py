"""`Library.retrieve(shape=...)`: ranking by the estimated shape, and invalid arguments."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cadalign import Alignment, Box, Camera, Library, ShapeModel, View, align
from cadalign.cli import main
from cadalign.errors import InputError
from cadalign.io.observation import Observation
from cadalign.metrics import box_iou_up_to_scale
from cadalign.retrieval import LibraryModel
from cadalign.retrieval.by_shape import gaussians_of, shape_posterior
from cadalign.shapes.examples import Example

CAMERA = Camera(width=640, height=480, fx=935.0, fy=935.0, cx=319.5, cy=239.5)
POSE = Alignment.from_vector(
    np.array([0.8, 0, 0.6, 0.36, -0.8, -0.48, 0.48, 0.6, -0.64, 0.02, -0.01, 2.4, 1, 1, 1])
)


def make_table(number: int, category: str = "table") -> LibraryModel:
    """A table of random width, height, depth, overhang and shelf."""
    rng = np.random.default_rng([number, 7])
    w, h, d = np.array([0.3, 0.25, 0.2]) * rng.uniform(0.6, 1.4, 3)
    inset, shelf = rng.uniform(0.1, 1.0, 2)
    signs = [(-1, -1), (-1, 1), (1, 1), (1, -1)]
    top = [(w * x, h, d * z) for x, z in signs]
    feet = [(w * x * inset, -h, d * z * inset) for x, z in signs]
    middle = [(w * x * inset, h * (2 * shelf - 1), d * z * inset) for x, z in signs[:2]]
    xyz = np.array(top + feet + middle)
    bounds = np.array([xyz.min(axis=0), xyz.max(axis=0)])
    return LibraryModel(category, f"{number:03d}", xyz, np.arange(len(xyz)), bounds)


def learn(models: list[LibraryModel]) -> ShapeModel:
    examples = [
        Example(model.model_id, model.ids.tolist(), model.xyz, bounds=model.bounds)
        for model in models
    ]
    return ShapeModel.learn(examples, category=models[0].category, components=1)


MODELS = [make_table(number) for number in range(150)]
LIBRARY = Library.from_models(MODELS)
SHAPE = learn(MODELS)
OBJECTS = [make_table(number) for number in range(1000, 1012)]


def seen(model: LibraryModel, noise_px: float = 0.0) -> np.ndarray:
    pixels = CAMERA.project(POSE.apply(model.xyz))
    return pixels + noise_px * np.random.default_rng(3).standard_normal(pixels.shape)


def first(model: LibraryModel, library: Library = LIBRARY, **options: Any) -> Any:
    options = {"shape": SHAPE, "sigma": 1.0, **options}
    return library.retrieve(seen(model, 1.0), model.ids, CAMERA, **options)[0]


def test_a_match_by_shape_has_the_uncertainty_of_the_shape() -> None:
    """In the unit of the matched model, whose length along x is fixed."""
    model, options = OBJECTS[0], {"ids": OBJECTS[0].ids.tolist(), "sigma": 1.0}
    of_shape = align(SHAPE, View(CAMERA, seen(model, 1.0), **options))
    best = first(model)
    assert of_shape.covariance is not None
    x, y = of_shape.covariance[6:8, 6:8]
    assert best.std.scale[0] == 0
    assert best.std.scale[1] == pytest.approx(np.sqrt(x[0] + y[1] - 2 * x[1]), rel=1e-6)
    assert best.std.rotation_deg == pytest.approx(of_shape.std.rotation_deg, rel=1e-6)
    assert 0 < best.std.translation[2] < 0.2 * best.alignment.translation[2]


def test_a_wide_lens_ranks_what_is_beside_it() -> None:
    camera = Camera(900, 900, 250.0, 250.0, 449.5, 449.5, (0.01, -0.003, 0, 0), lens="fisheye")
    pose = Alignment(POSE.rotation, [1.2, 0.2, -0.1], POSE.scale)
    model = OBJECTS[0]
    pixels = camera.project(pose.apply(model.xyz))
    wide, *_ = LIBRARY.retrieve(pixels, model.ids, camera, shape=SHAPE)
    straight, *_ = LIBRARY.retrieve(seen(model), model.ids, CAMERA, shape=SHAPE)
    assert wide.alignment.translation[2] < 0.2
    assert np.abs(wide.result.residuals).max() < 30
    assert abs(iou(wide, model, pose) - iou(straight, model)) < 0.15


def iou(match: Any, model: LibraryModel, pose: Alignment = POSE) -> float:
    return box_iou_up_to_scale(est=match.box, gt=Box.from_model(model.bounds, pose))


@pytest.mark.long
@pytest.mark.parametrize("count", [5, 10])
def test_models_of_the_library_are_found(count: int) -> None:
    ranks = []
    for model in MODELS[::15]:
        matches = LIBRARY.retrieve(
            seen(model)[:count], model.ids[:count], CAMERA, sigma=0.2, shape=SHAPE, top=150
        )
        assert len(matches) == len(MODELS)
        ranks.append([match.model_id for match in matches].index(model.model_id))
    assert np.median(ranks) <= (1 if count == 10 else 8)


@pytest.mark.slow
def test_size_and_place_of_models_do_not_count() -> None:
    model = OBJECTS[0]
    moved = [
        replace(each, xyz=1.1 * each.xyz + 0.02, bounds=1.1 * each.bounds + 0.02)
        if row % 2
        else each
        for row, each in enumerate(MODELS)
    ]
    before = [match.model_id for match in rank_all(LIBRARY, model)]
    after = [match.model_id for match in rank_all(Library.from_models(moved), model)]
    assert before[:10] == after[:10]


def rank_all(library: Library, model: LibraryModel, **options: Any) -> list[Any]:
    options = {"shape": SHAPE, "top": len(library), "shape_sigma": 0.05, **options}
    return library.retrieve(seen(model, 1.0), model.ids, CAMERA, **options)


def test_result_does_not_depend_on_the_order_of_keypoints() -> None:
    model, order = OBJECTS[1], np.random.default_rng(0).permutation(10)
    sigma = np.linspace(0.5, 3, 10)
    one = LIBRARY.retrieve(seen(model), model.ids, CAMERA, sigma=sigma, shape=SHAPE)
    other = LIBRARY.retrieve(
        seen(model)[order], model.ids[order], CAMERA, sigma=sigma[order], shape=SHAPE
    )
    assert [match.model_id for match in one] == [match.model_id for match in other]
    np.testing.assert_allclose(one[0].alignment.vector, other[0].alignment.vector, atol=1e-6)


def test_stretched_box_is_close_to_the_estimated_one() -> None:
    model = OBJECTS[3]
    estimate = align(SHAPE, View(CAMERA, seen(model, 1.0), ids=model.ids.tolist()))
    best = first(model)
    assert best.alignment.scale[0] == 1
    assert box_iou_up_to_scale(est=best.box, gt=estimate.box) > 0.9
    assert best.rms < 20


@pytest.mark.slow
def test_models_that_lack_keypoints_are_ranked_below_the_same_with_them() -> None:
    model = OBJECTS[4]
    best = first(model)
    whole = LIBRARY[best.category, best.model_id]
    kept = whole.ids[whole.ids != 9]
    part = replace(whole, model_id="part", xyz=whole.xyz[kept], ids=kept)
    matches = rank_all(Library.from_models([*MODELS, part]), model)
    ranks = {match.model_id: rank for rank, match in enumerate(matches)}
    assert ranks[best.model_id] < ranks["part"]
    assert next(match for match in matches if match.model_id == "part").missing_ids == (9,)


@pytest.mark.slow
def test_outliers_do_not_count_with_a_robust_loss() -> None:
    model = OBJECTS[5]
    pixels = seen(model)
    pixels[8] += 150
    robust = LIBRARY.retrieve(pixels, model.ids, CAMERA, shape=SHAPE, loss="cauchy")
    plain = LIBRARY.retrieve(pixels, model.ids, CAMERA, shape=SHAPE)
    assert iou(robust[0], model) > iou(plain[0], model)
    assert iou(robust[0], model) > iou(first(model), model) - 0.1


NAMED = ShapeModel.from_basis(MODELS[0].xyz, [MODELS[0].xyz], [0.1], ids=list("abcdefghij"))
FEW = replace(NAMED, ids=tuple(range(100, 110)), category="table")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"shape": "chair.shape"}, "shape: expected a cadalign.ShapeModel, got str"),
        (
            {"shape": replace(SHAPE, category="mug")},
            "shape: unknown category 'mug'; known are table; ",
        ),
        ({"shape": NAMED}, "shape: its keypoints have names; learn it from models with semantic"),
        ({"shape": FEW}, "ids: the shape model has fewer than 3 of the keypoints; check them, or"),
    ],
)
def test_bad_input_is_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError) as caught:
        first(OBJECTS[0], **options)
    assert str(caught.value).startswith(message)


def test_the_command_ranks_as_the_call(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    library, shape, query = (str(tmp_path / name) for name in ("lib", "table.shape", "seen.json"))
    LIBRARY.save(library)
    SHAPE.save(shape)
    pixels = seen(OBJECTS[0], 1.0)
    Observation(np.zeros((10, 3)), pixels, CAMERA, ids=np.arange(10)).save(query)
    assert main(["retrieve", query, "--library", library, "--shape", shape, "--json"]) == 0
    found = [match["model_id"] for match in json.loads(capsys.readouterr().out)]
    called = LIBRARY.retrieve(pixels, np.arange(10), CAMERA, shape=SHAPE)
    assert found == [match.model_id for match in called]


def test_a_wrong_estimate_of_the_shape_is_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    first(OBJECTS[0])
    assert not caplog.records
    LIBRARY.retrieve(seen(OBJECTS[0])[::-1], OBJECTS[0].ids, CAMERA, shape=SHAPE)
    assert "the estimated shape: " in caplog.text


# --- the posterior of all keypoints and the box ------------------------------------------------

NEAR = Alignment(np.diag([1.0, -1.0, -1.0]), np.array([0.1, 0.05, 5.0]), np.ones(3))
LENS = replace(CAMERA, fy=920.0, distortion=(-0.1, 0.03, 0.001, -0.002))
MEAN = np.random.default_rng(0).uniform(-0.5, 0.5, (9, 3))


def make_shape(residual_sigma: float = 0.0, modes: int = 4) -> ShapeModel:
    rng = np.random.default_rng(1)
    directions = rng.standard_normal((modes, 9, 3))
    box = [MEAN.min(axis=0), MEAN.max(axis=0)]
    return ShapeModel.from_basis(
        MEAN, directions, np.full(modes, 0.05), box=box, residual_sigma=residual_sigma
    )


def make_view(camera: Camera = CAMERA, count: int = 7) -> View:
    rng = np.random.default_rng(2)
    points = MEAN + 0.03 * rng.standard_normal(MEAN.shape)
    sigma = rng.uniform(0.5, 3, count)
    pixels = camera.project(NEAR.apply(points))[:count]
    pixels += sigma[:, None] * rng.standard_normal(pixels.shape)
    return View(camera, pixels, ids=range(count), sigma=sigma)


@pytest.mark.parametrize("camera", [CAMERA, LENS])
@pytest.mark.parametrize("residual_sigma", [0.0, 0.02])
def test_agrees_with_the_alignment_of_one_gaussian(camera: Camera, residual_sigma: float) -> None:
    view, shape = make_view(camera), make_shape(residual_sigma)
    result = align(shape, view)
    assert not result.alternatives
    found, _ = shape_posterior(result, view)
    assert found.weights.tolist() == [1.0]
    means = found.means.reshape(-1, 3)
    np.testing.assert_allclose(means[:-2], result.points_3d, atol=2e-5)
    # The box of an alignment is enlarged to contain the observed keypoints.
    given = result.points_3d[:7]
    box = [np.minimum(means[-2], given.min(axis=0)), np.maximum(means[-1], given.max(axis=0))]
    np.testing.assert_allclose(box, result.bounds, atol=2e-5)
    blocks = found.covariances.reshape(11, 3, 11, 3)[np.arange(9), :, np.arange(9)]
    scale = result.points_covariance.max()
    np.testing.assert_allclose(blocks, result.points_covariance, atol=1e-4 * scale)


def test_without_information_it_is_the_prior() -> None:
    shape = make_shape(0.01)
    view = View(CAMERA, make_view().points_2d, ids=range(7), sigma=1e5)
    found, _ = shape_posterior(align(shape, view), view)
    np.testing.assert_allclose(found.covariances, gaussians_of(shape).covariances, atol=1e-6)


def test_evidence_prefers_the_category_of_the_object() -> None:
    shape, view = make_shape(0.01), make_view()
    rng = np.random.default_rng(5)
    other = ShapeModel.from_basis(
        rng.uniform(-0.5, 0.5, (9, 3)), rng.standard_normal((4, 9, 3)), np.full(4, 0.05)
    )
    _, own = shape_posterior(align(shape, view), view)
    assert own > shape_posterior(align(other, view), view)[1] + 10
