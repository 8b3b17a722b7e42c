"""BOP's files of poses: truth written and read back, and files that are damaged."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from cadalign import Alignment
from cadalign.datasets import Bop
from cadalign.datasets.photos.bop_files import (
    read_bop_results,
    read_scene_gt,
    write_bop_results,
    write_scene_gt,
)
from cadalign.datasets.photos.dataset import PoseEstimate
from cadalign.errors import DataError
from cadalign.geometry.rotations import rotation_from_vector

HEADER = "scene_id,im_id,obj_id,score,R,t,time"
GOOD = "1,5,2,0.9,1 0 0 0 1 0 0 0 1,1 2 3,-1"


def poses(count: int = 20) -> list[PoseEstimate]:
    rng = np.random.default_rng(0)
    return [
        PoseEstimate(
            "3",
            str(number // 4),
            f"obj_{1 + number % 4:06d}",
            Alignment(rotation_from_vector(rng.normal(0, 2, 3)), rng.normal(0, 800, 3), np.ones(3)),
        )
        for number in range(count)
    ]


def assert_same(read: tuple[PoseEstimate, ...], written: list[PoseEstimate]) -> None:
    assert [(e.scene, e.image, e.model_id) for e in read] == [
        (e.scene, e.image, e.model_id) for e in written
    ]
    for one, other in zip(read, written, strict=True):
        np.testing.assert_allclose(
            one.cam_from_model.packed, other.cam_from_model.packed, rtol=0, atol=1e-6
        )


def test_poses_come_back_from_both_files(tmp_path: Path) -> None:
    written = poses()
    write_bop_results(tmp_path / "results.csv", written)
    assert_same(read_bop_results(tmp_path / "results.csv")[0], written)
    scene = tmp_path / "000003"
    scene.mkdir()
    write_scene_gt(scene / "scene_gt.json", written)
    assert_same(read_scene_gt(scene / "scene_gt.json")[0], written)


def test_truth_of_real_photos_comes_back(tmp_path: Path, real_data: Path) -> None:
    written = [
        PoseEstimate("2", photo.name, found.category, found.truth.cam_from_model)
        for photo in Bop(real_data / "real" / "lmo_multiview")
        for found in photo.objects
        if found.truth.cam_from_model is not None
    ]
    assert len(written) == 24
    write_bop_results(tmp_path / "results.csv", written)
    assert_same(read_bop_results(tmp_path / "results.csv")[0], written)


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("1,5,2,0.9,1 0 0 0 1 0 0 0 1,1 2 3", "6 cells, expected 7"),
        ("1,5,2,0.9,1 0 0 0 1 0 0 0,1 2 3,-1", "R '1 0 0 0 1 0 0 0' is not 9 finite numbers"),
        ("1,5,2,0.9,2 0 0 0 2 0 0 0 2,1 2 3,-1", "not a rotation matrix"),
        ("1,5,2,0.9,1 0 0 0 1 0 0 0 1,1 nan 3,-1", "t '1 nan 3' is not 3 finite numbers"),
        ("1,x,2,0.9,1 0 0 0 1 0 0 0 1,1 2 3,-1", "im_id 'x' is not a whole number"),
    ],
)
def test_a_bad_line_is_told_of_and_the_rest_is_read(tmp_path: Path, line: str, reason: str) -> None:
    path = tmp_path / "results.csv"
    path.write_text("\n".join([HEADER, line, GOOD]) + "\n")
    (_,), (problem,) = read_bop_results(path)
    assert str(problem).startswith(f"{path}, line 2: {reason}")
    path.write_text("\n".join([HEADER, line]) + "\n")
    with pytest.raises(DataError, match="line 2"):
        read_bop_results(path)


def test_files_of_other_kinds_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "results.csv"
    path.write_text("x,y\n1,2\n")
    with pytest.raises(DataError, match="the first line is not scene_id,im_id"):
        read_bop_results(path)
    with pytest.raises(DataError, match="no such file"):
        read_bop_results(tmp_path / "gone.csv")
    truth = tmp_path / "scene_gt.json"
    truth.write_text("[1]")
    with pytest.raises(DataError, match="not a table of lists of poses"):
        read_scene_gt(truth)
    truth.write_text('{"1": [{"cam_R_m2c": [1, 0')
    with pytest.raises(DataError, match="not valid JSON"):
        read_scene_gt(truth)


def test_a_bad_pose_of_scene_gt_is_told_of(tmp_path: Path) -> None:
    path = tmp_path / "scene_gt.json"
    good = {"cam_R_m2c": np.eye(3).ravel().tolist(), "cam_t_m2c": [0, 0, 900], "obj_id": 4}
    path.write_text(json.dumps({"5": [{**good, "cam_t_m2c": [0, 0]}, good], "x": [good]}))
    poses, problems = read_scene_gt(path)
    assert [each.image for each in poses] == ["5"]
    assert [str(each).split(": ")[1] for each in problems] == ["5[0].cam_t_m2c", "x"]
