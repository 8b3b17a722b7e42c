"""Views of reconstructions: keypoints in several photos, the result in the world's frame."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from cadalign import Model, View, align
from cadalign.datasets import Colmap


def opened() -> Colmap:
    if "CADALIGN_DATA" not in os.environ:
        pytest.skip("CADALIGN_DATA is not set")
    root = Path(os.environ["CADALIGN_DATA"]) / "sfm" / "maupertuis_colmap"
    if not root.is_dir():
        pytest.skip(f"{root} does not exist")
    return Colmap(root)


def test_points_of_the_scene_are_aligned_in_its_frame() -> None:
    images = opened()
    first, second = images[0], images[1]
    # The points that the fewest pixels of error have in both photos stand for an object.
    ids = [each.point_ids if each.point_ids is not None else None for each in (first, second)]
    assert ids[0] is not None
    assert ids[1] is not None
    shared = np.intersect1d(*ids)
    errors = np.zeros(len(shared))
    for image, numbers in zip((first, second), ids, strict=True):
        rows = [int(np.flatnonzero(numbers == each)[0]) for each in shared]
        errors += np.linalg.norm(image.residuals()[rows], axis=1)
    chosen = shared[np.argsort(errors)[:20]]
    views = []
    for image, numbers in zip((first, second), ids, strict=True):
        rows = [int(np.flatnonzero(numbers == each)[0]) for each in chosen]
        pose, names = image.cam_from_world.cam_from_model, [int(each) for each in chosen]
        seen = image.points_2d[rows]
        views.append(View(image.camera, seen, ids=names, sigma=0.3, cam_from_rig=pose))
    rows = [int(np.flatnonzero(ids[0] == each)[0]) for each in chosen]
    world = first.points_3d[rows]
    scale = np.array([0.5, 2.0, 1.3])
    model = Model(points_3d=world / scale, ids=[int(each) for each in chosen])
    result = align(model, views)
    assert result.rig_from_model is not None
    size = np.linalg.norm(np.ptp(world, axis=0))
    assert np.abs(result.rig_from_model.apply(world / scale) - world).max() < 0.01 * size
    assert np.allclose(result.rig_from_model.scale, scale, rtol=0.02)
