"""Errors of `align` against the Cramer-Rao bound of each kind of evidence."""

from __future__ import annotations

import os
from collections.abc import Callable
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.bounds import bound_of, whitened_square
from support.scenes import around, in_camera, keypoints, rig, seen, truth_of

from cadalign import Alignment, Camera, Model, Size, View, align

SEEDS = 60
_MOST = 1.1
Case = tuple[list[View], Size | None, list[Alignment]]


def moved(truth: Alignment, motion: np.ndarray) -> Alignment:
    rotation, shift = motion[:3, :3], motion[:3, 3]
    return Alignment(rotation @ truth.rotation, rotation @ truth.translation + shift, truth.scale)


def known_motion(angles: list[float]) -> Callable[[np.ndarray, np.random.Generator], Case]:
    def build(points: np.ndarray, rng: np.random.Generator) -> Case:
        return rig(points, truth_of(), angles, rng), None, [truth_of()]

    return build


def unknown_motion(angles: list[float]) -> Callable[[np.ndarray, np.random.Generator], Case]:
    def build(points: np.ndarray, rng: np.random.Generator) -> Case:
        truth = truth_of((1.0, 0.7, 1.5))
        views = [seen(points, truth, around(angle), rng) for angle in angles]
        return views, None, [moved(truth, around(angle)) for angle in angles]

    return build


def depth(points: np.ndarray, rng: np.random.Generator) -> Case:
    truth = truth_of()
    exact = in_camera(points, truth, np.eye(4))[:, 2]
    noisy = exact * (1 + 0.005 * rng.normal(size=len(exact)))
    return [seen(points, truth, np.eye(4), rng, depth=noisy, depth_sigma=0.005)], None, [truth]


def gravity(points: np.ndarray, rng: np.random.Generator) -> Case:
    truth = truth_of((1.0, 0.7, 1.5))
    axes = np.linalg.svd(truth.rotation[:, 1][None])[2][1:]
    up = truth.rotation[:, 1] + np.radians(rng.normal(size=2)) @ axes
    return [seen(points, truth, np.eye(4), rng, up=up)], None, [truth]


def length(points: np.ndarray, rng: np.random.Generator) -> Case:
    truth = truth_of()
    height = np.ptp(points[:, 1]) * truth.scale[1] * (1 + 0.01 * rng.normal())
    return [seen(points, truth, np.eye(4), rng)], Size(height=height), [truth]


def everything(points: np.ndarray, rng: np.random.Generator) -> Case:
    truth = truth_of()
    views, size, _ = length(points, rng)
    del views
    angles = [0.0, 30.0]
    exact = in_camera(points, truth, np.eye(4))[:, 2]
    noisy = exact * (1 + 0.01 * rng.normal(size=len(exact)))
    axes = np.linalg.svd(truth.rotation[:, 1][None])[2][1:]
    up = truth.rotation[:, 1] + np.radians(rng.normal(size=2)) @ axes
    camera = float((-truth.rotation.T @ truth.translation)[1])
    ground = camera - truth.scale[1] * points[:, 1].min()
    told = {"depth": noisy, "up": up, "camera_height": ground * (1 + 0.02 * rng.normal())}
    views = [
        seen(points, truth, around(a), rng, cam_from_rig=around(a), **(told if a == 0 else {}))
        for a in angles
    ]
    return views, size, [truth]


@pytest.mark.long
@pytest.mark.parametrize(
    "build",
    [
        pytest.param(known_motion([0, 25]), id="two views, known motion"),
        pytest.param(known_motion([0, -40, -20, 20, 40]), id="five views, known motion"),
        pytest.param(unknown_motion([0, 25]), id="two views, unknown motion"),
        pytest.param(unknown_motion([0, -40, -20, 20, 40]), id="five views, unknown motion"),
        pytest.param(depth, id="depth"),
        pytest.param(gravity, id="gravity"),
        pytest.param(length, id="length"),
        pytest.param(everything, id="everything"),
    ],
)
def test_errors_are_at_the_bound(
    build: Callable[[np.ndarray, np.random.Generator], Case],
) -> None:
    points = keypoints(10)
    squares = []
    for seed in range(SEEDS):
        views, size, truths = build(points, np.random.default_rng(seed))
        result = align(Model(points_3d=points), views, size=size)
        squares.append(whitened_square(result, truths))
    ratio = np.sqrt(np.mean(squares))
    assert 0.85 < ratio <= _MOST


def farthest_points(vertices: np.ndarray, count: int) -> np.ndarray:
    """Vertices (n, 3), each the farthest from those before it."""
    chosen = [int(np.argmax(np.linalg.norm(vertices - vertices.mean(axis=0), axis=1)))]
    distances = np.full(len(vertices), np.inf)
    while len(chosen) < count:
        away = np.linalg.norm(vertices - vertices[chosen[-1]], axis=1)
        distances = np.minimum(distances, away)
        chosen.append(int(np.argmax(distances)))
    return vertices[chosen]


class TestRealCameras:
    """Photos of one table: true poses of four objects in six cameras of unknown to 89 degrees."""

    @pytest.fixture(scope="class")
    def scene(self) -> tuple[Camera, dict[int, np.ndarray], dict[int, dict[int, np.ndarray]]]:
        import json

        import trimesh

        if "CADALIGN_DATA" not in os.environ:
            pytest.skip("CADALIGN_DATA is not set")
        root = Path(os.environ["CADALIGN_DATA"]) / "real" / "lmo_multiview"
        if not root.is_dir():
            pytest.skip(f"{root} does not exist")
        k = json.loads((root / "camera.json").read_text())
        camera = Camera(k["width"], k["height"], k["fx"], k["fy"], k["cx"], k["cy"])
        meshes = {
            int(path.stem[4:]): farthest_points(np.array(trimesh.load(path).vertices) / 1000, 5)
            for path in sorted((root / "models").glob("*.ply"))
        }
        poses: dict[int, dict[int, np.ndarray]] = {}
        for image, objects in json.loads((root / "scene_gt.json").read_text()).items():
            for each in objects:
                pose = np.eye(4)
                # Files hold rotations with few digits.
                pose[:3, :3] = Rotation.from_matrix(
                    np.reshape(each["cam_R_m2c"], (3, 3))
                ).as_matrix()
                pose[:3, 3] = np.array(each["cam_t_m2c"]) / 1000
                poses.setdefault(int(image), {})[each["obj_id"]] = pose
        return camera, meshes, poses

    @pytest.mark.long
    def test_two_views_of_five_keypoints_reach_the_bound(
        self, scene: tuple[Camera, dict[int, np.ndarray], dict[int, dict[int, np.ndarray]]]
    ) -> None:
        camera, meshes, poses = scene
        images = sorted(poses)
        errors, squares, bounds = [], [], []
        rng = np.random.default_rng(0)
        for obj, points in meshes.items():
            for first, second in combinations(images, 2):
                pair = [poses[image][obj] for image in (first, second)]
                scale = 2.0 ** rng.uniform(-1, 1, 3)  # the model is the object over this
                views = []
                for image, pose in zip((first, second), pair, strict=True):
                    seen_points = points @ pose[:3, :3].T + pose[:3, 3]
                    pixels = camera.project(seen_points) + rng.normal(0, 1, (5, 2))
                    motion = poses[image][obj] @ np.linalg.inv(pair[0])
                    views.append(View(camera, pixels, cam_from_rig=motion))
                result = align(Model(points_3d=points / scale), views)
                truth = Alignment(pair[0][:3, :3], pair[0][:3, 3], scale)
                errors.append(np.abs(np.log(result.alignment.scale / scale)))
                squares.append(whitened_square(result, [truth]))
                bounds.append(np.sqrt(bound_of(result, [truth]).diagonal()[6:]))
        # A normal deviate exceeds 0.67 of its deviation in half of the cases.
        expected = 0.67 * np.median(bounds, axis=0)
        assert (np.median(errors, axis=0) < 1.3 * expected).all()
        assert np.sqrt(np.median(squares)) < 1.1  # the median of a chi-square of nine is 0.93
