"""`align` with masks of objects without a mesh: learned shapes and similar models."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cadalign import Camera, Model, ShapeModel, View, align
from cadalign.datasets import AnnotatedModel, KeypointNet, write_sample_dataset
from cadalign.geometry.alignment import Box
from cadalign.metrics import box_iou_up_to_scale
from cadalign.render import Scene, Viewpoint, cast_geometry, sample_view
from cadalign.shapes.examples import examples_of
from cadalign.shapes.warp import linear_warp, warp_mesh

pytestmark = pytest.mark.long

CAMERA = Camera(640, 480, 935, 935, 319.5, 239.5)


@pytest.fixture(scope="module")
def bottles(tmp_path_factory: pytest.TempPathFactory) -> tuple[AnnotatedModel, ...]:
    root = tmp_path_factory.mktemp("bottles") / "sample"
    dataset = KeypointNet(write_sample_dataset(root, per_category=16, categories=["bottle"]))
    return dataset["bottle"]


@pytest.fixture(scope="module")
def shape(bottles: tuple[AnnotatedModel, ...]) -> ShapeModel:
    """The shape learned from all bottles but the first four."""
    examples = examples_of(bottles[4:], meshes=True)
    return ShapeModel.learn(examples, category="bottle", components=1)


def test_a_learned_shape_is_better_with_a_mask(
    bottles: tuple[AnnotatedModel, ...], shape: ShapeModel
) -> None:
    alone, joint = [], []
    for number, model in enumerate(bottles[:2]):
        rng = np.random.default_rng(number)
        scene = Scene(model.load_mesh())
        points = model.keypoints.xyz
        shown = sample_view(scene, points, CAMERA, rng=rng, min_visible=6, roll=10.0)
        truth = shown.cam_from_model
        pixels = CAMERA.project(truth.apply(points[shown.visible]))
        pixels += rng.normal(0, 1, pixels.shape)
        ids = model.keypoints.ids[shown.visible].tolist()
        mask = cast_geometry(scene, CAMERA, truth).mask
        box = Box.from_model(scene.bounds, truth)
        for found, given in ((alone, None), (joint, mask)):
            result = align(shape, View(CAMERA, pixels, ids=ids, mask=given))
            found.append(box_iou_up_to_scale(est=result.box, gt=box))
    assert np.mean(joint) > np.mean(alone)


def test_a_similar_model_follows_the_mask(sample_root: Path) -> None:
    model = KeypointNet(sample_root)["chair"][0]
    scene = Scene(model.load_mesh())
    rng = np.random.default_rng(3)
    points = model.keypoints.xyz
    shown = sample_view(scene, points, CAMERA, rng=rng, min_visible=7)
    pixels = CAMERA.project(shown.cam_from_model.apply(points[shown.visible]))
    mask = cast_geometry(scene, CAMERA, shown.cam_from_model).mask
    similar = Model(points_3d=points, mesh=scene.mesh, shape_sigma=0.02)
    ids = np.flatnonzero(shown.visible).tolist()
    noisy = pixels + rng.normal(0, 1, pixels.shape)
    alone = align(similar, View(CAMERA, noisy, ids=ids))
    result = align(similar, View(CAMERA, noisy, ids=ids, mask=mask))
    assert result.evidence[-1].rms < 3
    assert result.std.rotation_deg < alone.std.rotation_deg


def test_a_linear_warp_is_that_of_the_mesh(sample_root: Path) -> None:
    model = KeypointNet(sample_root)["chair"][0]
    mesh, points = model.load_mesh(), model.keypoints.xyz
    target = points + np.random.default_rng(0).normal(0, 0.02, points.shape)
    bounds = mesh.bounds * [1.1, 0.9, 1.05]
    warp = linear_warp(mesh.vertices, mesh.bounds, points)
    expected = warp_mesh(mesh, points, target, bounds=bounds).vertices
    assert np.allclose(warp.apply(target, bounds), expected)
    step = np.random.default_rng(1).normal(0, 0.01, points.shape)
    moved = warp.apply(target + step, bounds) - warp.apply(target, bounds)
    assert np.allclose(moved, warp.derivative(step, np.zeros((2, 3))), atol=1e-12)


class TestLearnedWithoutAnnotatedMask:
    def shown(self, model: AnnotatedModel, seed: int) -> tuple[Viewpoint, np.ndarray]:
        scene = Scene(model.load_mesh())
        rng = np.random.default_rng(seed)
        shown = sample_view(scene, model.keypoints.xyz, CAMERA, rng=rng, min_visible=6, roll=10.0)
        return shown, cast_geometry(scene, CAMERA, shown.cam_from_model).mask

    def test_a_photo_counts_beside_clicks(
        self, bottles: tuple[AnnotatedModel, ...], shape: ShapeModel
    ) -> None:
        shown, mask = self.shown(bottles[0], 0)
        points, ids = bottles[0].keypoints.xyz, bottles[0].keypoints.ids
        rng = np.random.default_rng(0)
        clicks = CAMERA.project(shown.cam_from_model.apply(points[shown.visible]))
        clicks += rng.normal(0, 4, clicks.shape)
        colors = np.where(mask[:, :, None], [190, 60, 50], [70, 120, 90])
        photo = np.clip(colors + rng.normal(0, 6, colors.shape), 0, 255).astype(np.uint8)
        view = View(CAMERA, clicks, ids=ids[shown.visible].tolist(), sigma=4.0, image=photo)
        found = align(shape, view)
        (summary,) = [each for each in found.evidence if each.kind == "photo"]
        assert summary.share > 0.5
