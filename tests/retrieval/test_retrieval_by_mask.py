"""Ranking by a mask alone: the object's own model, the table, the command, refusals."""

from __future__ import annotations

import json
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.refusals import refusal_line

from cadalign import Alignment, Camera, Library, ShapeModel, load_mesh
from cadalign.cli import main
from cadalign.datasets import KeypointNet
from cadalign.errors import DegenerateError, InputError
from cadalign.io.images import write_image
from cadalign.io.observation import Observation
from cadalign.metrics import rotation_error
from cadalign.render import Scene, cast_geometry, look_at
from cadalign.retrieval import LibraryModel
from cadalign.retrieval.query import read_query_mask

pytestmark = pytest.mark.slow

CAMERA = Camera(320, 240, 467, 467, 159.5, 119.5)


@pytest.fixture(scope="module")
def library(sample_root: Path) -> Library:
    dataset = KeypointNet(sample_root)
    kept = [key for key in sorted(dataset.ids()) if key[1].endswith(("_000", "_001"))]
    return Library.from_models([dataset[key] for key in kept if key[0] in ("car", "chair")])


def masked(library: Library, key: tuple[str, str]) -> tuple[np.ndarray, Alignment]:
    """The mask of a stretched model, and its alignment."""
    pose = look_at(azimuth=40.0, elevation=20.0, distance=2.2)
    truth = Alignment(pose.rotation, pose.translation, np.array([1.0, 1.2, 0.85]))
    return cast_geometry(Scene(library[key].load_mesh()), CAMERA, truth).mask, truth


def test_a_wide_lens_finds_what_is_beside_it(library: Library) -> None:
    wide = Camera(400, 400, 120, 120, 199.5, 199.5, (0.01, -0.003, 0, 0), lens="fisheye")
    key = next(key for key in library.keys if key[0] == "car")
    pose = look_at(azimuth=40.0, elevation=20.0, distance=1.4)
    turn = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # to the camera's right
    scale = np.array([1.0, 1.2, 0.85])
    truth = Alignment(turn @ pose.rotation, turn @ pose.translation, scale)
    mask = cast_geometry(Scene(library[key].load_mesh()), wide, truth).mask
    (match,) = library.retrieve(mask=mask, camera=wide, category=key[0])  # others take long
    assert (match.category, match.model_id) == key
    assert rotation_error(est=match.alignment, gt=truth) < 2


@pytest.mark.parametrize("category", ["chair", "car"])
def test_the_stretched_model_is_found(library: Library, category: str) -> None:
    key, other = sorted(library.keys, key=lambda key: key[0] != category)
    mask, truth = masked(library, key)
    matches = library.retrieve(mask=mask, camera=CAMERA)
    assert (matches[0].category, matches[0].model_id) == key
    assert rotation_error(est=matches[0].alignment, gt=truth) < 2
    assert matches[0].silhouette_iou is not None
    assert matches[0].silhouette_iou > 0.98
    assert matches[0].shared == 0
    scores = [match.score for match in matches]
    assert scores == sorted(scores, reverse=True)
    assert sum(scores) == pytest.approx(1)
    # Silhouettes are known by their mesh, which is read once.
    meshes = library._table.mesh_at
    read = meshes.cache_info().misses
    (alone,) = library.retrieve(
        mask=255 * mask.astype(np.uint8), camera=CAMERA, exclude=[other], workers=1
    )
    assert meshes.cache_info().misses == read
    assert alone.alignment == matches[0].alignment
    assert alone.score == 1
    ids, pixels = library[key].ids, CAMERA.project(truth.apply(library[key].xyz))
    library.retrieve(pixels, ids, CAMERA, mask=mask, category=key[0])
    before = meshes.cache_info().hits
    library.retrieve(pixels, ids, CAMERA, mask=mask, category=key[0])
    assert meshes.cache_info().hits > before  # also of keypoints ranked again by a mask
    pickle.loads(pickle.dumps(library))


def test_an_observation_of_a_mask_is_ranked_by_it(
    library: Library, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    key = next(key for key in library.keys if key[0] == "chair")
    mask, _ = masked(library, key)
    write_image(tmp_path / "mask.png", np.where(mask, 255, 0).astype(np.uint8))
    library.save(tmp_path / "models.cadalign")
    view = {"camera": CAMERA.to_dict(), "mask": "mask.png"}
    (tmp_path / "seen.json").write_text(json.dumps({"views": [view]}))
    command = ["retrieve", str(tmp_path / "seen.json"), "--library"]
    command += [str(tmp_path / "models.cadalign"), "--json", "--out", str(tmp_path / "out")]
    assert main([*command, "--category", "chair"]) == 0
    (first,) = json.loads(capsys.readouterr().out)
    assert (first["category"], first["model_id"]) == key
    shape = ShapeModel.from_basis(np.eye(4, 3), np.ones((1, 4, 3)), [0.1], category="chair")
    shape.save(tmp_path / "chair.shape")
    line = refusal_line(capsys, *command[:4], "--shape", tmp_path / "chair.shape")
    assert line.startswith("--shape: has no effect on a mask alone; leave it out")
    # Its model and pose are an observation and a fit, of which the other commands make more.
    best = Observation.load(tmp_path / "out" / "match_01.json")
    assert best.model == library[key].mesh_path
    assert best.evidence.mask == tmp_path / "mask.png"
    fit = tmp_path / "out" / "match_01_fit"
    assert main(["export", str(fit), "--to", str(tmp_path / "best.obj")]) == 0
    placed = Alignment.from_dict(first["alignment"]).apply(library[key].load_mesh().vertices)
    assert np.abs(load_mesh(tmp_path / "best.obj").vertices - placed).max() < 1e-6


def test_models_without_a_mesh_are_counted(
    library: Library, caplog: pytest.LogCaptureFixture
) -> None:
    first, second, *_ = library
    some = Library.from_models([replace(first, mesh_path=None), second])
    mask, _ = masked(library, second.key)
    assert len(some.retrieve(mask=mask, camera=CAMERA)) == 1
    assert "1 of 2 models have no mesh that can be read, and are not ranked" in caplog.text


def test_a_mask_of_labels_is_read_as_a_fit_reads_it(tmp_path: Path) -> None:
    mask = np.zeros((240, 320), dtype=np.uint8)
    mask[90:150, 100:200] = 1
    write_image(tmp_path / "labels.png", mask)
    assert np.array_equal(read_query_mask(tmp_path / "labels.png", CAMERA), mask > 0)
    write_image(tmp_path / "white.png", np.dstack([255 * mask] * 3))
    assert np.array_equal(read_query_mask(tmp_path / "white.png", CAMERA), mask > 0)


def test_a_part_that_is_hidden_does_not_hide_the_model(library: Library) -> None:
    """No outline meets the mask whole, so that every model is aligned with what is left."""
    key = next(key for key in library.keys if key[0] == "chair")
    mask, _ = masked(library, key)
    columns = np.nonzero(mask)[1]
    mask[:, : int(np.quantile(columns, 0.2))] = False
    matches = library.retrieve(mask=mask, camera=CAMERA)
    assert matches[0].category == "chair"
    assert key in [(match.category, match.model_id) for match in matches]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mask": None}, "points_2d: keypoints are missing; give keypoints with their ids, or"),
        ({"points_2d": np.zeros((4, 2))}, "ids: keypoints are missing"),
        ({"camera": None}, "camera: no camera is given; give a cadalign.Camera"),
        (
            {"camera": Camera.without_focal(320, 240)},
            "camera: a mask alone does not tell the focal length; give a calibrated camera, or",
        ),
        ({"mask": np.zeros((240, 320), dtype=bool)}, "mask: "),
        ({"shape_sigma": 0.03}, "shape_sigma: has no effect on a mask alone; leave it out"),
        ({"max_stretch": 1.1}, "max_stretch: has no effect on a mask alone; leave it out"),
    ],
)
def test_refusals(library: Library, change: dict[str, Any], message: str) -> None:
    key = next(key for key in library.keys if key[0] == "chair")
    given: dict[str, Any] = {"mask": masked(library, key)[0], "camera": CAMERA} | change
    with pytest.raises((InputError, DegenerateError)) as refused:
        library.retrieve(**given)
    assert str(refused.value).startswith(message)


def test_models_without_meshes_cannot_be_ranked_by_a_mask(library: Library) -> None:
    key = next(key for key in library.keys if key[0] == "chair")
    mask, _ = masked(library, key)
    xyz = np.random.default_rng(0).uniform(-0.3, 0.3, (6, 3))
    bounds = np.array([xyz.min(axis=0), xyz.max(axis=0)])
    bare = Library.from_models([LibraryModel("box", "a", xyz, np.arange(6), bounds)])
    with pytest.raises(InputError, match="library: no model has a mesh, without which a mask"):
        bare.retrieve(mask=mask, camera=CAMERA)
