"""Scenes for `align`: an object before cameras that go around it, and what each of them tells."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from cadalign import Alignment, Camera, Mesh, View

CAMERA = Camera(640, 480, 900, 900, 319.5, 239.5)
LOOK = np.array([[0.8, 0.0, 0.6], [-0.36, -0.8, 0.48], [0.48, -0.6, -0.64]])
DISTANCE = 5.0
CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float) - 0.5
_QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
BOX = Mesh(CORNERS, [face for a, b, c, d in _QUADS for face in ((a, b, c), (a, c, d))])


def keypoints(count: int = 10, seed: int = 0) -> np.ndarray:
    """Keypoints (n, 3) of a model of length 1."""
    return np.random.default_rng(seed).uniform(-0.5, 0.5, (count, 3))


def truth_of(scale: Sequence[float] = (1.4, 0.7, 1.9)) -> Alignment:
    return Alignment(LOOK, [0.1, -0.05, DISTANCE], np.array(scale))


def around(angle_deg: float) -> np.ndarray:
    """The pose (4, 4) of a camera that went around the object, in the frame of the first."""
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    pose = np.eye(4)
    pose[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    pose[:3, 3] = np.array([0, 0, DISTANCE]) - pose[:3, :3] @ [0, 0, DISTANCE]
    return pose


def in_camera(points: np.ndarray, truth: Alignment, motion: np.ndarray) -> np.ndarray:
    return truth.apply(points) @ motion[:3, :3].T + motion[:3, 3]


def seen(
    points: np.ndarray,
    truth: Alignment,
    motion: np.ndarray,
    rng: np.random.Generator | None = None,
    **options: Any,
) -> View:
    """What a camera shows, with 1 px of noise where a generator is given."""
    pixels = CAMERA.project(in_camera(points, truth, motion))
    noise = 0.0 if rng is None else rng.normal(0, 1, pixels.shape)
    return View(CAMERA, pixels + noise, **options)


def rig(
    points: np.ndarray,
    truth: Alignment,
    angles: Sequence[float],
    rng: np.random.Generator | None = None,
) -> list[View]:
    """Views from known places around the object."""
    return [seen(points, truth, around(angle), rng, cam_from_rig=around(angle)) for angle in angles]


def depth_image(points: np.ndarray, truth: Alignment, *, background: float = 9.0) -> np.ndarray:
    """A depth image (h, w) that shows a disc of 6 px at each keypoint before a background."""
    found = in_camera(points, truth, np.eye(4))
    image = np.full((CAMERA.height, CAMERA.width), background)
    rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width]
    for (x, y), depth in zip(CAMERA.project(found), found[:, 2], strict=True):
        disc = (columns - x) ** 2 + (rows - y) ** 2 <= 36
        image[disc] = np.minimum(image[disc], depth)
    return image


def turned(direction: np.ndarray, angle_deg: float, rng: np.random.Generator) -> np.ndarray:
    """A direction (3,) turned by an angle about a random axis across it."""
    axis = np.cross(direction, rng.normal(size=3))
    axis /= np.linalg.norm(axis)
    angle = np.radians(angle_deg)
    return np.asarray(np.cos(angle) * direction + np.sin(angle) * np.cross(axis, direction))
