"""Duration of an alignment with a mask."""

from __future__ import annotations

import numpy as np
import pytest
from support.scenes import CAMERA, LOOK
from support.timing import reference_seconds, timed

from cadalign import Alignment, Mesh, Model, View, align
from cadalign.render import Scene, cast_geometry


def wavy_sphere(rows: int) -> Mesh:
    """A closed surface of about 4 rows squared triangles, without symmetry."""
    polar = np.linspace(0.01, np.pi - 0.01, rows + 1)[:, None]
    around = np.linspace(0, 2 * np.pi, 2 * rows, endpoint=False)[None]
    radius = 0.5 + 0.08 * np.sin(3 * around) * np.sin(polar) ** 2 + 0.06 * np.cos(2 * polar)
    radius = radius + 0.05 * np.cos(around)
    planar = radius * np.sin(polar)
    vertices = np.stack(
        [planar * np.cos(around), 1.3 * radius * np.cos(polar), planar * np.sin(around)], axis=2
    ).reshape(-1, 3)
    first = np.arange(rows)[:, None] * 2 * rows
    here = np.arange(2 * rows)[None]
    beside = (here + 1) % (2 * rows)
    a, b, c, d = (first + here, first + beside, first + 2 * rows + here, first + 2 * rows + beside)
    faces = np.concatenate([np.stack([a, b, c], axis=2), np.stack([b, d, c], axis=2)])
    return Mesh(vertices, faces.reshape(-1, 3))


@pytest.mark.timing
def test_a_mask_takes_at_most_half_a_second() -> None:
    mesh = wavy_sphere(71)
    assert 20_000 <= len(mesh.faces) <= 20_500
    truth = Alignment(LOOK, [0.0, 0.0, 2.9], np.array([1.0, 0.8, 1.2]))
    rng = np.random.default_rng(0)
    points = np.asarray(mesh.vertices)[rng.choice(len(mesh.vertices), 8, replace=False)]
    mask = cast_geometry(Scene(mesh), CAMERA, truth).mask
    assert mask.sum() > 60_000
    pixels = CAMERA.project(truth.apply(points)) + rng.normal(0, 1, (8, 2))
    model, view = Model(points_3d=points, mesh=mesh), View(CAMERA, pixels, mask=mask)
    assert np.isfinite(align(model, view).evidence[-1].rms)  # compiles the kernels, too
    measure = timed(lambda: align(model, view))
    assert reference_seconds(measure, below=0.5) < 0.5
