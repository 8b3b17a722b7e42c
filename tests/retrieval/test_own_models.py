"""Libraries of a user's own models, and detectors' files with the library's keypoint names."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from support.files import write_json
from support.refusals import refusal_line, refusal_text

from cadalign import Alignment, Camera, Library
from cadalign.arrays import FloatArray
from cadalign.cli import main
from cadalign.datasets import ModelKeypoints
from cadalign.datasets.model_keypoints import ModelKeypoint
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.io.meshes.files import write_mesh

NAMES = ("front left", "front right", "back right", "back left", "top right", "top left", "rest")
CHAIR = np.array(
    [
        *([-0.2, 0, 0.2], [0.2, 0, 0.2], [0.2, 0.1, -0.2], [-0.2, 0.1, -0.2]),
        *([0.18, 0.5, -0.25], [-0.18, 0.55, -0.25], [0, 0.3, 0.1]),
    ]
)
CAMERA = Camera(640, 480, 935.0, 935.0, 319.5, 239.5)
SHOWN = (3, 5, 1)


def points_of(number: int) -> FloatArray:
    rng = np.random.default_rng(number)
    return CHAIR * rng.uniform(0.7, 1.4, 3) + rng.normal(0, 0.05, CHAIR.shape)


@dataclass(frozen=True)
class Case:
    """Eight chairs, one without a mesh, and keypoints of three chairs in photos."""

    folder: Path
    seen: list[FloatArray]

    @property
    def models(self) -> Path:
        return self.folder / "chair"

    @property
    def library(self) -> list[str]:
        return ["--library", str(self.folder / "chairs.cadalign")]


def write_keypoints(path: Path, points: FloatArray, ids: dict[str, int] | None = None) -> None:
    pairs = zip(NAMES, points.tolist(), strict=True)
    named = (ModelKeypoint(name, tuple(xyz), (ids or {}).get(name)) for name, xyz in pairs)
    ModelKeypoints(tuple(named)).save(path)


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Case:
    folder = tmp_path_factory.mktemp("own")
    (folder / "chair").mkdir()
    for number in range(8):
        points = points_of(number)
        write_keypoints(folder / "chair" / f"c{number}.keypoints.json", points)
        if number < 7:
            faces = np.array([[0, 1, 2], [0, 2, 3], [3, 2, 4], [3, 4, 5]])
            write_mesh(folder / "chair" / f"c{number}.obj", Mesh(points[:6], faces), kind="obj")
    assert main(["library", "build", str(folder), "--out", str(folder / "chairs.cadalign")]) == 0
    rng, seen = np.random.default_rng(0), []
    for turn, number in enumerate(SHOWN):
        rotation = rotation_from_vector(np.array([0.9 * np.pi, 0.3 + 0.2 * turn, 0.1]))
        pose = Alignment(rotation, np.array([0.05, 0.1, 2.5]), np.array([1, 1.15, 0.9]))
        seen.append(CAMERA.project(pose.apply(points_of(number))) + rng.normal(0, 1, (7, 2)))
    (folder / "K.txt").write_text("935 0 319.5\n0 935 239.5\n0 0 1\n")
    return Case(folder, seen)


def test_a_folder_becomes_a_library(case: Case, capsys: pytest.CaptureFixture[str]) -> None:
    library = Library.open(case.folder / "chairs.cadalign")
    assert library.keys == tuple(("chair", f"c{number}") for number in range(8))
    assert library.mesh_count == 7
    assert library["chair", "c2"].mesh_path == case.models / "c2.obj"
    np.testing.assert_allclose(library["chair", "c2"].bounds[1], points_of(2)[:6].max(axis=0))
    np.testing.assert_allclose(library["chair", "c7"].bounds[1], points_of(7).max(axis=0))
    assert set(library.keypoints.names) == set(NAMES)
    assert main(["library", "show", *case.library[1:]]) == 0
    shown = capsys.readouterr().out
    assert shown.splitlines()[1] == f"Keypoints: {', '.join(sorted(NAMES))}"


def test_keypoints_are_named_in_python(case: Case) -> None:
    library = Library.from_folder(case.folder)
    matches = library.retrieve(case.seen[0], [n.upper().replace(" ", "_") for n in NAMES], CAMERA)
    assert matches[0].model_id == "c3"
    text = refusal_text(lambda: library.retrieve(case.seen[0], ["seat"] * 7, CAMERA))
    assert "no model of the library has a keypoint 'seat'; it has back left, " in text


def coco(case: Case) -> str:
    images = [{"id": k, "file_name": f"{k}.jpg", "width": 640, "height": 480} for k in range(3)]
    annotations = [
        {"id": k, "image_id": k, "category_id": 1, "keypoints": np.insert(uv, 2, 2, 1).ravel()}
        for k, uv in enumerate(case.seen)
    ]
    for each in annotations:
        each["keypoints"] = np.asarray(each["keypoints"]).tolist()
    categories = [{"id": 1, "name": "chair", "keypoints": list(NAMES)}]
    return json.dumps({"images": images, "annotations": annotations, "categories": categories})


def csv(case: Case) -> str:
    rows = ["image,name,u,v,score"]
    for k, uv in enumerate(case.seen):
        rows += [f"{k}.jpg,{n},{u},{v},.9" for n, (u, v) in zip(NAMES, uv, strict=True)]
    return "\n".join(rows)


@pytest.mark.parametrize(("ending", "written"), [("json", coco), ("csv", csv)])
def test_a_detectors_file_needs_no_model(
    case: Case, tmp_path: Path, ending: str, written, capsys: pytest.CaptureFixture[str]
) -> None:
    source, run = tmp_path / f"found.{ending}", tmp_path / "run"
    source.write_text(written(case))
    camera = case.folder / "K.txt"
    if ending == "csv":  # CSV has no photo sizes
        camera = tmp_path / "camera.json"
        write_json(camera, CAMERA.to_dict())
    options = [*case.library, "--camera", str(camera), "--no-picture", "--out", str(run)]
    assert main(["retrieve", str(source), *options]) == 0
    assert "3 of 3 retrieved, 0 failed: " in capsys.readouterr().err
    rows = pq.read_table(run / "results.parquet").to_pylist()
    assert [row["match_id"] for row in rows] == [f"c{number}" for number in SHOWN]
    assert all(0 < row["scale_z_std"] < 0.2 for row in rows)


def test_semantic_ids_of_files_are_kept_if_all_keypoints_have_one(tmp_path: Path) -> None:
    ids = {name: 3 * k for k, name in enumerate(NAMES)}
    for number in range(2):
        write_keypoints(tmp_path / f"{number}.keypoints.json", points_of(number), ids)
    assert Library.from_folder(tmp_path).keypoints.ids == tuple(range(0, 21, 3))
    write_keypoints(tmp_path / "2.keypoints.json", points_of(2), ids | {"rest": 5})
    text = refusal_text(lambda: Library.from_folder(tmp_path))
    assert "2.keypoints.json: 'rest' has semantic_id 5, and 18 in " in text
    write_keypoints(tmp_path / "2.keypoints.json", points_of(2))
    assert Library.from_folder(tmp_path).keypoints.ids == tuple(range(7))


def test_invalid_folders_are_refused(
    case: Case,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    text = refusal_text(lambda: Library.from_folder(tmp_path))
    assert "no model with keypoints; `cadalign annotate PHOTO MODEL` marks keypoints" in text
    (tmp_path / "chair.stl").touch()
    line = refusal_line(capsys, "library", "build", tmp_path)
    assert f"{tmp_path}: no model with keypoints; `cadalign annotate PHOTO MODEL` marks" in line
    (tmp_path / "chair.stl").unlink()
    line = refusal_line(capsys, "library", "build", case.folder, "--split", "train")
    assert line.startswith("--split: has no effect on a folder of own models")
    (tmp_path / "c1.obj").write_text((case.models / "c1.obj").read_text())
    (tmp_path / "c2.obj").write_text((case.models / "c2.obj").read_text())
    write_keypoints(tmp_path / "c1.keypoints.json", points_of(1))
    Library.from_folder(tmp_path)
    assert f"1 meshes have no keypoints and are left out, the first is {tmp_path / 'c2.obj'}" in (
        caplog.text
    )
