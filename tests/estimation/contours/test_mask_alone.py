"""`align` with a mask alone: pose and stretch of an exact model."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from cadalign import Alignment, Camera, FocalPrior, Mesh, Model, Size, Symmetry, View, align
from cadalign.estimation.contours.silhouettes import select_distinct
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.metrics import nearest_truth, rotation_error
from cadalign.render import Scene, cast_geometry

pytestmark = pytest.mark.long

CAMERA = Camera(320, 240, 450, 450, 159.5, 119.5)


@cache
def body() -> Mesh:
    """A body without symmetry: a block, a post, and an arm."""
    return _blocks(
        [[-0.5, -0.3, -0.2], [0.5, -0.1, 0.3]],
        [[-0.5, -0.3, -0.2], [-0.3, 0.6, 0.0]],
        [[-0.5, 0.4, -0.2], [0.2, 0.55, -0.05]],
    )


def _blocks(*bounds: list[list[float]]) -> Mesh:
    choices = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    one = np.array(
        [[0, 1, 3], [0, 3, 2], [4, 7, 5], [4, 6, 7], [0, 5, 1], [0, 4, 5]]
        + [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    )
    vertices = [np.array(each)[choices, np.arange(3)] for each in bounds]
    faces = [one + 8 * number for number in range(len(bounds))]
    return Mesh(np.concatenate(vertices), np.concatenate(faces))


def posed(seed: int, scale: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Alignment:
    rng = np.random.default_rng(seed)
    turn = rotation_from_vector(rng.normal(0, 1.2, 3))
    return Alignment(turn, [0.15, -0.1, 3.2], np.array(scale))


def mask_of(mesh: Mesh, pose: Alignment) -> np.ndarray:
    return np.asarray(cast_geometry(Scene(mesh), CAMERA, pose).mask)


def test_of_equal_poses_one_is_a_start() -> None:
    about = Symmetry.around([0, 1, 0], fold=None)
    turns = [posed(0).rotation @ rotation_from_vector([0, angle, 0]) for angle in (0, 0.7, 1.5)]
    other = rotation_from_vector([0.6, 0, 0]) @ posed(0).rotation
    found = [Alignment(turn, [0, 0, 3], np.ones(3)) for turn in (*turns, other)]
    assert select_distinct(found, 4, None) == found
    assert select_distinct(found, 4, about) == [found[0], found[3]]
    assert select_distinct(found, 2, None) == found[:2]


def test_a_prior_on_the_focal_length_is_enough() -> None:
    truth = posed(0)
    view = View(Camera.from_size(320, 240), mask=mask_of(body(), truth))
    model = Model(mesh=body())
    found = align(model, view, focal="estimate", focal_prior=FocalPrior(470, 0.08))
    assert rotation_error(est=found.alignment, gt=truth) < 1
    assert found.camera.fx == pytest.approx(450, rel=0.02)
    assert 0 < found.std.focal < 0.02


def test_a_mask_alone_of_another_view_counts_where_known_motion_gives_the_pose() -> None:
    scale = (1.0, 1.4, 0.7)
    first, second = posed(2, scale), posed(22, scale)
    points = body().vertices[[0, 1, 2, 3, 4, 5, 9, 14, 20]]
    noise = np.random.default_rng(2).normal(0, 1, (len(points), 2))
    views = [
        View(CAMERA, CAMERA.project(first.apply(points)) + noise),
        View(CAMERA, mask=mask_of(body(), second)),
    ]
    model = Model(points_3d=points, mesh=body())
    alone = align(model, views)
    assert any(text.startswith("views[1] is left out") for text in map(str, alone.warnings))
    motion = np.eye(4)
    motion[:3, :3] = second.rotation @ first.rotation.T
    motion[:3, 3] = second.translation - motion[:3, :3] @ first.translation
    poses = (np.eye(4), motion)
    rig = [replace(v, cam_from_rig=pose) for v, pose in zip(views, poses, strict=True)]
    found = align(model, rig, size=Size(height=float(np.ptp(body().vertices[:, 1]) * 1.4)))
    assert rotation_error(est=found.alignment, gt=first) < 0.5
    assert found.alignment.scale == pytest.approx(scale, rel=0.02)


class TestOwnModel:
    def test_pose_and_stretch_are_found(self) -> None:
        truth = posed(0, (1.0, 1.4, 0.7))
        mask = mask_of(body(), truth)
        found = align(Model(mesh=body()), View(CAMERA, mask=mask))
        assert rotation_error(est=found.alignment, gt=truth) < 1.0
        assert found.alignment.scale == pytest.approx(truth.scale, rel=0.02)
        assert not any(each.kind == "mask" for each in found.warnings)
        assert found.std.scale[0] == 0.0  # it is the known length
        assert "stretch      (1, " in str(found)

    def test_a_mask_that_the_border_cuts_is_warned_of(self) -> None:
        mask = mask_of(body(), posed(0, (1.0, 1.4, 0.7)))
        columns = np.flatnonzero(mask.any(axis=0))
        cut = np.zeros_like(mask)
        shift = columns[0] + 3 * len(columns) // 10
        cut[:, :-shift] = mask[:, shift:]
        found = align(Model(mesh=body()), View(CAMERA, mask=cut))
        (text,) = [str(each) for each in found.warnings if each.kind == "mask"]
        assert text.startswith("views[0].mask")
        assert "border" in text or "meets the outline" in text

    def test_held_stretch_is_held(self) -> None:
        truth = posed(3)
        model = Model(mesh=body(), stretch="none")
        found = align(model, View(CAMERA, mask=mask_of(body(), truth)))
        assert found.alignment.scale.tolist() == [1.0, 1.0, 1.0]
        assert rotation_error(est=found.alignment, gt=truth) < 0.5

    def test_mask_that_is_cut_out_generously(self) -> None:
        """The contour's distance from the rims exceeds the noise."""
        truth, camera = posed(0, (1.0, 0.8, 1.2)), CAMERA.resize(640, 480)
        mask = cast_geometry(Scene(body()), camera, truth).mask.astype(np.uint8)
        wide = cv2.dilate(mask, np.ones((13, 13), np.uint8)) > 0
        found = align(Model(mesh=body()), View(camera, mask=wide))
        assert rotation_error(est=found.alignment, gt=truth) < 1.0
        off = np.abs(np.log(found.alignment.scale / truth.scale))
        assert (off < 0.05 + np.array(found.std.scale)).all()

    @pytest.mark.parametrize("known", ["up", "size"])
    def test_gravity_and_lengths_count_beside_the_mask(self, known: str) -> None:
        truth = posed(11, (1.0, 1.4, 0.7))
        mask = mask_of(body(), truth)
        size = Size(*(np.ptp(body().vertices, axis=0) * truth.scale))
        view = View(CAMERA, mask=mask, up=truth.rotation[:, 1] if known == "up" else None)
        found = align(Model(mesh=body()), view, size=size if known == "size" else None)
        assert rotation_error(est=found.alignment, gt=truth) < 1.0

    def test_probabilities_of_a_large_photo(self) -> None:
        """Starts use a smaller copy of the mask, the last rounds the mask itself."""
        truth, camera = posed(0, (1.0, 1.2, 0.8)), CAMERA.resize(1280, 960)
        mask = cast_geometry(Scene(body()), camera, truth).mask.astype(np.float32)
        soft = np.clip(cv2.GaussianBlur(mask, (0, 0), 3.0), 0.0, 1.0)
        found = align(Model(mesh=body()), View(camera, mask=soft, mask_sigma=1.0))
        assert rotation_error(est=found.alignment, gt=truth) < 0.3
        assert found.alignment.scale == pytest.approx(truth.scale, rel=0.01)

    def test_same_evidence_gives_the_same_estimate(self) -> None:
        view = View(CAMERA, mask=mask_of(body(), posed(1)))
        first, second = (align(Model(mesh=body()), view).alignment for _ in range(2))
        assert first.rotation.tolist() == second.rotation.tolist()

    def test_symmetry_is_known(self) -> None:
        box = _blocks([[-0.5, -0.2, -0.3], [0.5, 0.2, 0.3]])
        symmetry = Symmetry.around((0, 1, 0), fold=2)
        truth = posed(5)
        model = Model(mesh=box, stretch="none", symmetry=symmetry)
        found = align(model, View(CAMERA, mask=mask_of(box, truth)))
        poses = [found.alignment, *(each.alignment for each in found.alternatives)]
        errors = [
            rotation_error(est=each, gt=nearest_truth(est=each, gt=truth, symmetry=symmetry))
            for each in poses
        ]
        assert min(errors) < 1.0


class TestSimilarModel:
    wide = Mesh(body().vertices * [1.0, 1.05, 0.95], body().faces)
    model = Model(points_3d=wide.vertices, mesh=wide, shape_sigma=0.03)

    @pytest.mark.parametrize("ids", [[], [7]], ids=["none", "one"])
    def test_a_start_needs_no_keypoints(self, ids: list[int]) -> None:
        truth = posed(1)
        turn = rotation_from_vector(np.array([0.1, 0.05, -0.1]))
        start = Alignment(turn @ truth.rotation, truth.translation, np.ones(3))
        pixels = CAMERA.project(truth.apply(body().vertices[ids]))
        view = View(CAMERA, pixels, ids=ids, sigma=1.0, mask=mask_of(body(), truth))
        found = align(self.model, view, init=start)
        assert rotation_error(est=found.alignment, gt=truth) < 6.0
        assert np.abs(found.residuals).max(initial=0.0) < 3.0
