"""Exported mesh files, read back; unknown formats are refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.exported import CAMERA, POSE, aligned, wedge

from cadalign.datasets import load_mesh
from cadalign.errors import DataError, InputError
from cadalign.export import FORMATS, AlignedObject, ExportView, export_object, format_of


@pytest.mark.parametrize("ending", [".obj", ".ply"])
def test_mesh_files_hold_the_placed_mesh(tmp_path: Path, ending: str) -> None:
    path = export_object(tmp_path / "new" / f"wedge{ending}", aligned(tmp_path))
    mesh = load_mesh(path)
    np.testing.assert_allclose(mesh.vertices, POSE.apply(wedge().vertices), atol=1e-5)
    np.testing.assert_array_equal(mesh.faces, wedge().faces)


@pytest.mark.parametrize("name", ["wedge.obj", "wedge.ply"])
def test_mesh_files_have_colours_of_materials(tmp_path: Path, name: str) -> None:
    mesh = load_mesh(export_object(tmp_path / name, aligned(tmp_path)))
    texture, (_, red) = wedge().materials[0].texture, wedge().materials
    assert texture is not None
    assert mesh.vertex_colors is not None
    for vertex, expected in ((0, texture.mean(axis=(0, 1)) / 255), (2, red.color[:3])):
        np.testing.assert_allclose(mesh.vertex_colors[vertex, :3], expected, atol=1 / 255)


def test_the_extension_selects_the_format(tmp_path: Path) -> None:
    for name in FORMATS:
        assert format_of(f"folder/x.{name}") is FORMATS[name]
    with pytest.raises(InputError, match=r"'\.x3d' is not an export format; the formats are \.glb"):
        export_object(tmp_path / "a.x3d", aligned(tmp_path))


def test_meshes_far_from_their_origin_keep_their_form(tmp_path: Path) -> None:
    far = replace(POSE, translation=np.array([400_000.123, 5_800_000.456, 30.0]))
    exported = AlignedObject((ExportView(CAMERA, far),), mesh=wedge())
    mesh = load_mesh(export_object(tmp_path / "far.obj", exported))
    np.testing.assert_allclose(mesh.vertices, far.apply(wedge().vertices), rtol=0, atol=1e-7)
    with pytest.raises(DataError, match="more than 1000 times its size from its origin; PLY has 7"):
        export_object(tmp_path / "far.ply", exported)
