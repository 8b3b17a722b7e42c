"""Errors of `align` against the Cramer-Rao bound of each kind of evidence."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from support.bounds import bound_of, whitened_square
from support.scenes import around, in_camera, keypoints, rig, seen, truth_of

from cadalign import Alignment, Model, Size, View, align

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
        model = Model(points_3d=points)
        bound = bound_of(model, views, size, truths)
        found = align(model, views, size=size).alignment
        squares.append(whitened_square(found, truths[0], bound))
    ratio = np.sqrt(np.mean(squares))
    assert 0.85 < ratio <= _MOST
