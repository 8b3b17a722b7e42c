"""`cadalign doctor`: check the renderers, and compile the solvers."""

from __future__ import annotations

import multiprocessing
import os
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cadalign.cli.common import answer, show_status
from cadalign.errors import InputError
from cadalign.estimation.options import METHODS, RansacOptions
from cadalign.geometry.alignment import Alignment, Box
from cadalign.geometry.camera import Camera

if TYPE_CHECKING:
    from cadalign.render.probe import Probe


@dataclass(frozen=True)
class Doctor:
    """Check the renderers, and show how to enable those that fail.

    Also shows the cache of compiled solvers.
    """

    compile: bool = False
    """Compile all solvers now, for example in a Docker image, instead of at their first call."""

    def run(self) -> int:
        """Run the checks; returns the exit code, 0 if ray casting works."""
        return self._compile() if self.compile else self._check()

    def _check(self) -> int:
        from cadalign.render.probe import REMEDIES

        with show_status("testing the renderers ..."):
            renderers = probe_renderers()
        for each in renderers:
            answer(f"{each.name:9} {'works' if each.works else 'fails'}: {each.detail}")
        for each in renderers:
            if not each.works:
                answer(f"To enable {each.name}: {REMEDIES[each.name]}")
        answer(f"Compiled solvers: {describe_cache()}")
        return 0 if renderers[-1].works else 1

    def _compile(self) -> int:
        from cadalign.compile.folder import kernel_folder

        folder = kernel_folder()
        if not can_write(folder):
            fix = "set NUMBA_CACHE_DIR to a writable folder"
            raise InputError(f"{folder} cannot be written to", where="--compile", fix=fix)
        began = time.perf_counter()
        with show_status("compiling ..."):
            compile_ahead()
        answer(f"Compiled in {time.perf_counter() - began:.1f} s: {describe_cache()}")
        return 0


def probe_renderers() -> list[Probe]:
    """Test each renderer in its own process, ray casting last; takes some seconds."""
    from cadalign.render.probe import RENDERERS, probe_renderer

    return [probe_renderer(name) for name in RENDERERS]


def can_write(folder: Path) -> bool:
    """True if a folder, or its nearest existing parent, is writable."""
    existing = next((place for place in (folder, *folder.parents) if place.is_dir()), Path("/"))
    return os.access(existing, os.W_OK)


def describe_cache() -> str:
    """Describe the cache of compiled solvers: its folder and number of functions."""
    from cadalign.compile.folder import kernel_folder

    folder = kernel_folder()
    count = sum(1 for _ in folder.rglob("*.nbc")) if folder.is_dir() else 0
    if count:
        return f"{count} functions kept in {folder}"
    if can_write(folder):
        return f"none yet; they will be kept in {folder}"
    fix = "set NUMBA_CACHE_DIR, or every process compiles the solvers again"
    return f"{folder} cannot be written to; {fix}"


# All solvers compiled ahead, in two processes ----------------------------------------------------

_CAMERA = Camera(640, 480, 900.0, 900.0, 319.5, 239.5)
_POSE = Alignment(np.eye(3), np.array([0.0, 0.0, 2.0]), np.ones(3))
_RANSAC = RansacOptions(max_iterations=10)


def compile_ahead() -> None:
    """Compile all solvers that are not in the cache yet."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(2, mp_context=context) as pool:
        jobs = [  # the longest first
            pool.submit(_align_shape, 2),
            pool.submit(_fits),
            pool.submit(_align_shape, 1),
            pool.submit(_align_with_mask),
            pool.submit(_retrieval_and_boxes),
        ]
    for job in jobs:
        job.result()


def _points() -> tuple[np.ndarray, np.ndarray]:
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (12, 3))
    return points, _CAMERA.project(_POSE.apply(points))


def _fits() -> None:
    from cadalign.estimation.fit import fit

    points, pixels = _points()
    for method in METHODS:
        fit(points, pixels, _CAMERA, method=method)
    fit(points, pixels, _CAMERA, ransac=_RANSAC, sigma=1.0)
    _ = fit(points, pixels, _CAMERA, focal="estimate").covariance


def _align_shape(views: int) -> None:
    from cadalign.estimation.align import align
    from cadalign.estimation.view import View
    from cadalign.shapes.model import ShapeModel

    points, pixels = _points()
    directions = np.random.default_rng(0).normal(size=(2, 12, 3))
    shape = ShapeModel.from_basis(points, directions, [0.1, 0.1])
    seen = [View(_CAMERA, pixels, sigma=1.0)] * views
    if views > 1:
        # Two keypoints propose no poses. The other process compiles the search for poses first.
        few = View(_CAMERA, pixels[:2], ids=(0, 1), sigma=1.0)
        align(shape, [few] * views, init=[_POSE] * views)
    align(shape, seen)


def _align_with_mask() -> None:
    from cadalign.estimation.align import align
    from cadalign.estimation.model import Model
    from cadalign.estimation.view import View
    from cadalign.geometry.mesh import Mesh
    from cadalign.render import Scene, cast_geometry

    points, pixels = _points()
    corners = 0.6 * np.concatenate([np.ones((1, 3)), np.eye(3)]) - 0.3
    mesh = Mesh(corners, np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]))
    mask = cast_geometry(Scene(mesh), _CAMERA, _POSE).mask
    view = View(_CAMERA, pixels, sigma=1.0, mask=mask)
    align(Model(points_3d=points, mesh=mesh), view, ransac=_RANSAC)


def _retrieval_and_boxes() -> None:
    from cadalign.metrics import box_iou
    from cadalign.retrieval import Library, LibraryModel

    points, pixels = _points()
    bounds = np.array([[-0.3, -0.3, -0.3], [0.3, 0.3, 0.3]])
    models = [
        LibraryModel("box", str(k), points * (1.0 + k), np.arange(12), bounds) for k in range(3)
    ]
    Library.from_models(models).retrieve(pixels, np.arange(12), _CAMERA)
    box = Box.from_model(bounds, _POSE)
    box_iou(est=box, gt=box)
