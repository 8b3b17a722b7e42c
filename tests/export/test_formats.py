"""Mesh files for other tools, read back; what is not known is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.exported import POSE, aligned, wedge

from cadalign import Alignment
from cadalign.datasets import load_mesh
from cadalign.errors import DataError, InputError
from cadalign.export import FORMATS, export_object, format_of
from cadalign.export.aligned_object import Frame

RIG = Alignment(np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), [5, 6, 7], POSE.scale)


@pytest.mark.parametrize("frame", ["camera", "rig", "model"])
@pytest.mark.parametrize("ending", [".obj", ".ply"])
def test_mesh_files_hold_the_placed_mesh(tmp_path: Path, ending: str, frame: Frame) -> None:
    exported = aligned(tmp_path, rig_from_model=RIG, metres=2.0)
    path = export_object(tmp_path / "new" / f"wedge{ending}", exported, frame=frame)
    expected = {
        "camera": POSE.apply(wedge().vertices),
        "rig": RIG.apply(wedge().vertices),
        "model": wedge().vertices * POSE.scale,
    }[frame]
    mesh = load_mesh(path)
    np.testing.assert_allclose(mesh.vertices, 2 * expected, atol=1e-5)
    np.testing.assert_array_equal(mesh.faces, wedge().faces)


@pytest.mark.parametrize("name", ["wedge.obj", "wedge.ply"])
def test_mesh_files_have_colours_of_materials(tmp_path: Path, name: str) -> None:
    mesh = load_mesh(export_object(tmp_path / name, aligned(tmp_path)))
    texture, (_, red) = wedge().materials[0].texture, wedge().materials
    assert texture is not None
    assert mesh.vertex_colors is not None
    for vertex, expected in ((0, texture.mean(axis=(0, 1)) / 255), (2, red.color[:3])):
        np.testing.assert_allclose(mesh.vertex_colors[vertex, :3], expected, atol=1 / 255)


def test_names_tell_formats() -> None:
    for name in FORMATS:
        assert format_of(f"folder/x.{name}") == name
    with pytest.raises(InputError, match=r"a\.json: the name does not tell the format; give the"):
        format_of("a.json")


def test_unknown_options_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="format: unknown format 'x3d'; known are glb"):
        export_object(tmp_path / "a.x3d", aligned(tmp_path), format="x3d")
    with pytest.raises(InputError, match="frame: unknown frame 'moon'"):
        export_object(tmp_path / "a.obj", aligned(tmp_path), frame="moon")  # type: ignore[arg-type]


def test_meshes_far_from_their_origin_keep_their_form(tmp_path: Path) -> None:
    rig = replace(POSE, translation=np.array([400_000.123, 5_800_000.456, 30.0]))
    exported = aligned(tmp_path, rig_from_model=rig)
    mesh = load_mesh(export_object(tmp_path / "far.obj", exported, frame="rig"))
    expected = rig.apply(wedge().vertices)
    np.testing.assert_allclose(mesh.vertices, expected, rtol=0, atol=1e-7)
    with pytest.raises(DataError, match="more than 1000 times its size from its origin; PLY has 7"):
        export_object(tmp_path / "far.ply", exported, frame="rig")
