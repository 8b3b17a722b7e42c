"""Estimates from keypoints in real photos."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from cadalign import Alignment, Camera, Model, View, align, fit
from cadalign.datasets import Colmap
from cadalign.io.observation import Observation
from cadalign.metrics import rotation_error


@pytest.fixture
def scene(real_data: Path) -> Colmap:
    return Colmap(real_data / "sfm" / "maupertuis_colmap")


@pytest.mark.parametrize("name", ["bdc89254", "b4371c35"])
def test_chairs_that_are_only_similar_to_their_models(real_data: Path, name: str) -> None:
    folder = real_data / "real" / "scan2cad"
    truth = json.loads((folder / "truth.json").read_text())[name]
    rotation, shift = truth["cam_from_model_rotation"], truth["translation_in_model_x_units"]
    gt = Alignment(np.array(rotation), shift, truth["stretch"])
    chair = Observation.load(folder / "observations" / f"{name}.json")
    # Annotations have errors of about 8 px; chair and model differ by about 5 cm of 80.
    view = View(chair.camera, chair.points_2d, sigma=8.0)
    result = align(Model(points_3d=chair.points_3d, shape_sigma=0.05), view)
    assert rotation_error(est=result.alignment, gt=gt) < min(5, 2 * result.std.rotation_deg)
    assert (np.abs(result.stretch / gt.scale - 1) <= 0.2).all()
    logs = np.log(result.stretch / gt.scale) / np.array(result.std.scale)
    assert (np.abs(logs[1:]) < 2).all()
    if name == "bdc89254":
        given = chair.points_3d, chair.points_2d, chair.camera
        robust = fit(*given, sigma=None, loss="cauchy")
        assert robust.sigma > 1
        assert robust.std.rotation_deg > 7.6


def test_points_of_a_scene_are_aligned_in_its_frame(scene: Colmap) -> None:
    images = scene[0], scene[1]
    rows = [{str(xyz): k for k, xyz in enumerate(image.points_3d.tolist())} for image in images]
    errors = [np.linalg.norm(image.residuals(), axis=1) for image in images]
    # The points that the fewest pixels of error have in both photos stand for an object.
    shared = sorted(
        rows[0].keys() & rows[1].keys(),
        key=lambda each: errors[0][rows[0][each]] + errors[1][rows[1][each]],
    )[:20]
    views = [
        View(
            image.camera,
            image.points_2d[[places[each] for each in shared]],
            ids=shared,
            sigma=0.3,
            cam_from_rig=image.cam_from_world.cam_from_model,
        )
        for image, places in zip(images, rows, strict=True)
    ]
    world = images[0].points_3d[[rows[0][each] for each in shared]]
    scale = np.array([0.5, 2.0, 1.3])
    model = Model(points_3d=world / scale, ids=shared)
    result = align(model, views)
    size = np.linalg.norm(np.ptp(world, axis=0))
    assert np.abs(result.rig_from_model.apply(world / scale) - world).max() < 0.01 * size
    assert np.allclose(result.rig_from_model.scale, scale, rtol=0.02)


@pytest.mark.slow
def test_unknown_focal_lengths_with_scales_drawn_at_random(scene: Colmap) -> None:
    rng = np.random.default_rng(0)
    strong = weak = 0
    for image in scene:
        camera = Camera.from_size(image.camera.width, image.camera.height)
        for _ in range(3):
            scale = np.array([1.0, *rng.uniform(0.5, 2, 2)])
            unknown = {"focal": "estimate", "focal_prior": None, "sigma": None}
            result = fit(image.points_3d / scale, image.points_2d, camera, **unknown)
            off = abs(result.camera.fx / image.camera.fx - 1)
            if result.std.focal < 0.005:
                strong += 1
                assert off < 0.01
                np.testing.assert_allclose(result.alignment.scale, scale, rtol=0.01)
            if result.std.focal > 0.02:
                weak += 1
                assert off < 5 * result.std.focal  # the lens is no pinhole, which its noise is not
    assert (strong, weak) == (9, 3)
