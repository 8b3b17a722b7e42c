"""The KeypointNet experiment with learned shapes: one more method, where a shape is known."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support.pages import embedded_payload
from support.refusals import refusal_line, refusal_text

from cadalign import Alignment, Box, ShapeModel, evaluate
from cadalign.cli import main
from cadalign.datasets import KeypointNet, write_sample_dataset
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA
from cadalign.evaluation.instances.record import box_alignment
from cadalign.evaluation.runs.tables import read_table
from cadalign.shapes.examples import Example

METHODS = ["optimal", "limit"]


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sample data set with eight models of every category; to be read, not changed."""
    return write_sample_dataset(tmp_path_factory.mktemp("data") / "sample", per_category=8)


@pytest.fixture(scope="module")
def shapes(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the shapes of chairs and cars."""
    folder = tmp_path_factory.mktemp("shapes")
    for category in ("chair", "car"):
        ShapeModel.from_dataset(KeypointNet(root), category).save(folder / f"{category}.shape")
    return folder


def run(root: Path, out: Path, shape: Path, **options: Any) -> pd.DataFrame:
    options = {"methods": METHODS, "categories": ["chair", "bottle"], "workers": 0, **options}
    return evaluate(root, out=out, shape=shape, **options)


@pytest.fixture(scope="module")
def table(root: Path, shapes: Path, tmp_path_factory: pytest.TempPathFactory) -> pd.DataFrame:
    return run(root, tmp_path_factory.mktemp("run") / "run", shapes)


@pytest.mark.long
def test_categories_with_a_shape_have_its_method(table: pd.DataFrame) -> None:
    by_category = table.groupby("category").method.agg(set)
    assert by_category["chair"] == {*METHODS, "shape"}
    assert by_category["bottle"] == set(METHODS)
    assert (table.status == "ok").all()


@pytest.mark.slow
def test_a_learned_shape_finds_pose_and_box(table: pd.DataFrame) -> None:
    found = table[table.method == "shape"]
    assert (found.rotation_error_deg < 10).all()
    assert found.rotation_error_deg.median() < 3
    assert found.box_iou_up_to_scale.median() > 0.8
    assert (found.box_iou_up_to_scale >= found.box_iou - 1e-6).all()
    assert (found.translation_error_up_to_scale <= found.translation_error + 1e-9).all()
    assert (found.rms_px < 5).all()


@pytest.mark.long
def test_other_methods_are_as_without_shapes(
    root: Path, table: pd.DataFrame, tmp_path: Path
) -> None:
    plain = evaluate(root, out=tmp_path / "run", methods=METHODS, categories=["chair", "bottle"],
                     workers=0)  # fmt: skip
    assert "box_iou_up_to_scale" not in plain.columns
    same = table[table.method != "shape"].reset_index(drop=True)
    plain = plain.drop(columns="seconds")
    pd.testing.assert_frame_equal(same[plain.columns], plain)


@pytest.mark.long
def test_records_hold_the_estimated_box(root: Path, shapes: Path, tmp_path: Path) -> None:
    found = run(root, tmp_path / "run", shapes / "chair.shape", categories=["chair"])
    chosen = found[found.method == "shape"].set_index("model_id")
    for row in read_table(tmp_path / "run" / "records.parquet").to_pylist():
        record = json.loads(row["exhibit"])
        estimate = record["estimates"][-1]
        assert estimate["method"] == "shape"
        assert estimate["std"]["rotation_deg"] > 0
        poses = [
            Alignment(np.reshape(each["rotation"], (3, 3)), each["translation"], each["scale"])
            for each in (estimate, record["gt"])
        ]
        est, gt = (Box.from_model(record["bounds"], pose) for pose in poses)
        shift = np.linalg.norm(est.center / est.center[2] - gt.center / gt.center[2])
        assert shift < 0.05
        assert estimate["rms_px"] == pytest.approx(chosen.rms_px[row["model_id"]], abs=1e-3)
        source, target = (np.array(estimate["warp"][end]) for end in ("from", "to"))
        gaps = np.linalg.norm(source[:, None] - record["points_3d"], axis=2)
        assert gaps.min(axis=0).max() < 1e-6  # all keypoints that were given
        seen = target[gaps.argmin(axis=0)]
        residuals = KEYPOINT_CAMERA.project(poses[0].apply(seen)) - record["points_2d"]
        rms = np.sqrt((residuals**2).sum(axis=1).mean())
        assert rms == pytest.approx(estimate["rms_px"], abs=1e-2)
        assert all("warp" in other for other in estimate["alternatives"])


@pytest.mark.long
@pytest.mark.usefixtures("no_figures")
def test_the_page_shows_the_method_and_errors_up_to_scale(
    root: Path, shapes: Path, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    arguments = ["evaluate", "keypointnet", root, "--shape", shapes, "--methods", "optimal",
                 "--categories", "chair", "--workers", "0", "--out", out]  # fmt: skip
    assert main([str(each) for each in arguments]) == 0
    page = embedded_payload(out / "report.html")
    assert [method["key"] for method in page["methods"]] == ["optimal", "shape"]
    keys = [metric["key"] for metric in page["metrics"]]
    assert keys[-2:] == ["translation_error_up_to_scale", "box_iou_up_to_scale"]
    rows = page["tables"]["rows"]
    assert len(rows["box_iou_up_to_scale"]) == len(rows["method"])
    assert {row["method"] for row in page["headline"]["rows"]} == {"optimal", "shape"}


@pytest.mark.slow
@given(seed=st.integers(0, 10_000))
def test_box_alignment_gives_the_same_box(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(random_state=seed).as_matrix()
    found = Alignment(rotation, rng.normal(size=3), rng.uniform(0.5, 2, 3))
    bounds, given = (np.sort(rng.normal(size=(2, 3)), axis=0) for _ in range(2))
    given[1] += 0.1
    bounds[1] += 0.1
    box = Box.from_model(given, box_alignment(found, bounds, model_bounds=given))
    wanted = Box.from_model(bounds, found)
    np.testing.assert_allclose(box.corners, wanted.corners, atol=1e-9)


@pytest.mark.slow
def test_a_run_does_not_go_on_with_another_shape(root: Path, shapes: Path, tmp_path: Path) -> None:
    file = tmp_path / "chair.shape"
    file.write_bytes((shapes / "chair.shape").read_bytes())
    options: dict[str, Any] = {"categories": ["chair"], "max_models": 1, "methods": ["aepnp"]}
    run(root, tmp_path / "run", file, **options)
    ShapeModel.from_dataset(KeypointNet(root), "chair", modes=1).save(file)
    assert "shapes is" in refusal_text(lambda: run(root, tmp_path / "run", file, **options))


# --- what is refused -------------------------------------------------------------------------


def command(root: Path, out: Path, shape: Path) -> list[Any]:
    options = ["--categories", "bottle", "--methods", "aepnp", "--workers", "0"]
    return ["evaluate", "keypointnet", root, "--shape", shape, "--out", out, *options]


def test_shapes_that_cannot_be_used_are_refused(
    root: Path, shapes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    empty, twice, named = (tmp_path / name for name in ("empty", "twice", "bottle.shape"))
    empty.mkdir()
    twice.mkdir()
    for name in ("first", "second"):
        (twice / f"{name}.shape").write_bytes((shapes / "chair.shape").read_bytes())
    rng = np.random.default_rng(0)
    models = [Example(f"{k}", list("abcd"), rng.normal(size=(4, 3))) for k in range(8)]
    ShapeModel.learn(models, category="bottle").save(named)
    for file, text in (
        (
            shapes,
            f"{shapes}: has shapes of car, chair; the run is on bottle; "
            "give the shape of one of the run's categories",
        ),
        (
            empty,
            f"{empty}: the folder has no .shape files; write them with `cadalign shape learn`",
        ),
        (tmp_path / "none.shape", f"{tmp_path / 'none.shape'}: no such file"),
        (
            twice,
            f"{twice / 'second.shape'}: of the category chair, as first.shape; "
            "keep one file for each category",
        ),
        (
            named,
            f"{named}: its keypoints have names, those of the data set semantic ids; "
            "learn it from the data set",
        ),
    ):
        assert refusal_line(capsys, *command(root, tmp_path / "run", file)) == text
