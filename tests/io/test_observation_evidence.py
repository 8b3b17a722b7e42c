"""Observation files with several views and with evidence beyond keypoints."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.files import replaced, write_json

from cadalign import Alignment, Camera
from cadalign.errors import DataError, InputError
from cadalign.io.evidence import ObservedImage, Size
from cadalign.io.observation import Observation

CAMERA = {
    "model": "PINHOLE",
    "width": 640,
    "height": 480,
    "params": [500.0, 500.0, 320.0, 240.0],
    "pixel_origin": "corner",
}
KEYPOINTS = [
    {"xyz": [0.1 * i, 0.2, -0.3 * i], "uv": [10.0 * i, 20.0], "semantic_id": i} for i in range(4)
]
EVIDENCE: dict[str, Any] = {
    "mask": "masks/a.png",
    "mask_sigma": 1.5,
    "depth_sigma": 0.02,
    "up": [0.0, -1.0, 0.1],
    "up_sigma_deg": 2.0,
    "camera_height": 1.4,
    "camera_height_sigma": 0.03,
}
SEEN: dict[str, Any] = {"camera": CAMERA, "pixel_origin": "center"}
ONE: dict[str, Any] = {
    **SEEN,
    "keypoints": KEYPOINTS,
    "image": "a.jpg",
    **EVIDENCE,
    "model": "chair.obj",
    "shape": "chair.shape",
    "size": {"height": 0.9, "length": 0.5, "sigma": 0.02},
    "init": {
        "rotation": [[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]],
        "translation": [0.1, 0.0, 2.5],
        "scale": [1.0, 1.2, 0.9],
    },
    "fit": {"sigma": 2.0},
}
_SHARED: dict[str, Any] = {
    "views": [
        {**SEEN, "keypoints": KEYPOINTS, **EVIDENCE, "cam_from_rig": np.eye(4).tolist()},
        {**SEEN, "keypoints": KEYPOINTS[:1], "cam_from_rig": np.eye(4).tolist()},
        {**SEEN, "keypoints": [], "mask": "b.png", "cam_from_rig": np.eye(4).tolist()},
    ],
    "model": "chair.obj",
    "size": {"width": 0.4},
}
SEVERAL = json.loads(json.dumps(_SHARED))  # in which no two views share a list


def test_evidence_of_one_image_is_read(tmp_path: Path) -> None:
    observation = Observation.load(write_json(tmp_path / "a.json", ONE))
    evidence = observation.evidence
    assert (evidence.mask, evidence.mask_sigma) == (tmp_path / "masks/a.png", 1.5)
    assert (evidence.depth_sigma, evidence.camera_height) == (0.02, 1.4)
    assert observation.size is not None
    assert (observation.size.height, observation.size.sigma) == (0.9, 0.02)
    assert observation.shape == tmp_path / "chair.shape"
    assert observation.views == (observation,)
    assert not observation.is_plain


def test_views_are_read(tmp_path: Path) -> None:
    observation = Observation.load(write_json(tmp_path / "a.json", SEVERAL))
    assert [len(view.points_2d) for view in observation.views] == [4, 1, 0]
    assert observation.model == tmp_path / "chair.obj"
    assert observation.others[1].evidence.mask == tmp_path / "b.png"
    for view in observation.views:
        np.testing.assert_array_equal(view.evidence.cam_from_rig, np.eye(4))


def test_init_is_read_and_needs_no_keypoints() -> None:
    data = ONE | {"keypoints": []}
    for given in (data, replaced(data, "keypoints", ...)):
        observation = Observation.from_dict(given)
        assert observation.init == Alignment(np.diag([-1.0, -1, 1]), [0.1, 0, 2.5], [1, 1.2, 0.9])
        assert len(observation.points_2d) == 0
        assert not observation.is_plain
    of_several = Observation.from_dict(SEVERAL | {"init": ONE["init"]})
    assert of_several.init is not None
    assert of_several.to_dict()["init"] == ONE["init"]
    alone = Observation.from_dict({"camera": CAMERA, "keypoints": KEYPOINTS, "init": ONE["init"]})
    assert not alone.is_plain
    assert Observation.from_dict(ONE | {"init": None}).init is None


def test_a_mask_needs_no_keypoints() -> None:
    alone = {"camera": CAMERA, "mask": "mask.png"}
    for more in ({}, {"keypoints": []}):
        found = Observation.from_dict({**alone, **more})
        assert not len(found.points_2d)
        for read in (found, Observation.from_dict(found.to_dict())):
            assert read.evidence.mask == Path("mask.png")
    with pytest.raises(DataError, match="keypoints: missing"):
        Observation.from_dict({"camera": CAMERA, "image": "photo.png"})
    nothing = {**SEEN, "keypoints": []}  # an annotation from which all was deleted
    assert Observation.from_dict(nothing).to_dict() == nothing


@pytest.mark.parametrize("data", [ONE, SEVERAL])
def test_what_is_read_is_written_again(tmp_path: Path, data: dict[str, Any]) -> None:
    path = write_json(tmp_path / "a.json", data)
    assert Observation.load(path).to_dict(folder=tmp_path) == data


def test_plain_observation_is_written_without_new_fields() -> None:
    data = {**SEEN, "keypoints": KEYPOINTS, "image": "a.jpg"}
    observation = Observation.from_dict(data)
    assert observation.is_plain
    assert list(observation.to_dict()) == ["camera", "pixel_origin", "keypoints", "image"]
    assert observation.to_dict() == data


def test_unknown_depths_of_keypoints_are_left_out() -> None:
    keypoints = [*KEYPOINTS[:3], KEYPOINTS[3] | {"depth": 2.5}]
    data = {**SEEN, "keypoints": keypoints, "depth_sigma": 0.01}
    observation = Observation.from_dict(data)
    assert observation.depths is not None
    np.testing.assert_array_equal(observation.depths, [np.nan, np.nan, np.nan, 2.5])
    assert observation.to_dict() == data
    assert not observation.is_plain


def test_views_need_no_xyz_where_a_shape_has_them(tmp_path: Path) -> None:
    data = replaced(SEVERAL, "views.1.keypoints.0.xyz", ...)
    path = write_json(tmp_path / "a.json", data)
    assert not Observation.load(path, needs_xyz=False).others[0].points_3d.any()
    with pytest.raises(DataError, match=r"views\[1\]\.keypoints\[0\]\.xyz: missing"):
        Observation.load(path)


def test_missing_xyz_are_not_written() -> None:
    bare = [{name: each[name] for name in each if name != "xyz"} for each in KEYPOINTS]
    data = {**SEEN, "keypoints": bare, "shape": "chair"}
    assert Observation.from_dict(data).to_dict() == data


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (ONE | {"mask": ""}, "{path}: mask: '' is not a path"),
        (replaced(ONE, "mask", ...), "{path}: mask_sigma: given without mask; give mask, too"),
        (ONE | {"up": [0, 1]}, "{path}: up: [0, 1] is not a list of 3"),
        (
            ONE | {"up": [0, float("inf"), 1]},
            "{path}: up[1]: inf is not a finite number",
        ),
        (
            ONE | {"size": {"depth": 3}},
            "{path}: size: unknown field 'depth'; known are height, length, sigma, width",
        ),
        (
            ONE | {"size": {"sigma": 0.1}},
            "{path}: size: no length is given; give width, height or length",
        ),
        (
            ONE | {"size": {"width": 1, "sigma": [0.1, 0.1]}},
            "{path}: size.sigma: [0.1, 0.1] is not a finite number",
        ),
        (
            replaced(ONE, "init.translation", ...),
            "{path}: init.translation: missing",
        ),
        (replaced(ONE, "init.scale.1", 0.0), "{path}: init.scale: "),
        (SEVERAL | {"views": []}, "{path}: views: [] is not a list of at least 1"),
        (
            SEVERAL | {"camera": CAMERA},
            "{path}: camera: not allowed beside `views`; give it in each of the views",
        ),
        (replaced(SEVERAL, "views.1.camera", ...), "{path}: views[1].camera: missing"),
        (
            replaced(SEVERAL, "views.2.mask", ...) | {"fit": {"sigma": [1.0]}},
            "{path}: fit.sigma: a list, but there are several views; "
            "give one number for all, or `sigma` of every keypoint",
        ),
        (
            replaced(SEVERAL, "views.1.up_sigma_deg", 3),
            "{path}: views[1].up_sigma_deg: given without up; give up, too",
        ),
    ],
)
def test_malformed_evidence_is_refused_by_file_and_field(
    tmp_path: Path, data: Any, text: str
) -> None:
    path = write_json(tmp_path / "observation.json", data)
    with pytest.raises(DataError) as caught:
        Observation.load(path)
    message, expected = str(caught.value), text.format(path=path)
    assert message.startswith(expected) if expected.endswith(" ") else message == expected


def test_arrays_of_evidence_are_checked() -> None:
    camera = Camera.from_dict(CAMERA)
    points = np.zeros((2, 3)), np.zeros((2, 2))
    with pytest.raises(InputError, match=r"depths: shape \(3,\), expected \(2\)"):
        ObservedImage(*points, camera, depths=np.ones(3))
    with pytest.raises(InputError, match="no length is given"):
        Size()
