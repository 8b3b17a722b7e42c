"""Results in files, on matplotlib axes and as data frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from support.files import TETRAHEDRON

import cadalign
from cadalign import Alignment, Camera, Mesh, Model, Result, View
from cadalign.errors import DataError, InputError

CAMERA = Camera(640, 480, 900, 900, 319.5, 239.5)
CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
POSE = Alignment(np.diag([1.0, -1.0, -1.0]), [-0.4, 0.5, 6.0], [1.0, 1.3, 0.8])
SEEN = CAMERA.project(POSE.apply(CORNERS)) + np.random.default_rng(0).normal(0, 1, (8, 2))
MESH = Mesh(CORNERS, np.array([[0, 1, 3], [4, 5, 7], [0, 2, 6], [1, 3, 7]]))


@pytest.fixture(scope="module")
def fitted() -> Result:
    return cadalign.fit(CORNERS, SEEN, CAMERA)


@pytest.fixture(scope="module")
def aligned() -> Result:
    return cadalign.align(Model(points_3d=CORNERS, mesh=MESH), View(CAMERA, SEEN))


def test_results_are_saved_and_loaded(aligned: Result, tmp_path: Path) -> None:
    aligned.save(tmp_path / "align.json")
    again = Result.load(tmp_path / "align.json")
    assert again.to_dict() == aligned.to_dict()
    assert again.cameras == (CAMERA,)
    np.testing.assert_array_equal(again.views[0].points_2d, SEEN)


def test_damaged_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "fit.json"
    path.write_text("{}")
    with pytest.raises(DataError, match=r"fit\.json: result"):
        Result.load(path)


@pytest.mark.slow
@pytest.mark.parametrize("mesh", [None, MESH])
def test_plot_gives_axes_in_pixels(fitted: Result, aligned: Result, mesh: Mesh | None) -> None:
    photo = np.zeros((480, 640, 3), dtype=np.uint8)
    for result in (fitted, aligned):
        axes = Figure().add_subplot()
        assert result.plot(photo, mesh, axes=axes) is axes
        assert axes.get_xlim() == (-0.5, 639.5)
        assert axes.get_ylim() == (479.5, -0.5)
        drawn = np.asarray(axes.images[0].get_array())
        inside = CAMERA.project(result.alignment.apply(CORNERS[[0, 1, 3]].mean(0)[None]))[0]
        column, row = np.rint(inside).astype(int)
        assert drawn[row, column].any() == (mesh is not None or result is aligned)
        assert not drawn[479, 639].any()


def test_plot_refuses_what_does_not_fit(fitted: Result, aligned: Result) -> None:
    with pytest.raises(InputError, match="10 x 10 px, the camera's image 640 x 480"):
        fitted.plot(np.zeros((10, 10, 3), np.uint8), axes=Figure().add_subplot())
    with pytest.raises(InputError, match="1 is not one of the 1 views"):
        aligned.plot(view=1, axes=Figure().add_subplot())


def test_reprs_are_short(fitted: Result, aligned: Result) -> None:
    batch = cadalign.fit_batch([CORNERS], [SEEN], CAMERA)
    assert isinstance(batch[0], Result)
    for value in (fitted, aligned, batch, MESH, aligned.model, View(CAMERA, SEEN)):
        assert len(repr(value)) < 120


def test_batch_as_data_frame_has_a_row_for_each_problem() -> None:
    flat = CORNERS * [1.0, 1.0, 0.0]
    batch = cadalign.fit_batch([CORNERS, flat[:4]], [SEEN, SEEN[:4]], CAMERA, method="aepnp")
    frame = batch.to_dataframe()
    assert frame.status.tolist() == ["ok", "failed"]
    assert (frame.keypoints[0], frame.inliers[0]) == (8, 8)
    assert frame.reason[0] == ""
    assert "6" in frame.reason[1]
    assert abs(frame.qw[0]) < 0.1  # half a turn
    assert np.isnan(frame.scale_y[1])


def test_data_frame_states_deviations_and_what_is_warned_of() -> None:
    """4 keypoints do not test the fit; a plane across the ray does not determine a stretch."""
    flat = CORNERS * [1, 1, 1e-3]
    seen = CAMERA.project(POSE.apply(flat))
    results = cadalign.fit_batch([CORNERS[[0, 1, 2, 4]], flat], [SEEN[[0, 1, 2, 4]], seen], CAMERA)
    frame = results.to_dataframe()
    for number, single in enumerate(results):
        assert frame.scale_z_std[number] == single.std.scale[2]
        assert frame.rotation_std_deg[number] == single.std.rotation_deg
        assert frame.warnings[number] == "; ".join(map(str, single.warnings))
        assert frame.uncertain[number] == "; ".join(single.uncertain)
    assert frame.warning_count[0] == 1
    assert frame.warning_kinds[0] == "untested"
    assert "s_z" in frame.uncertain[1].split("; ")


def test_results_of_both_batches_have_the_same_columns() -> None:
    few = View(CAMERA, SEEN[:2], ids=[0, 1])
    model = cadalign.Model(points_3d=CORNERS)
    aligned = cadalign.align_batch(model, [View(CAMERA, SEEN), few])
    fitted = cadalign.fit_batch([CORNERS, CORNERS[:2]], [SEEN, SEEN[:2]], CAMERA)
    frames = [results.to_dataframe() for results in (aligned, fitted)]
    for frame in frames:
        assert frame.columns.tolist() == frames[0].columns.tolist()
        assert frame.status.tolist() == ["ok", "failed"]
        assert frame.reason[0] == ""
        assert frame.reason[1]
    for column in ("rms_px", "qx", "tz", "scale_y", "focal_length", "inliers"):
        assert frames[0][column][0] == pytest.approx(frames[1][column][0], rel=1e-3, abs=1e-3)
    single = cadalign.Results([cadalign.fit(CORNERS, SEEN, CAMERA)]).to_dataframe()
    numbers = single.select_dtypes("number").columns
    expected = frames[1].loc[0, numbers].to_numpy(dtype=float)
    np.testing.assert_allclose(single.loc[0, numbers].to_numpy(dtype=float), expected, atol=1e-6)
    one = cadalign.fit(CORNERS, SEEN, CAMERA)
    assert cadalign.Results(iter([one])).to_dataframe().equals(single)


def test_of_several_views_a_row_has_the_first() -> None:
    few = View(CAMERA, SEEN[:6], ids=range(6))
    model = cadalign.Model(points_3d=CORNERS)
    results = cadalign.align_batch(model, [[View(CAMERA, SEEN), few], View(CAMERA, SEEN), few, []])
    frame = results.to_dataframe()
    assert frame["row"].tolist() == [0, 1, 2, 3]
    assert frame.views.tolist()[:3] == [2, 1, 1]
    assert frame.keypoints.tolist()[:3] == [14, 8, 6]
    joint = results[0]
    assert frame.tz[0] == joint.alignment.translation[2]
    assert isinstance(results[3], InputError)
    assert len(results[:2]) == 2
    with pytest.raises(InputError):
        results.alignment(3)


def test_poses_of_all_views_have_their_covariance() -> None:
    """In a rig, the second camera's pose follows from the first's."""
    angle = np.radians(20)
    turn = np.array(
        [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    )
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = turn, [-2.0, 0, 0.4]
    other = CAMERA.project(POSE.apply(CORNERS) @ turn.T + motion[:3, 3])
    views = [View(CAMERA, SEEN, cam_from_rig=np.eye(4)), View(CAMERA, other, cam_from_rig=motion)]
    first, second = cadalign.align(Model(points_3d=CORNERS), views).views
    carry = np.eye(9)
    carry[:3, :3] = carry[3:6, 3:6] = turn
    np.testing.assert_allclose(
        second.covariance, carry @ first.covariance @ carry.T, rtol=1e-6, atol=1e-12
    )
    assert second.std.scale == pytest.approx(first.std.scale)


def test_meshes_are_named_by_their_paths(fitted: Result, tmp_path: Path) -> None:
    path = tmp_path / "one.obj"
    path.write_text(TETRAHEDRON)
    vertices = cadalign.load_mesh(path).vertices
    np.testing.assert_array_equal(fitted.mesh(str(path)).vertices, vertices)
    assert fitted.export(tmp_path / "chair.glb", mesh=path).stat().st_size > 500


def test_a_file_is_plotted_and_exported_by_itself(
    fitted: Result, aligned: Result, tmp_path: Path
) -> None:
    for number, result in enumerate((fitted, aligned)):
        again = Result.from_dict(result.to_dict())
        again.plot(axes=Figure().add_subplot())
        path = again.export(tmp_path / f"{number}.glb", mesh=MESH)
        assert path.read_bytes() == result.export(tmp_path / "same.glb", mesh=MESH).read_bytes()
        np.testing.assert_array_equal(again.points_cam_covariance, result.points_cam_covariance)
