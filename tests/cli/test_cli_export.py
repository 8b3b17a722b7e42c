"""`cadalign export`: fits of observation files, and errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from support.exported import CAMERA, KEYPOINTS, POSE, photo_of, turned, wedge
from support.files import write_json

from cadalign import Result, ShapeModel, View, align
from cadalign.cli import main
from cadalign.datasets import ModelKeypoints, load_mesh
from cadalign.datasets.model_keypoints import ModelKeypoint
from cadalign.errors import InputError
from cadalign.export import ExportView
from cadalign.geometry.mesh import Mesh
from cadalign.io.evidence import ImageEvidence, ObservedImage
from cadalign.io.images import write_image
from cadalign.io.meshes.files import write_mesh
from cadalign.io.observation import Observation
from cadalign.shapes.examples import Example

MORE = np.vstack([KEYPOINTS, wedge().vertices[2:5], [[0.1, 0.2, 0.3]]])


@pytest.fixture
def observed(tmp_path: Path) -> Path:
    """An observation with photo and model, in ``photo.json``."""
    write_image(tmp_path / "000007.png", photo_of(CAMERA))
    path = tmp_path / "wedge.obj"
    write_mesh(path, wedge(), kind="obj")
    pixels = CAMERA.project(POSE.apply(MORE))
    image = tmp_path / "000007.png"
    Observation(MORE, pixels, CAMERA, image=image, model=path).save(tmp_path / "photo.json")
    return tmp_path / "photo.json"


def refusal(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    capsys.readouterr()
    assert main(["export", *map(str, arguments)]) == 1
    return capsys.readouterr().err


@pytest.mark.long
def test_a_fit_is_exported_with_photo_and_model(
    tmp_path: Path, observed: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["fit", str(observed)]) == 0
    result = tmp_path / "photo_fit" / "fit.json"
    assert main(["export", str(result), "--to", str(tmp_path / "out" / "wedge.glb")]) == 0
    scene = trimesh.load(tmp_path / "out" / "wedge.glb")
    assert set(scene.geometry) == {"wedge_0", "photo_0"}
    assert main(["export", str(result), "--to", str(tmp_path / "wedge.ply")]) == 0
    mesh = load_mesh(tmp_path / "wedge.ply")
    np.testing.assert_allclose(mesh.vertices, POSE.apply(wedge().vertices), atol=1e-4)
    assert "the mesh, with vertex colours" in capsys.readouterr().err


@pytest.mark.slow
def test_the_command_says_what_is_missing(
    tmp_path: Path, observed: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["fit", str(observed), "--no-picture"]) == 0
    result, to = tmp_path / "photo_fit" / "fit.json", ("--to", tmp_path / "a.glb")
    said = refusal(capsys, result, "--to", tmp_path / "a.json")
    assert "the ending '.json' is not an export format; the formats are .glb, .obj, .ply" in said
    Result.load(result).save(result)  # which writes no observation
    assert "the file holds no fit with its observation" in refusal(capsys, result, *to)
    result.write_text(result.read_text()[:200])
    assert f"{result}, line" in refusal(capsys, result, *to)
    assert "no such file" in refusal(capsys, tmp_path / "gone.json", *to)


def test_inputs_are_not_overwritten(
    tmp_path: Path, observed: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "wedge.mtl").write_text("newmtl cloth\n")
    assert main(["fit", str(observed), "--no-picture"]) == 0
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.*") if path.is_file()}
    fit = tmp_path / "photo_fit" / "fit.json"
    said = refusal(capsys, fit, "--to", tmp_path / "wedge.obj")
    assert "this file is an input and would be overwritten; give another name" in said
    assert before == {path: path.read_bytes() for path in before}


@pytest.mark.long
def test_views_and_warped_mesh_of_a_joint_fit(tmp_path: Path, observed: Path) -> None:
    first = Observation.load(observed)
    view, motion = turned(ExportView(CAMERA, POSE), 0.4)
    rng = np.random.default_rng(0)
    object_points = MORE + rng.normal(0, 0.03, MORE.shape)
    images = [
        ObservedImage(
            MORE,
            CAMERA.project(pose.apply(object_points)),
            CAMERA,
            image=first.image,
            evidence=ImageEvidence(cam_from_rig=matrix),
        )
        for pose, matrix in ((POSE, np.eye(4)), (view.cam_from_model, motion))
    ]
    path = tmp_path / "two.json"
    Observation(**vars(images[0]), model=first.model, others=(images[1],)).save(path)
    assert main(["fit", str(path), "--shape-sigma", "0.05"]) == 0
    result = tmp_path / "two_fit" / "fit.json"
    target = tmp_path / "first.ply"
    assert main(["export", str(result), "--to", str(target)]) == 0
    mesh = load_mesh(target)
    # Keypoints 0 and 1 are vertices of the wedge: the warp moves both to the object's keypoints.
    placed = POSE.apply(object_points)
    assert np.linalg.norm(mesh.vertices[[0, 1]] - placed[[0, 1]], axis=1).max() < 0.02
    assert (
        np.linalg.norm(POSE.apply(wedge().vertices)[[0, 1]] - placed[[0, 1]], axis=1).max() > 0.02
    )


def test_results_of_learned_shapes_export_the_nearest_training_mesh(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write_mesh(tmp_path / "wedge.obj", wedge(), kind="obj")
    rng, ids = np.random.default_rng(0), list(range(len(MORE)))
    paths = [tmp_path / "wedge.obj"] * 8
    examples = [
        Example(f"{row}", ids, MORE * rng.uniform(0.9, 1.1, 3), wedge().bounds, path)
        for row, path in enumerate(paths)
    ]
    shape = ShapeModel.learn(examples)
    found = align(shape, View(CAMERA, CAMERA.project(POSE.apply(MORE)), ids=ids))
    mesh = load_mesh(found.export(tmp_path / "near.obj"))
    np.testing.assert_allclose(
        mesh.vertices, found.alignment.apply(found.mesh().vertices), atol=1e-5
    )
    paths[0].unlink()
    with pytest.raises(InputError, match="there is no mesh of the model to write"):
        found.export(tmp_path / "gone.obj")
    assert "the nearest training model is not drawn" in caplog.text


def test_a_shape_without_meshes_is_exported_as_its_box(tmp_path: Path) -> None:
    shape = ShapeModel.pretrained("chair")
    pixels = CAMERA.project(POSE.apply(shape.mean[:-2]))
    found = align(shape, View(CAMERA, pixels, ids=shape.names))
    mesh = load_mesh(found.export(tmp_path / "box.obj"))
    assert len(mesh.faces) == 12
    ends = np.sort(mesh.vertices, axis=0)[[0, -1]]
    np.testing.assert_allclose(ends, np.sort(found.box.corners, axis=0)[[0, -1]], atol=1e-5)


@pytest.mark.parametrize("ending", ["obj", "glb"])
def test_a_shape_of_keypoints_in_a_plane_is_exported_as_its_flat_box(
    tmp_path: Path, ending: str
) -> None:
    flat = MORE * [1, 1, 0]
    shape = ShapeModel.from_basis(flat, [flat * [0, 1, 0]], [0.1])
    found = align(shape, View(CAMERA, CAMERA.project(POSE.apply(flat))))
    mesh = load_mesh(found.export(tmp_path / f"flat.{ending}"))
    assert len(mesh.faces) == 12
    assert np.linalg.svd(mesh.vertices - mesh.vertices.mean(axis=0))[1][2] < 1e-5


def test_the_best_match_of_an_own_library_is_exported_in_the_estimated_shape(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The library has names and ids of its own, and the photo's keypoints have the library's."""
    shape, rng = ShapeModel.pretrained("laptop"), np.random.default_rng(0)
    points, folder = shape.mean[:-2], tmp_path / "laptop"
    folder.mkdir()
    for number in range(4):
        own = points * rng.uniform(0.8, 1.2, 3)
        mesh = Mesh(own, [[0, 1, 2], [0, 2, 3], [2, 3, 4], [3, 4, 5]])
        write_mesh(folder / f"{number}.obj", mesh, kind="obj")
        named = zip("fedcba", own.tolist(), strict=False)
        keypoints = ModelKeypoints(tuple(ModelKeypoint(name, tuple(xyz)) for name, xyz in named))
        keypoints.save(folder / f"{number}.keypoints.json")
    library, found = tmp_path / "own.cadalign", tmp_path / "found"
    assert main(["library", "build", str(tmp_path), "--out", str(library)]) == 0
    table = write_json(tmp_path / "table.json", dict(zip("fedcba", shape.names, strict=False)))
    pixels = CAMERA.project(POSE.apply(points))
    query = Observation(points, pixels, CAMERA, names=tuple("fedcba"))
    query.save(tmp_path / "photo.json")
    options = ["--library", str(library), "--shape", "laptop", "--keypoint-names", str(table)]
    assert main(["retrieve", str(tmp_path / "photo.json"), *options, "--out", str(found)]) == 0
    assert main(["fit", str(found / "match_01.json"), "--shape", "laptop", "--no-picture"]) == 0
    target = tmp_path / "laptop.ply"
    assert main(["export", str(found / "match_01_fit"), "--to", str(target)]) == 0
    placed = CAMERA.project(load_mesh(target).vertices)
    gaps = np.linalg.norm(placed[:, None] - pixels, axis=2).min(axis=0)
    assert gaps.max() < 1.0
