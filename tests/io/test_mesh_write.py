"""Meshes written as OBJ and PLY, read back as they were."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.exported import wedge

from cadalign.errors import DataError
from cadalign.geometry.mesh import Mesh
from cadalign.io.meshes.files import load_mesh, write_obj_mesh, write_ply_mesh

WRITERS = {"obj": write_obj_mesh, "ply": write_ply_mesh}


@pytest.mark.parametrize(("ending", "write"), WRITERS.items())
def test_vertices_faces_and_colors_come_back(
    tmp_path: Path, ending: str, write: Callable[[Path, Mesh], None]
) -> None:
    colors = np.round(np.random.default_rng(0).uniform(0, 1, (6, 4)) * 255) / 255
    colors[:, 3] = 1
    mesh = replace(wedge(), vertex_colors=colors)
    path = tmp_path / "new" / "folder" / f"wedge.{ending}"
    write(path, mesh)
    read = load_mesh(path)
    np.testing.assert_allclose(read.vertices, mesh.vertices, rtol=1e-6)
    np.testing.assert_array_equal(read.faces, mesh.faces)
    assert read.vertex_colors is not None
    np.testing.assert_allclose(read.vertex_colors, colors, atol=1e-6)


@pytest.mark.parametrize(("ending", "write"), WRITERS.items())
def test_a_folder_that_cannot_be_made_is_named(
    tmp_path: Path, ending: str, write: Callable[[Path, Mesh], None]
) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="file: cannot be written"):
        write(tmp_path / "file" / f"wedge.{ending}", wedge())
