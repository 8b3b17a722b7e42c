"""`Library.retrieve(shape=...)`: ranking by the estimated shape, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from support.refusals import refusal_line

from cadalign import Alignment, Box, Camera, FocalPrior, Library, ShapeModel, View, align
from cadalign.cli import main
from cadalign.errors import InputError
from cadalign.io.observation import Observation
from cadalign.metrics import box_iou_up_to_scale
from cadalign.render.scene import LIGHT_GREY
from cadalign.retrieval import LibraryModel
from cadalign.retrieval.page import draw_match
from cadalign.shapes.examples import Example

CAMERA = Camera(width=640, height=480, fx=935.0, fy=935.0, cx=319.5, cy=239.5)
POSE = Alignment.from_packed(
    np.array([0.8, 0, 0.6, 0.36, -0.8, -0.48, 0.48, 0.6, -0.64, 0.02, -0.01, 2.4, 1, 1, 1])
)


def make_table(number: int, category: str = "table") -> LibraryModel:
    """A table of random width, height, depth, overhang and shelf, none a stretch of another."""
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


def test_a_match_by_shape_has_the_deviations_of_the_shape() -> None:
    """In the unit of the matched model, whose length along x is held."""
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
    assert np.abs(wide.residuals).max() < 30
    assert abs(iou(wide, model, pose) - iou(straight, model)) < 0.15


def iou(match: Any, model: LibraryModel, pose: Alignment = POSE) -> float:
    return box_iou_up_to_scale(est=match.box, gt=Box.from_model(model.bounds, pose))


@pytest.mark.long
def test_first_match_of_unseen_objects_overlaps_more_than_by_fits() -> None:
    by_shape = [iou(first(model), model) for model in OBJECTS]
    by_fit = [iou(first(model, shape=None), model) for model in OBJECTS]
    assert np.mean(by_shape) > np.mean(by_fit)
    assert np.median(by_shape) > 0.85


def gap(model: LibraryModel, other: LibraryModel) -> float:
    """Distance of the keypoints, up to size and place."""
    one, two = model.xyz - model.xyz.mean(axis=0), other.xyz - other.xyz.mean(axis=0)
    return float(np.linalg.norm(one - two * (one * two).sum() / (two * two).sum()))


@pytest.mark.long
def test_unstretched_first_match_is_among_the_most_similar() -> None:
    places = []
    for model in OBJECTS:
        best = first(model, stretch="none")
        assert best.alignment.scale.tolist() == [1, 1, 1]
        own = gap(model, LIBRARY[best.category, best.model_id])
        places.append(sum(gap(model, other) < own for other in MODELS))
    assert np.median(places) <= len(MODELS) / 30


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
    np.testing.assert_allclose(one[0].alignment.packed, other[0].alignment.packed, atol=1e-6)


def test_matches_are_sorted_and_scores_sum_to_one() -> None:
    matches = rank_all(LIBRARY, OBJECTS[2])
    scores = [match.score for match in matches]
    assert scores == sorted(scores, reverse=True)
    assert sum(scores) == pytest.approx(1)


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


def test_excluded_models_are_left_out() -> None:
    best = first(OBJECTS[0])
    other = first(OBJECTS[0], exclude=[(best.category, best.model_id)])
    assert other.model_id != best.model_id


@pytest.mark.slow
def test_outliers_do_not_count_with_a_robust_loss() -> None:
    model = OBJECTS[5]
    pixels = seen(model)
    pixels[8] += 150
    robust = LIBRARY.retrieve(pixels, model.ids, CAMERA, shape=SHAPE, loss="cauchy")
    plain = LIBRARY.retrieve(pixels, model.ids, CAMERA, shape=SHAPE)
    assert iou(robust[0], model) > iou(plain[0], model)
    assert iou(robust[0], model) > iou(first(model), model) - 0.1


@pytest.mark.long
def test_categories_share_the_probability() -> None:
    tall = [
        replace(each, category="mast", xyz=each.xyz * [0.2, 2, 0.2], bounds=each.bounds * 1.0)
        for each in MODELS
    ]
    tall = [
        replace(each, bounds=np.array([each.xyz.min(axis=0), each.xyz.max(axis=0)]))
        for each in tall
    ]
    library = Library.from_models([*MODELS, *tall])
    shapes = {"table": SHAPE, "mast": learn(tall)}
    for model in (OBJECTS[0], make_table(2000)):
        matches = rank_all(library, model, shape=shapes)
        tables = [match for match in matches if match.category == "table"]
        assert len(tables) == len(MODELS)
        assert sum(match.score for match in tables) > 0.99
    only = rank_all(library, OBJECTS[0], shape=shapes, category="mast")
    assert {match.category for match in only} == {"mast"}
    assert {match.category for match in rank_all(library, OBJECTS[0])} == {"table"}


NAMED = ShapeModel.from_basis(MODELS[0].xyz, [MODELS[0].xyz], [0.1], ids=list("abcdefghij"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"shape": "chair.shape"},
            "shape: expected a cadalign.ShapeModel, or some by category, got str",
        ),
        ({"shape": {}}, "shape: expected a cadalign.ShapeModel, or some by category, got dict"),
        ({"shape": {"table": 3}}, "shape['table']: expected a cadalign.ShapeModel, got int"),
        (
            {"shape": {"mug": SHAPE}},
            "shape: unknown category 'mug'; known are table",
        ),
        (
            {"shape": {"table": NAMED}},
            "shape['table']: its keypoints have names; learn it from models with semantic ids",
        ),
        (
            {"method": "epnp"},
            "method: 'epnp' does not apply to a ranking by shape; "
            "leave it at 'optimal', or rank without shape",
        ),
        (
            {"none_prior": 0.1},
            "none_prior: 0.1 does not apply to a ranking by shape; "
            "leave it at 0.5, or rank without shape",
        ),
    ],
)
def test_bad_input_is_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError) as caught:
        first(OBJECTS[0], **options)
    assert str(caught.value) == message


def test_keypoints_that_the_shape_lacks_are_refused_if_too_few_are_left() -> None:
    few = ShapeModel.from_basis(MODELS[0].xyz[:2], [MODELS[0].xyz[:2]], [0.1])
    with pytest.raises(InputError, match="no shape model has 3 of the keypoints"):
        first(OBJECTS[0], shape=few, category="table")


class TestCommand:
    @pytest.fixture(scope="class")
    @staticmethod
    def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
        folder = tmp_path_factory.mktemp("by_shape")
        LIBRARY.save(folder / "tables.cadalign")
        SHAPE.save(folder / "table.shape")
        Observation(
            points_3d=np.zeros((10, 3)),
            points_2d=seen(OBJECTS[0], 1.0),
            camera=CAMERA,
            ids=np.arange(10),
        ).save(folder / "seen.json")
        return folder

    def test_ranks_as_the_call(self, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
        arguments = ["retrieve", "seen.json", "--library", "tables.cadalign", "--json"]
        arguments[1], arguments[3] = str(folder / "seen.json"), str(folder / "tables.cadalign")
        assert main([*arguments, "--shape", str(folder / "table.shape")]) == 0
        found = [match["model_id"] for match in json.loads(capsys.readouterr().out)]
        called = LIBRARY.retrieve(seen(OBJECTS[0], 1.0), np.arange(10), CAMERA, shape=SHAPE)
        assert found == [match.model_id for match in called]

    def test_two_files_of_a_category_are_refused(
        self, folder: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        line = refusal_line(
            capsys,
            *("retrieve", folder / "seen.json", "--library", folder / "tables.cadalign"),
            *("--shape", folder / "table.shape", folder / "table.shape"),
        )
        assert line == "--shape: two files of the category 'table'"


# --- without a focal length --------------------------------------------------------------------

UNKNOWN = Camera.without_focal(640, 480)


def test_an_unknown_focal_length_is_estimated_with_the_shape() -> None:
    model, prior = OBJECTS[0], FocalPrior(900.0, 0.1)
    pixels = seen(model, 1.0)
    found = LIBRARY.retrieve(pixels, model.ids, UNKNOWN, shape=SHAPE, sigma=1.0, focal_prior=prior)
    view = View(UNKNOWN, pixels, sigma=1.0)
    expected = align(SHAPE, view, focal="estimate", focal_prior=prior)
    assert {match.camera for match in found} == {expected.camera}
    assert found[0].model_id == first(model).model_id or found[0].score < 0.9
    assert iou(found[0], model) > 0.6


def test_the_most_probable_category_gives_the_focal_length() -> None:
    other = [make_table(number + 5000, "stool") for number in range(40)]
    squashed = [replace(each, xyz=each.xyz * [3.0, 0.2, 1.0]) for each in other]
    library, model = Library.from_models(MODELS + squashed), OBJECTS[1]
    shapes = {"table": SHAPE, "stool": learn(squashed)}
    asked: dict[str, Any] = {"sigma": 1.0, "focal_prior": FocalPrior(935.0, 0.05)}
    pixels = seen(model, 1.0)
    both = library.retrieve(pixels, model.ids, UNKNOWN, shape=shapes, **asked)
    alone = LIBRARY.retrieve(pixels, model.ids, UNKNOWN, shape=SHAPE, **asked)
    assert both[0].category == "table"
    assert both[0].camera == alone[0].camera


def test_models_themselves_are_not_ranked_without_a_focal_length() -> None:
    with pytest.raises(InputError) as caught:
        LIBRARY.retrieve(seen(OBJECTS[0]), OBJECTS[0].ids, UNKNOWN)
    assert str(caught.value) == (
        "camera: the focal length is unknown, without which no model's pose is searched; "
        "rank by shape=, which estimates it, or give it: camera.with_focal(...)"
    )


def test_command_estimates_a_focal_length_with_the_shape_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = OBJECTS[0]
    SHAPE.save(tmp_path / "table.shape")
    LIBRARY.save(tmp_path / "tables.library")
    query = tmp_path / "query.json"
    Observation(model.xyz, seen(model), UNKNOWN, ids=model.ids).save(query)
    command = ["retrieve", str(query), "--library", str(tmp_path / "tables.library")]
    assert refusal_line(capsys, *command) == (
        f"{query}: camera: the focal length is unknown, without which no model's pose is searched; "
        "rank by --shape, which estimates it, or give a calibrated camera"
    )
    out = ["--shape", str(tmp_path / "table.shape"), "--out", str(tmp_path / "out")]
    assert main([*command, *out, "--top", "2"]) == 0
    assert "Focal length: estimated as" in capsys.readouterr().err
    # The overlays are drawn with the estimated focal length.
    found = LIBRARY.retrieve(seen(model), model.ids, UNKNOWN, shape=SHAPE, top=2)
    camera, grey = found[0].camera, np.full((480, 640, 3), LIGHT_GREY, np.uint8)
    assert camera is not None
    assert camera.focal_known
    overlay = cv2.imread(str(tmp_path / "out" / "overlay_01.png"))[..., ::-1]
    np.testing.assert_array_equal(overlay, draw_match(grey, camera, found[0]))
