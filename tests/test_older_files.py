"""Files that earlier versions wrote open in this one, and say what they said.

`tests/fixtures/make_version_0_1_0.py` wrote them. What a file says is read from it as plain JSON;
of binary files the script tells what they hold.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cadalign
from cadalign import (
    Alignment,
    AlignResult,
    Camera,
    FitResult,
    Library,
    Observation,
    ShapeModel,
    Symmetry,
    View,
)
from cadalign.annotate.document import history_path
from cadalign.annotate.opening import open_session
from cadalign.annotate.options import SessionOptions
from cadalign.annotate.page_state import worklist_state
from cadalign.cli import main
from cadalign.datasets import ModelKeypoints

FOLDER = Path(__file__).parent / "fixtures" / "version_0_1_0"
FITS = sorted((FOLDER / "fit").glob("*.json"))
ALIGNMENTS = sorted((FOLDER / "align").glob("*.json"))
# Of deviations that are derived from what a file holds, which a later version may do otherwise.
SAME_STD = 1e-3

POINTS = np.array(
    [[x, y, z] for x in (-0.5, 0.5) for y in (-0.4, 0.4) for z in (-0.3, 0.3)]
    + [[0, 0.4, 0], [0.1, 0.0, 0.3], [-0.5, 0.1, -0.1], [0.2, 0.4, 0]]
)
CAMERA = Camera(320, 240, 450, 450, 159.5, 119.5)
LOOK = np.array([[0.8, 0.0, 0.6], [-0.36, -0.8, 0.48], [0.48, -0.6, -0.64]])
TRUTH = Alignment(LOOK, np.array([0.1, -0.05, 4.0]), np.array([1.0, 1.2, 0.85]))


def read(path: Path) -> dict[str, Any]:
    return dict(json.loads(path.read_text()))


def assert_alignment(found: Alignment, said: dict[str, Any]) -> None:
    for name in ("rotation", "translation", "scale"):
        np.testing.assert_allclose(getattr(found, name), said[name], rtol=1e-12, atol=1e-15)


def assert_camera(found: Camera, said: dict[str, Any]) -> None:
    written = found.to_dict(pixel_origin=said.get("pixel_origin"))
    for name in ("width", "height", "params"):
        assert written[name] == pytest.approx(said[name], rel=1e-12)


def assert_std(found: Any, said: dict[str, Any], rtol: float = SAME_STD) -> None:
    for name, value in said.items():
        np.testing.assert_allclose(getattr(found, name), value, rtol=rtol, atol=1e-12)


def assert_residuals(found: np.ndarray, said: list[list[float] | None]) -> None:
    """Those of a keypoint behind the camera are infinite, and null in the file."""
    rows = np.array([[np.inf, np.inf] if row is None else row for row in said]).reshape(-1, 2)
    np.testing.assert_allclose(found, rows, rtol=1e-12)


@pytest.mark.parametrize("path", FITS, ids=lambda path: path.stem)
def test_fit_results(path: Path) -> None:
    said, result = read(path), FitResult.load(path)
    assert_alignment(result.alignment, said["alignment"])
    assert_camera(result.camera, said["camera"])
    np.testing.assert_array_equal(result.points_3d, said["points_3d"])
    assert_residuals(result.residuals, said["residuals"])
    np.testing.assert_array_equal(result.inliers, said["inliers"])
    assert result.rms == pytest.approx(said["rms"], rel=1e-12)
    assert result.sigma == said["sigma"]
    # What is merely uncertain was warned of in those days.
    assert set(result.warnings) <= set(said["warnings"])
    assert all(text in result.warnings or "known only" in text for text in said["warnings"])
    assert (result.covariance is None) == (said["covariance"] is None)
    if result.covariance is not None:
        known = 6 + "xyz".index(said["known_axis"])
        stated = np.delete(np.delete(result.fisher_covariance, known, 0), known, 1)
        np.testing.assert_array_equal(stated, said["covariance"])
        # The posterior of five keypoints reaches stretches that had no prior in those days.
        assert_std(result.std, said["std"], 0.07 if path.stem == "five_points" else SAME_STD)
    assert len(result.alternatives) == len(said["alternatives"])
    for other, its in zip(result.alternatives, said["alternatives"], strict=True):
        assert_alignment(other.alignment, its["alignment"])
        assert_camera(other.camera, its["camera"])
        assert other.relative_likelihood == pytest.approx(its["relative_likelihood"], rel=1e-12)
    assert str(result)


def test_fit_results_are_of_all_kinds() -> None:
    """What the files are for: each has what the others lack."""
    said = {path.stem: FitResult.load(path) for path in FITS}
    assert said["aepnp"].covariance is None
    assert said["aepnp"].std is None
    assert said["distorted"].camera.distortion == (-0.2, 0.05, 0.001, -0.002)
    assert said["focal"].camera.fx == pytest.approx(450, rel=0.05)
    assert said["focal"].std is not None
    assert said["focal"].std.focal > 0
    assert said["known_axis_y"].alignment.scale[1] == 1
    assert said["one_stretch"].alignment.scale[1] == 1
    assert said["sigma_estimated"].sigma == pytest.approx(0.27, abs=0.01)
    assert said["symmetry"].symmetry is not None
    assert len(said["symmetry"].symmetry.motions) == 1
    assert said["symmetry_continuous"].symmetry is not None
    assert len(said["symmetry_continuous"].symmetry.axes) == 1
    assert (~said["ransac"].inliers).nonzero()[0].tolist() == [1, 6, 9]
    assert (~said["behind"].inliers).nonzero()[0].tolist() == [12]
    assert np.isinf(said["behind"].residuals[12]).all()
    assert len(said["four_points"].alternatives) == 1
    assert len(said["five_points"].alternatives) == 2
    assert said["misfit"].misfit is not None


@pytest.mark.parametrize("path", ALIGNMENTS, ids=lambda path: path.stem)
def test_align_results(path: Path) -> None:
    assert_align_result(AlignResult.load(path), read(path))


def assert_align_result(result: AlignResult, said: dict[str, Any]) -> None:
    assert_alignment(result.alignment, said["alignment"])
    assert list(result.ids) == said["ids"]
    np.testing.assert_array_equal(result.points_3d, said["points_3d"])
    np.testing.assert_array_equal(result.bounds, said["bounds"])
    np.testing.assert_array_equal(result.stretch, said["stretch"])
    assert result.rms == pytest.approx(said["rms"], rel=1e-12)
    for its, view in zip(said["views"], result.views, strict=True):
        assert_alignment(view.alignment, its["alignment"])
        assert_camera(view.camera, its["camera"])
        assert_residuals(view.residuals, its["residuals"])
        np.testing.assert_array_equal(view.inliers, np.array(its["inliers"], dtype=bool))
        np.testing.assert_array_equal(view.points_2d, np.array(its["observed"]).reshape(-1, 2))
    for name in ("covariance", "points_covariance", "points_cam_covariance"):
        np.testing.assert_array_equal(getattr(result, name), said[name])
    assert_std(result.std, said["std"])
    assert result.warnings == tuple(said["warnings"])
    assert result.component == said["component"]
    assert result.degrees_of_freedom == said["degrees_of_freedom"]
    assert result.equal_under_symmetry == said["equal_under_symmetry"]
    evidence = [{"share": None} | each for each in said["evidence"]]
    assert [asdict(each) for each in result.evidence] == evidence
    if said["rig_from_model"] is None:
        assert result.rig_from_model is None
    else:
        assert result.rig_from_model is not None
        assert_alignment(result.rig_from_model, said["rig_from_model"])
    assert len(result.alternatives) == len(said["alternatives"])
    for other, its in zip(result.alternatives, said["alternatives"], strict=True):
        assert_alignment(other.alignment, its["alignment"])
        assert other.relative_likelihood == pytest.approx(its["relative_likelihood"], rel=1e-12)
        np.testing.assert_array_equal(other.points_3d, its["points_3d"])
    assert str(result)


@pytest.mark.parametrize("name", ["fit/behind", "align/rig_with_size"])
def test_results_are_exported_and_written_anew(name: str, tmp_path: Path) -> None:
    result = FitResult.load(FOLDER / f"{name}.json")
    assert result.export(tmp_path / "lines.lines.ply").is_file()
    again = FitResult.from_json(result.to_json())
    assert str(again) == str(result)
    assert again.to_json() == result.to_json()


def test_align_results_are_of_all_kinds() -> None:
    said = {path.stem: AlignResult.load(path) for path in ALIGNMENTS}
    assert len(said["two_views_unknown_motion"].poses) == 2
    assert len(said["rig_with_size"].poses) == 3
    assert said["rig_with_size"].rig_from_model is not None
    assert any(each.kind == "size" for each in said["rig_with_size"].evidence)
    assert any("mask" in each.kind for each in said["mask"].evidence)
    assert said["mask_without_keypoints"].residuals.shape == (0, 2)
    assert said["learned_one_view"].degrees_of_freedom == 10
    assert len(said["alternatives"].alternatives) == 1
    assert said["symmetry"].equal_under_symmetry
    assert (~said["similar_outliers"].inliers).nonzero()[0].tolist() == [1, 6]
    assert "contradicts" in said["depth_and_up"].warnings[0]


def observed(name: str) -> Observation:
    return Observation.load(FOLDER / "observations" / name)


def test_plain_observation() -> None:
    said = read(FOLDER / "observations" / "plain.json")
    observation = observed("plain.json")
    np.testing.assert_array_equal(
        observation.points_3d, [each["xyz"] for each in said["keypoints"]]
    )
    np.testing.assert_array_equal(observation.points_2d, [each["uv"] for each in said["keypoints"]])
    assert observation.camera == CAMERA
    assert observation.is_plain
    assert observation.fit_options == {}
    assert not observed("without_focal.json").camera.focal_known


def test_observation_of_a_detector() -> None:
    folder, observation = FOLDER / "observations", observed("detected.json")
    assert observation.camera.distortion == (-0.2, 0.05, 0.001, -0.002)
    np.testing.assert_allclose(observation.sigma, np.linspace(0.3, 1.0, 12))
    np.testing.assert_allclose(observation.scores, np.linspace(0.2, 0.97, 12))
    assert observation.ids is not None
    assert observation.ids.tolist() == list(range(3, 15))
    assert observation.names == tuple(f"point {row}" for row in range(12))
    assert (observation.image, observation.model) == (folder / "photo.png", folder / "box.obj")
    assert observation.object_name == "crate"
    assert observation.fit_options == {
        "sigma": None,
        "loss": "huber",
        "loss_scale": 3.0,
        "stretch": "z",
        "stretch_sigma": 0.3,
        "known_axis": "y",
        "focal": "estimate",
        "focal_prior": {"focal": 480.0, "relative_sigma": 0.2},
    }


def test_observation_with_all_evidence() -> None:
    folder, observation = FOLDER / "observations", observed("all_evidence.json")
    given = observation.evidence.given
    np.testing.assert_allclose(given.pop("up"), LOOK[:, 1])
    assert given == {
        "mask": folder / "photo.mask.png",
        "mask_sigma": 1.5,
        "depth": folder / "photo.depth.png",
        "depth_scale": 0.001,
        "depth_sigma": 0.02,
        "up_sigma_deg": 2.0,
        "camera_height": 1.2,
        "camera_height_sigma": 0.03,
    }
    assert observation.size is not None
    assert observation.size.given == {"width": 1.0, "height": 0.96, "sigma": 0.02}
    assert observation.symmetry is not None
    expected = Symmetry.around((0, 1, 0), fold=2)
    np.testing.assert_allclose(observation.symmetry.motions, expected.motions, atol=1e-12)
    assert observation.init is not None
    np.testing.assert_array_equal(observation.init.rotation, LOOK)
    np.testing.assert_array_equal(observation.init.scale, TRUTH.scale)
    assert observation.fit_options == {"shape_sigma": 0.02}


def test_observation_of_two_views() -> None:
    observation = observed("two_views.json")
    first, second = observation.views
    depths = TRUTH.apply(POINTS)[:, 2]
    depths[3] = np.nan
    np.testing.assert_allclose(first.depths, depths)
    assert second.depths is None
    np.testing.assert_array_equal(first.evidence.cam_from_rig, np.eye(4))
    assert second.evidence.cam_from_rig is not None
    assert second.evidence.cam_from_rig[0, 0] == pytest.approx(np.cos(np.radians(30)))
    assert observation.shape is not None
    assert observation.shape.resolve() == FOLDER / "shapes" / "single.shape"
    assert observation.size is not None
    assert observation.size.given == {"length": 0.51, "sigma": [0.01, 0.02, 0.03]}


@pytest.mark.parametrize("name", ["plain", "detected", "two_views"])
def test_observations_are_fitted(name: str, tmp_path: Path) -> None:
    """The command accepts them as they are, with their shape file and options."""
    command = ["fit", str(FOLDER / "observations" / f"{name}.json"), "--out", str(tmp_path)]
    assert main(command) == 0
    assert (tmp_path / "fit.json").is_file()


def test_shape_of_one_component() -> None:
    shape = ShapeModel.open(FOLDER / "shapes" / "single.shape")
    assert (shape.category, shape.up_axis, shape.unit) == ("box", "y", "metres")
    assert shape.ids == tuple(sorted(f"point {row}" for row in range(12)))
    (component,) = shape.components
    assert component.modes.shape == (4, 14, 3)
    assert component.weight == 1
    assert component.residual_sigma == pytest.approx(0.0041725, rel=1e-3)
    rows = [shape.ids.index(f"point {row}") for row in range(12)]
    np.testing.assert_allclose(component.mean[rows], POINTS, atol=0.06)
    assert shape.inflation == pytest.approx(2.2232959463757567)
    assert shape.degrees_of_freedom == 10
    assert shape.box_margins is not None
    assert shape.few_keypoints is not None
    assert shape.training is not None
    assert shape.training.model_ids == tuple(f"box_{number:02}" for number in range(16))
    assert shape.training.mesh_paths[:2] == (None, Path("box_01.obj"))
    assert shape.training.points_3d.shape == (16, 12, 3)


def test_shape_of_a_mixture() -> None:
    shape = ShapeModel.open(FOLDER / "shapes" / "mixture.shape")
    heights = [component.mean[-1, 1] - component.mean[-2, 1] for component in shape.components]
    assert sorted(heights) == pytest.approx([0.8, 1.44], rel=0.1)
    assert [len(component.modes) for component in shape.components] == [3, 3]
    assert sum(component.weight for component in shape.components) == pytest.approx(1)
    assert shape.degrees_of_freedom == 3


def test_shape_that_is_not_calibrated() -> None:
    shape = ShapeModel.open(FOLDER / "shapes" / "uncalibrated.shape")
    assert (shape.inflation, shape.degrees_of_freedom) == (1, None)
    assert shape.box_margins is None
    assert shape.few_keypoints is None


@pytest.mark.parametrize(("name", "file"), [("single", "learned"), ("mixture", "mixture")])
def test_shapes_give_the_same_alignment(name: str, file: str) -> None:
    """A shape file means the same as when the result beside it was written.

    Up to the size, which keypoints leave open and 0.1.0 estimated too small, by a few percent.
    """
    shape = ShapeModel.open(FOLDER / "shapes" / f"{name}.shape")
    before = AlignResult.load(FOLDER / "align" / f"{file}_one_view.json")
    ids = [f"point {row}" for row in range(12)]
    result = cadalign.align(shape, View(CAMERA, before.observed[0], ids=ids, sigma=0.5))
    sizes, unit_shapes = [], []
    for each in (result, before):
        centred = each.points_3d - each.points_3d.mean(axis=0)
        sizes.append(np.linalg.norm(centred))
        unit_shapes.append(centred / sizes[-1])
    np.testing.assert_allclose(*unit_shapes, atol=2e-3)
    assert abs(np.log(sizes[0] / sizes[1])) < 0.5 * min(before.std.scale)
    np.testing.assert_allclose(result.alignment.rotation, before.alignment.rotation, atol=2e-3)
    np.testing.assert_allclose(result.std.scale, before.std.scale, rtol=0.08)


@pytest.mark.slow
def test_library() -> None:
    library = Library.open(FOLDER / "library" / "boxes.library")
    rng = np.random.default_rng(8)
    assert library.categories == ("box", "crate")
    for category in library.categories:
        for number in range(6):
            model = library[category, f"{category}_{number}"]
            xyz = POINTS + rng.normal(0, 0.05, POINTS.shape)
            np.testing.assert_allclose(model.xyz, xyz, atol=1e-6)
            assert model.ids.tolist() == list(range(12))
            np.testing.assert_allclose(model.bounds, [[-0.5, -0.4, -0.3], [0.5, 0.4, 0.3]])
            mesh = Path("/models/box.obj") if number == 0 else None
            assert model.mesh_path == mesh
    wanted = library["crate", "crate_4"].xyz
    best = library.retrieve(CAMERA.project(TRUTH.apply(wanted)), np.arange(12), CAMERA)[0]
    assert (best.category, best.model_id) == ("crate", "crate_4")


def test_annotation_is_continued(tmp_path: Path) -> None:
    """An annotator's photos with two objects, of which one is seen in both, and the history."""
    folder = tmp_path / "annotated"
    shutil.copytree(FOLDER / "annotated", folder)
    photos = folder / "photos"
    history = history_path(photos / "first.json")
    history.parent.mkdir(parents=True, exist_ok=True)
    text = (folder / "first.history.json").read_text()
    history.write_text(text.replace("/annotated/", f"{folder}/"))
    session = open_session(
        SessionOptions(image=photos, model=folder / "box.obj", camera=folder / "camera.json")
    )
    crate = session.objects[0][0].document
    assert crate.name == "crate"
    assert keypoints_of(crate.pairs) == [0, 2, 3, 4, 5, 6, 7]
    assert [pair.uv for pair in crate.pairs if not pair.complete] == [(30.0, 40.0)]
    assert crate.priors.stretch == pytest.approx(0.4)
    assert crate.evidence.lengths is not None
    assert crate.evidence.lengths.width == 1.0
    assert len(crate.evidence.verticals) == 2
    assert crate.evidence.mask is not None
    assert len(crate.evidence.mask.strokes) == 3
    (view,) = crate.further_views
    assert Path(view.photo) == photos / "second.png"
    assert keypoints_of(view.document.pairs) == [0, 1, 2, 3, 6]
    second = session.objects[0][1].document
    assert second.name == "second crate"
    assert keypoints_of(second.pairs) == [1, 2, 3, 5]
    assert session.objects[0][0].owner.history.before
    assert [each["state"] for each in worklist_state(session)] == ["done", "begun"]


def keypoints_of(pairs: Sequence[Any]) -> list[int]:
    return [pair.keypoint for pair in pairs if pair.complete]


def test_annotated_files_open_by_themselves() -> None:
    photos = FOLDER / "annotated" / "photos"
    assert len(Observation.load(photos / "first.json").views) == 2
    assert len(Observation.load(photos / "first.object-2.json").points_2d) == 4
    result = AlignResult.load(photos / "first_fit" / "fit.json")
    assert_align_result(result, read(photos / "first_fit" / "fit.json"))
    assert FitResult.load(photos / "first.object-2_fit" / "fit.json").alignment is not None
    keypoints = ModelKeypoints.load(photos / "box.keypoints.json")
    np.testing.assert_array_equal(keypoints.xyz, POINTS[:8])


@pytest.fixture
def copied_run(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    return Path(shutil.copytree(FOLDER / "runs" / request.param, tmp_path / request.param))


@pytest.mark.slow
@pytest.mark.parametrize("copied_run", ["keypointnet"], indirect=True)
def test_run_is_shown(copied_run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "show", str(copied_run), "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert (shown["rows"], shown["failed"]) == (6, 0)
    errors = {
        line["method"]: line["rotation_error_deg"]
        for line in shown["summary"]
        if line["category"] == "bottle"
    }
    expected = {"optimal": 1.006089, "aepnp": 1.523955, "limit": 1.023976}
    assert errors == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("copied_run", ["keypointnet", "simulate_points"], indirect=True)
def test_run_is_reported(copied_run: Path) -> None:
    assert main(["report", str(copied_run)]) == 0
    assert "optimal" in (copied_run / "report.html").read_text()
