"""Results in files, on matplotlib axes, in notebooks and as data frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

import cadalign
from cadalign import Alignment, AlignResult, Camera, FitResult, Mesh, Model, View
from cadalign.errors import DataError, InputError

CAMERA = Camera(640, 480, 900, 900, 319.5, 239.5)
CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
POSE = Alignment(np.diag([1.0, -1.0, -1.0]), [-0.4, 0.5, 6.0], [1.0, 1.3, 0.8])
SEEN = CAMERA.project(POSE.apply(CORNERS)) + np.random.default_rng(0).normal(0, 1, (8, 2))
MESH = Mesh(CORNERS, np.array([[0, 1, 3], [4, 5, 7], [0, 2, 6], [1, 3, 7]]))


@pytest.fixture(scope="module")
def fitted() -> FitResult:
    return cadalign.fit(CORNERS, SEEN, CAMERA)


@pytest.fixture(scope="module")
def aligned() -> AlignResult:
    return cadalign.align(Model(points_3d=CORNERS, mesh=MESH), View(CAMERA, SEEN))


def test_results_are_saved_and_loaded(
    fitted: FitResult, aligned: AlignResult, tmp_path: Path
) -> None:
    fitted.save(tmp_path / "fit.json")
    assert FitResult.load(tmp_path / "fit.json").to_dict() == fitted.to_dict()
    aligned.save(tmp_path / "align.json")
    again = AlignResult.load(tmp_path / "align.json")
    assert again.to_dict() == aligned.to_dict()
    assert again.cameras == (CAMERA,)
    np.testing.assert_array_equal(again.observed[0], SEEN)


def test_damaged_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "fit.json"
    path.write_text("{}")
    with pytest.raises(DataError, match=r"fit\.json: fit result"):
        FitResult.load(path)


@pytest.mark.long
@pytest.mark.parametrize("mesh", [None, MESH])
def test_plot_gives_axes_in_pixels(
    fitted: FitResult, aligned: AlignResult, mesh: Mesh | None
) -> None:
    photo = np.zeros((480, 640, 3), dtype=np.uint8)
    for result in (fitted, aligned):
        axes = Figure().add_subplot()
        assert result.plot(photo, mesh, axes=axes) is axes
        assert axes.get_xlim() == (-0.5, 639.5)
        assert axes.get_ylim() == (479.5, -0.5)
        drawn = np.concatenate([np.asarray(line.get_xydata()) for line in axes.lines])
        assert np.abs(drawn[:, None] - SEEN).max(axis=2).min(axis=0).max() < 1e-9


@pytest.mark.slow
def test_drawn_mesh_covers_its_pixels(fitted: FitResult) -> None:
    axes = fitted.plot(mesh=MESH, axes=Figure().add_subplot())
    pixels = np.asarray(axes.images[1].get_array())
    inside = CAMERA.project(fitted.alignment.apply(CORNERS[[0, 1, 3]].mean(0)[None]))[0]
    step = 640 / pixels.shape[1]
    column, row = ((inside + 0.5) / step).astype(int)
    assert pixels[row, column, 3] > 0
    assert pixels[0, 0, 3] == 0


def test_plot_refuses_what_does_not_fit(fitted: FitResult, aligned: AlignResult) -> None:
    with pytest.raises(InputError, match="the camera has 640 x 480 pixels"):
        fitted.plot(np.zeros((10, 10, 3), np.uint8), axes=Figure().add_subplot())
    with pytest.raises(InputError, match="1 is not one of the 1 views"):
        aligned.plot(view=1, axes=Figure().add_subplot())
    data = aligned.to_dict()
    for view in data["views"]:
        del view["camera"]
    with pytest.raises(InputError, match="written by an earlier version"):
        AlignResult.from_dict(data).plot(axes=Figure().add_subplot())


@pytest.mark.long
def test_notebooks_show_a_picture_and_a_table(fitted: FitResult, aligned: AlignResult) -> None:
    for value in (fitted, aligned, CAMERA):
        html = value._repr_html_()
        assert "data:image/png;base64," in html
        assert "<table>" in html


def test_reprs_are_short(fitted: FitResult, aligned: AlignResult) -> None:
    batch = cadalign.fit_batch([CORNERS], [SEEN], CAMERA)
    for value in (fitted, aligned, batch, MESH, aligned.model, View(CAMERA, SEEN)):
        assert len(repr(value)) < 120


def test_batch_as_data_frame_has_a_row_for_each_problem() -> None:
    flat = CORNERS * [1.0, 1.0, 0.0]
    batch = cadalign.fit_batch([CORNERS, flat[:4]], [SEEN, SEEN[:4]], CAMERA, method="aepnp")
    frame = batch.to_dataframe()
    assert frame.solved.tolist() == [True, False]
    assert frame.keypoints.tolist() == [8, 4]
    assert frame.inliers.tolist() == [8, 0]
    assert frame.error[0] == ""
    assert "6" in frame.error[1]
    rotation = frame.loc[0, ["rotation_x", "rotation_y", "rotation_z"]].to_numpy(dtype=float)
    assert abs(np.linalg.norm(rotation) - 180) < 10
    assert np.isnan(frame.scale_y[1])


def test_results_of_both_batches_have_the_same_columns() -> None:
    few = View(CAMERA, SEEN[:2], ids=[0, 1])
    model = cadalign.Model(points_3d=CORNERS)
    aligned = cadalign.align_batch(model, [View(CAMERA, SEEN), few])
    fitted = cadalign.fit_batch([CORNERS, CORNERS[:2]], [SEEN, SEEN[:2]], CAMERA)
    frames = [cadalign.to_dataframe(results) for results in (aligned, fitted)]
    for frame in frames:
        assert frame.columns.tolist() == frames[0].columns.tolist()
        assert frame.solved.tolist() == [True, False]
        assert frame.error[0] == ""
        assert frame.error[1]
    for column in ("rms", "rotation_x", "translation_z", "scale_y", "focal_length", "inliers"):
        assert frames[0][column][0] == pytest.approx(frames[1][column][0], rel=1e-3, abs=1e-3)
    single = cadalign.to_dataframe([cadalign.fit(CORNERS, SEEN, CAMERA)])
    numbers = single.columns.drop(["solved", "error"])
    expected = frames[1].loc[0, numbers].to_numpy(dtype=float)
    np.testing.assert_allclose(single.loc[0, numbers].to_numpy(dtype=float), expected, atol=1e-6)
    with pytest.raises(InputError, match=r"results\[0\]: expected a result"):
        cadalign.to_dataframe([CORNERS])
