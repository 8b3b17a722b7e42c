"""Arguments that are easily mistaken for each other get an error that says what to give."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.refusals import refusal_text
from support.scenes import CAMERA, keypoints, truth_of

from cadalign import (
    Library,
    Mesh,
    Model,
    Result,
    ShapeModel,
    View,
    align,
    load_mesh,
)
from cadalign.datasets import KeypointNet, write_sample_dataset
from cadalign.metrics import rotation_error
from cadalign.retrieval import LibraryModel

POINTS, TRUTH = keypoints(), truth_of((1.0, 0.7, 1.9))
MODEL = Model(points_3d=POINTS)
VIEW = View(CAMERA, CAMERA.project(TRUTH.apply(POINTS)))
BOX = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]), [[0, 2, 1], [0, 1, 3]])
EACH_ID = "give the id of each keypoint"
VIEWS_FIRST = "give the model first, then the views"
GIVEN: list[tuple[Callable[..., Any], str]] = [
    (
        lambda: align(VIEW, MODEL),  # type: ignore[arg-type]
        f"views: expected a cadalign.View or several, got Model; {VIEWS_FIRST}",
    ),
    (
        lambda: align(MODEL, CAMERA),  # type: ignore[arg-type]
        f"views: expected a cadalign.View or several, got Camera; {VIEWS_FIRST}",
    ),
    (
        lambda: Model(points_3d=POINTS, mesh="chair.obj"),  # type: ignore[arg-type]
        "mesh: expected a cadalign.Mesh, got str; read it with cadalign.load_mesh",
    ),
    (
        lambda: Model(mesh=BOX, shape_sigma=0.05),
        "shape_sigma: the model has no keypoints; give points_3d, whose positions it is about, "
        "or leave it away",
    ),
    (
        lambda: align(MODEL, VIEW).mesh(3),  # type: ignore[arg-type]
        "mesh: expected a cadalign.Mesh or a path, got int; read it with cadalign.load_mesh",
    ),
    (
        lambda: align(Model(mesh=BOX), VIEW),
        "views[0].ids: the model has no keypoint 0, 1, 2, 3, 4; give the model points_3d=",
    ),
    (
        lambda: Model(points_3d=POINTS, ids=5),  # type: ignore[arg-type]
        f"ids: expected a sequence of numbers or names, got int; {EACH_ID}",
    ),
    (
        lambda: View(CAMERA, [[9, 20], [300, 4]], ids="ab"),
        f"ids: expected a sequence of numbers or names, got str; {EACH_ID}",
    ),
    (
        lambda: align(MODEL, VIEW).radius("a"),  # type: ignore[arg-type]
        "probability: 'a' is not between 0 and 1",
    ),
    (
        lambda: align(MODEL, VIEW).radius(0.9, dimension="a"),  # type: ignore[arg-type]
        "dimension: 'a' is not a positive number",
    ),
    (
        lambda: ShapeModel.learn("chairs"),  # type: ignore[arg-type]
        "models[0]: expected a cadalign.Example, got str; "
        "`cadalign shape learn` takes the folder of a data set",
    ),
    (
        lambda: rotation_error(est=align(MODEL, VIEW), gt=TRUTH),  # type: ignore[arg-type]
        "est: expected a cadalign.Alignment, got Result; give the result's alignment",
    ),
    (
        lambda: Library.from_models([MODEL]),  # type: ignore[list-item]
        "models: expected a LibraryModel or a data set's model, got Model; "
        "give the models of `cadalign.datasets`",
    ),
]


@pytest.mark.parametrize(("call", "message"), GIVEN, ids=lambda each: getattr(each, "name", None))
def test_mistakes_are_named(call: Callable[..., Any], message: str) -> None:
    assert refusal_text(call) == message


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> KeypointNet:
    folder = tmp_path_factory.mktemp("sample")
    return KeypointNet(write_sample_dataset(folder, per_category=4, categories=["chair"]))


def test_library_takes_the_models_of_a_data_set(dataset: KeypointNet) -> None:
    models = list(dataset.subset(categories=["chair"]))
    library = Library.from_models(models)
    assert len(library) == 4
    same = Library.from_models([LibraryModel.of_annotated(each) for each in models])
    assert sorted(each.model_id for each in same) == sorted(each.model_id for each in library)


def test_meshes_are_named_by_their_paths(dataset: KeypointNet, tmp_path: Path) -> None:
    path = next(iter(dataset.subset(categories=["chair"]))).mesh_path
    assert path is not None
    result: Result = align(MODEL, VIEW)
    np.testing.assert_array_equal(result.mesh(str(path)).vertices, load_mesh(path).vertices)
    assert result.export(tmp_path / "chair.glb", mesh=path).stat().st_size > 1000
