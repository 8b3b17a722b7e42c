"""Evidence that cannot be: messages that say what is wrong, where, and what to do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from support.refusals import refusal_text
from support.scenes import CAMERA, around, depth_image, in_camera, keypoints, rig, seen, truth_of

from cadalign import Mesh, Model, Size, View, align

CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float) - 0.5
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
BOX = Mesh(CORNERS, [face for a, b, c, d in QUADS for face in ((a, b, c), (a, c, d))])
MODEL = Model(points_3d=CORNERS, mesh=BOX)
PIXELS = CAMERA.project(truth_of().apply(CORNERS))
POINTS = keypoints(9)
PLAIN = Model(points_3d=POINTS)
NOTHING, EVERYTHING = np.zeros((480, 640), dtype=bool), np.ones((480, 640), dtype=bool)
BODY = NOTHING.copy()
BODY[200:280, 280:360] = True
PHOTO = np.dstack([BODY * np.uint8(200)] * 3)
SEEN = View(CAMERA, PIXELS, cam_from_rig=around(0))
UNIT = "in another unit (millimetres for metres)?"


def changed(pose: np.ndarray, rows: slice | int, columns: slice | int, factor: float) -> np.ndarray:
    pose = pose.copy()
    pose[rows, columns] *= factor
    return pose


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: View(CAMERA, PIXELS, mask=NOTHING[:, 1:]),
            "mask: the mask is 639 x 480, the camera 640 x 480; "
            "give the mask of this image, in its size",
        ),
        (
            lambda: View(CAMERA, PIXELS, mask=np.dstack([NOTHING] * 3)),
            "mask: the mask is an array (480, 640, 3), the camera 640 x 480; "
            "give the mask of this image, in its size, one channel",
        ),
        (
            lambda: View(CAMERA, mask=BODY, depth=np.ones((480, 640))),
            "depth: counts at keypoints, and there are none; give some, or leave it away",
        ),
        (
            lambda: View(CAMERA, PIXELS, image=np.dstack([NOTHING / 1.0] * 4)),
            "image: float64 of shape (480, 640, 4), expected an RGB image (h, w, 3) of uint8; "
            "give the photo's array, or its path",
        ),
        (
            lambda: View(CAMERA, PIXELS, image=NOTHING.astype(np.uint8)),
            "image: uint8 of shape (480, 640), expected an RGB image (h, w, 3) of uint8; "
            "give the photo's array, or its path",
        ),
        (
            lambda: align(MODEL, [View(CAMERA, PIXELS), View(CAMERA, PIXELS, mask=NOTHING)]),
            "views[1].mask: no part of its contour is larger than a few pixels and off the image's "
            "border; give the mask of the object alone, in a photo that shows more of its outline, "
            "or None",
        ),
        (
            lambda: align(MODEL, View(CAMERA, PIXELS, mask=EVERYTHING)),
            "views[0].mask: no part of its contour is larger than a few pixels and off the image's "
            "border; give the mask of the object alone, in a photo that shows more of its outline, "
            "or None",
        ),
        (
            lambda: View(CAMERA, PIXELS, mask=EVERYTHING.astype(int) * 255),
            "mask: has values outside of [0, 1]; "
            "give a bool array, or probabilities; of an image of bytes give `image > 0`",
        ),
        (
            lambda: View(CAMERA, PIXELS, cam_from_rig=changed(around(30), slice(3), slice(3), 1.1)),
            "cam_from_rig: not a rigid motion; "
            "its upper left 3 x 3 must be a rotation, without scale",
        ),
        (
            lambda: View(CAMERA, PIXELS, cam_from_rig=changed(around(30), slice(3), 0, -1.0)),
            "cam_from_rig: not a rigid motion; "
            "its upper left 3 x 3 must be a rotation, without scale",
        ),
        (
            lambda: View(CAMERA, PIXELS, cam_from_rig=changed(around(30), 0, 3, np.nan)),
            "cam_from_rig: NaN or infinite values in row 0; remove or repair these",
        ),
        (
            lambda: align(MODEL, View(CAMERA, image=PHOTO)),
            "views: no pose with the keypoints in front of the camera follows from the evidence; "
            "give at least 3 keypoints in one view, or `init`, and check which is which",
        ),
        (
            lambda: align(MODEL, View(CAMERA, mask=BODY)),  # a face of the box, seen head-on
            "views: the evidence does not determine pose and shape; give more keypoints, or a size",
        ),
        (
            lambda: align(PLAIN, [seen(POINTS, truth_of(), around(0)), View(CAMERA)]),
            "views[1]: tells nothing about the object; "
            "give keypoints, a mask or a direction, or leave the view away",
        ),
        (
            lambda: align(
                PLAIN,
                [*rig(POINTS, truth_of(), [0, 30]), View(CAMERA, cam_from_rig=around(60))],
            ),
            "views[2]: tells nothing about the object; "
            "give keypoints, a mask or a direction, or leave the view away",
        ),
        (
            lambda: View(CAMERA, PIXELS, depth_sigma="a"),
            "depth_sigma: not an array of numbers (could not convert string to float: 'a')",
        ),
        (
            lambda: View(CAMERA, PIXELS, depth_sigma=[0.1, 0.2]),
            f"depth_sigma: 2 numbers; give one, or one for each of {len(PIXELS)} keypoints",
        ),
        (
            lambda: Size(width=1.0, sigma=np.inf),
            "size.sigma: must be positive and finite",
        ),
        (
            lambda: align(
                Model(points_3d=POINTS, ids=[*range(1, len(POINTS)), 0]),
                replace(seen(POINTS, truth_of(), around(0)), sigma=2.0, ids=None),
            ),
            "views[0].ids: no ids are given, and the model's keypoints are not 0, 1, 2, ... but "
            "1, 2, 3, 4, 5, ...; "
            "give the model's id of each keypoint of the view, in the view's order",
        ),
    ],
)
def test_evidence_that_cannot_be_is_refused(call: Callable[[], object], message: str) -> None:
    assert refusal_text(call) == message


class TestDepthsInMillimetres:
    """Of a model in metres."""

    def warnings(self, *others: View, depth: np.ndarray, size: Size | None = None) -> list[str]:
        rng = np.random.default_rng(0)
        motion = {"cam_from_rig": np.eye(4)} if others else {}
        view = seen(POINTS, truth_of(), np.eye(4), rng, depth=1000 * depth, **motion)
        return [each.text for each in align(PLAIN, [view, *others], size=size).warnings]

    @pytest.mark.parametrize("kind", ["at keypoints", "image"])
    def test_alone(self, kind: str) -> None:
        depth = in_camera(POINTS, truth_of(), np.eye(4))[:, 2]
        given = depth if kind == "at keypoints" else depth_image(POINTS, truth_of())
        (text,) = [each for each in self.warnings(depth=given) if UNIT in each]
        assert text.startswith("`depth`: the ")

    def test_beside_a_length(self) -> None:
        depth = in_camera(POINTS, truth_of(), np.eye(4))[:, 2]
        size = Size(width=np.ptp(POINTS[:, 0]) * truth_of().scale[0])
        (text,) = self.warnings(depth=depth, size=size)
        assert text.startswith(f"`depth` or `size`: is it {UNIT}")

    @pytest.mark.parametrize("count", [1, 3])
    def test_beside_known_motion(self, count: int) -> None:
        depth = in_camera(POINTS, truth_of(), np.eye(4))[:, 2]
        others = rig(POINTS, truth_of(), [30, 60, 90][:count], np.random.default_rng(1))
        found = self.warnings(*others, depth=depth)
        assert any("`depth`" in text and UNIT in text for text in found)
