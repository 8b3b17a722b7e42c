"""Mesh files for other tools, read back; what is not known is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.exported import CAMERA, POSE, aligned, wedge

from cadalign.datasets import load_mesh
from cadalign.errors import InputError
from cadalign.export import FORMATS, AlignedObject, ExportView, export_object, format_of


@pytest.mark.parametrize("ending", [".obj", ".ply"])
def test_mesh_files_hold_the_placed_mesh(tmp_path: Path, ending: str) -> None:
    path = export_object(tmp_path / "new" / f"wedge{ending}", aligned(tmp_path))
    mesh = load_mesh(path)
    np.testing.assert_allclose(mesh.vertices, POSE.apply(wedge().vertices), atol=1e-5)
    np.testing.assert_array_equal(mesh.faces, wedge().faces)


def test_obj_keeps_materials_and_texture(tmp_path: Path) -> None:
    mesh = load_mesh(export_object(tmp_path / "wedge.obj", aligned(tmp_path)))
    expected = wedge()
    np.testing.assert_array_equal(mesh.face_material, expected.face_material)
    np.testing.assert_array_equal(mesh.materials[0].texture, expected.materials[0].texture)
    assert mesh.materials[1].color == pytest.approx(expected.materials[1].color)
    assert mesh.corner_uv is not None
    np.testing.assert_allclose(mesh.corner_uv, expected.corner_uv, atol=1e-6)


def test_names_tell_formats(tmp_path: Path) -> None:
    for name in FORMATS:
        assert format_of(f"folder/x.{name}") is FORMATS[name]
    with pytest.raises(InputError, match=r"a\.x3d: the name does not tell the format; give one"):
        export_object(tmp_path / "a.x3d", aligned(tmp_path))


@pytest.mark.parametrize("name", ["far.ply", "far.obj"])
def test_mesh_files_far_from_their_origin_keep_their_form(tmp_path: Path, name: str) -> None:
    far = replace(POSE, translation=np.array([400_000.123, 5_800_000.456, 30.0]))
    exported = AlignedObject((ExportView(CAMERA, far),), mesh=wedge())
    mesh = load_mesh(export_object(tmp_path / name, exported))
    np.testing.assert_allclose(mesh.vertices, far.apply(wedge().vertices), rtol=0, atol=1e-7)
