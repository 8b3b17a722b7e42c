"""Files of a model's named keypoints: round trip and errors."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.files import TETRAHEDRON, replaced, write_json

from cadalign import ShapeModel
from cadalign.datasets import KeypointNet, ModelKeypoint, ModelKeypoints
from cadalign.errors import DataError

DATA: dict[str, Any] = {
    "format": "cadalign model keypoints",
    "version": 1,
    "model": "tetrahedron.obj",
    "keypoints": [
        {"name": "top", "xyz": [0, 0, 1], "semantic_id": 7},
        {"name": "floor", "xyz": [0.25, 0.5, 0]},
        {"name": "slope", "xyz": [0.2, 0.3, 0.5], "semantic_id": 2},
    ],
}


def write(path: Path, data: Any = DATA) -> Path:
    (path.parent / "tetrahedron.obj").write_text(TETRAHEDRON)
    return write_json(path, data)


def test_fields_are_read(tmp_path: Path) -> None:
    keypoints = ModelKeypoints.load(write(tmp_path / "a.keypoints.json"))
    assert keypoints.names == ("top", "floor", "slope")
    assert keypoints.ids == (7, None, 2)
    assert keypoints.model == tmp_path / "tetrahedron.obj"
    np.testing.assert_allclose(
        keypoints.xyz, [[0, 0, 1], [0.25, 0.5, 0], [0.2, 0.3, 0.5]], atol=1e-15
    )
    assert len(keypoints) == 3


def test_load_undoes_save_exactly(tmp_path: Path) -> None:
    written = ModelKeypoints.load(write(tmp_path / "a.keypoints.json"))
    written.save(tmp_path / "b.keypoints.json")
    assert ModelKeypoints.load(tmp_path / "b.keypoints.json") == written
    data = json.loads((tmp_path / "b.keypoints.json").read_text())
    assert data["model"] == "tetrahedron.obj"
    (tmp_path / "below").mkdir()
    written.save(tmp_path / "below" / "c.keypoints.json")
    assert ModelKeypoints.load(tmp_path / "below" / "c.keypoints.json").model == written.model


def test_annotated_model_is_written(sample_root: Path, tmp_path: Path) -> None:
    model = next(iter(KeypointNet(sample_root)["chair"]))
    ids = model.keypoints.ids.tolist()
    keypoints = ModelKeypoints.from_model(model)
    keypoints.save(tmp_path / "chair.keypoints.json")
    again = ModelKeypoints.load(tmp_path / "chair.keypoints.json")
    assert again == keypoints
    assert again.names == tuple(f"keypoint {number}" for number in ids)
    assert again.ids == tuple(ids)


@pytest.mark.parametrize(
    ("ids", "names", "expected"),
    [
        ((3, 5), ("heel", "toe"), [("heel", 3), ("toe", 5)]),
        ((3, 5), (), [("keypoint 3", 3), ("keypoint 5", 5)]),
        (("heel", "toe"), (), [("heel", None), ("toe", None)]),
    ],
)
def test_keypoints_of_a_learned_shape_have_its_names_and_numbers(
    ids: Any, names: Any, expected: Any
) -> None:
    mean = [[0, 0, 0], [0, 1, 2]]
    shape = ShapeModel.from_basis(mean, [mean], [0.1], ids=ids)
    keypoints = ModelKeypoints.from_shape(replace(shape, names=names))
    assert list(zip(keypoints.names, keypoints.ids, strict=True)) == expected
    np.testing.assert_allclose(keypoints.xyz, mean)


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (
            [1],
            "{path}: a list, not an object of model keypoints; "
            "give a file of model keypoints; see cadalign.datasets.ModelKeypoints",
        ),
        (
            DATA | {"format": "other"},
            "{path}: format: 'other' is not one of 'cadalign model keypoints'",
        ),
        (
            DATA | {"version": 2},
            "{path}: version: 2 is not one of 1",
        ),
        (
            DATA | {"points": 3},
            "{path}: top level: unknown field 'points', did you mean 'keypoints'?; "
            "known are format, keypoints, model, version",
        ),
        (replaced(DATA, "keypoints.1.name", ""), "{path}: keypoints[1].name: '' is not a text"),
        (
            replaced(DATA, "keypoints.1.name", "top"),
            "{path}: keypoints[1].name: 'top' occurs twice, first in keypoints[0]",
        ),
        (
            replaced(DATA, "keypoints.1.semantic_id", 7),
            "{path}: keypoints[1].semantic_id: 7 occurs twice, first in keypoints[0]",
        ),
        (
            replaced(DATA, "keypoints.0.xyz", [1, 2]),
            "{path}: keypoints[0].xyz: [1, 2] is not a list of 3",
        ),
        (
            replaced(DATA, "keypoints.0.colour", "red"),
            "{path}: keypoints[0]: unknown field 'colour'; known are name, semantic_id, xyz",
        ),
    ],
)
def test_malformed_files_are_refused_by_file_and_field(
    tmp_path: Path, data: Any, text: str
) -> None:
    path = write(tmp_path / "a.keypoints.json", data)
    with pytest.raises(DataError) as caught:
        ModelKeypoints.load(path)
    assert str(caught.value) == text.format(path=path)


def test_files_that_cannot_be_read_or_written_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"nothing\.json: no such file"):
        ModelKeypoints.load(tmp_path / "nothing.json")
    one = ModelKeypoints((ModelKeypoint("a", (0.0, 0.0, 0.0)),))
    with pytest.raises(DataError, match=r"no/such\.json: cannot be written \(No such file"):
        one.save(tmp_path / "no" / "such.json")


def test_a_mesh_is_the_model_of_keypoints_beside_it(tmp_path: Path) -> None:
    names_no_mesh = {
        "format": "cadalign model keypoints",
        "version": 1,
        "keypoints": [{"name": "tip", "xyz": [0, 0, 1]}],
    }
    (tmp_path / "chair.keypoints.json").write_text(json.dumps(names_no_mesh))
    assert ModelKeypoints.load(tmp_path / "chair.obj").model == tmp_path / "chair.obj"
    assert ModelKeypoints.load(tmp_path / "chair.keypoints.json").model is None
