"""Mesh files: faces in file order, colours, errors for damaged files."""

from __future__ import annotations

import logging
import struct
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import trimesh
from PIL import Image
from support.exported import wedge
from support.refusals import refusal_text

from cadalign import Mesh
from cadalign.datasets import check_solid, load_mesh
from cadalign.errors import DataError
from cadalign.io.meshes.files import write_mesh

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


@pytest.fixture
def write(tmp_path):
    """Write a file of the given name and return its path."""

    def write_file(content: str | bytes, name: str = "model.obj") -> Path:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    return write_file


# --- OBJ: geometry


@pytest.mark.parametrize(
    "face",
    [
        *("1 2 3", "1/1 2/2 3/3", "1//1 2//1 3//1", "1/1/1 2/2/1 3/3/1", "-4 -3 -2", "1/1 2 3//1"),
        *("1/ 2/ 3/", "1// 2// 3//", "1/1/ 2/2/ 3/3/", "1/1 2/2 3/", "1 2 3 # a comment", "1 2 3#"),
    ],
)
def test_obj_reads_every_form_of_corner(write, face):
    mesh = load_mesh(write(f"{SQUARE}vt 0 0\nvt 1 0\nvt 1 1\nvn 0 0 1\nf  {face}\n"))
    assert mesh.faces.tolist() == [[0, 1, 2]]


def test_obj_texture_coordinates_go_with_the_corners(write):
    text = f"{SQUARE}vt 0.1 0.2\nvt 0.3 0.4\nf 1/2 2/1 3/-1\nf 1 3 4\n"
    uv = load_mesh(write(text)).corner_uv
    np.testing.assert_allclose(uv[0], [[0.3, 0.4], [0.1, 0.2], [0.3, 0.4]])
    np.testing.assert_array_equal(uv[1], 0)


def test_obj_negative_indices_count_back_from_their_own_line(write):
    text = (
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nv 0 0 1\nv 1 0 1\nv 0 1 1\nf -3 -2 -1\nf 1 2 -1\n"
    )
    assert load_mesh(write(text)).faces.tolist() == [[0, 1, 2], [3, 4, 5], [0, 1, 5]]


def test_first_line_is_read_after_a_byte_order_mark(write):
    text = trimesh.creation.box().export(file_type="ply", encoding="ascii")
    for name, content in (("a.obj", f"{SQUARE}f 1 2 3\n".encode()), ("a.ply", text)):
        expected = load_mesh(write(content, name))
        found = load_mesh(write(b"\xef\xbb\xbf" + content, name))
        np.testing.assert_array_equal(found.vertices, expected.vertices)
        np.testing.assert_array_equal(found.faces, expected.faces)


def test_mtl_first_line_is_read_after_a_byte_order_mark(write):
    write(b"\xef\xbb\xbfnewmtl red\nKd 1 0 0\n", "a.mtl")
    mesh = load_mesh(write(f"mtllib a.mtl\n{SQUARE}usemtl red\nf 1 2 3\n"))
    assert mesh.materials[0].color[:3] == (1, 0, 0)


def test_obj_faces_keep_file_order_across_materials(write):
    lines = [f"v {i} {i * i} 0" for i in range(8)]
    for i in range(6):
        lines += [f"usemtl {'ab'[i % 2]}", f"f {i + 1} {i + 2} {i + 3}"]
    mesh = load_mesh(write("\n".join(lines)))
    assert mesh.faces.tolist() == [[i, i + 1, i + 2] for i in range(6)]
    names = [mesh.materials[number].name for number in mesh.face_material]
    assert names == ["a", "b", "a", "b", "a", "b"]


def test_obj_polygons_keep_the_number_of_their_line(write):
    text = f"{SQUARE}v 0 0 1\nf 1 2 3 4\nl 1 2\np 3\nf 1 2 5\nf 1 2 3 4 5\n"
    mesh = load_mesh(write(text))
    assert mesh.polygon.tolist() == [0, 0, 1, 2, 2, 2]
    assert mesh.faces[:2].tolist() == [[0, 1, 2], [0, 2, 3]]
    assert mesh.faces[3:].tolist() == [[0, 1, 2], [0, 2, 3], [0, 3, 4]]
    np.testing.assert_allclose(mesh.surface_points([1], [[0, 0, 1]]), [[0, 0, 1]])


def test_obj_accepts_tabs_continued_lines_windows_ends_and_comments(write):
    text = "# a\r\n\r\nv\t0 0\t0\r\nv 1 0 \\\r\n 0\r\nv 0 1 0 1.0\r\no x\r\ns off\r\n  f 1 2 3  "
    mesh = load_mesh(write(text))
    np.testing.assert_array_equal(mesh.vertices, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])


@pytest.mark.parametrize(("color", "largest"), [("1 0.5 0", 1), ("255 127.5 0", 255)])
def test_obj_vertex_colors(write, color, largest):
    mesh = load_mesh(write(f"v 0 0 0 {color}\nv 1 0 0 {color}\nv 0 1 0 {color}\nf 1 2 3\n"))
    np.testing.assert_allclose(mesh.vertex_colors, [[1, 0.5, 0, 1]] * 3)


def test_obj_vertices_without_a_color_among_others_are_white(write):
    mesh = load_mesh(write("v 0 0 0 1 0 0\nv 1 0 0\nv 0 1 0 0 0 1\nf 1 2 3\n"))
    np.testing.assert_allclose(mesh.vertex_colors[:, :3], [[1, 0, 0], [1, 1, 1], [0, 0, 1]])


# --- OBJ: materials


def test_obj_materials_and_textures(write, tmp_path):
    write("", "images/texture0.jpg")
    pixels = np.array([[[255, 0, 0], [0, 255, 0]]], dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "images" / "texture 0.png")
    write(
        "newmtl red\nKd 1 0 0\nd 0.5\nnewmtl glass\nKd 0 0 1\nTr 0.75\n"
        "newmtl wood\nKd 0 0 0\nmap_Kd -s 1 1 1 ..\\images\\texture 0.png\n",
        "models/model.mtl",
    )
    faces = "usemtl wood\nf 1 2 3\nusemtl red\nf 1 3 4\nusemtl glass\nf 1 2 4\nusemtl red\nf 2 3 4"
    mesh = load_mesh(write(f"mtllib model.mtl\n{SQUARE}{faces}\n", "models/model.obj"))
    assert [material.name for material in mesh.materials] == ["wood", "red", "glass"]
    assert mesh.face_material.tolist() == [0, 1, 2, 1]
    wood, red, glass = mesh.materials
    assert red.color == (1, 0, 0, 0.5)
    assert glass.color == (0, 0, 1, 0.25)
    assert wood.color == (1, 1, 1, 1)
    np.testing.assert_array_equal(wood.texture, pixels)


@pytest.mark.parametrize(
    ("library", "told"),
    [
        (None, "model.mtl cannot be read (no such file)"),
        ("newmtl other\nKd 1 0 0\n", "'a' is not defined"),
        ("newmtl a\nKd 1 0 0\nmap_Kd gone.png\n", "gone.png cannot be read (no such file)"),
        ("newmtl a\nKd 1 0 0\nmap_Kd bad.png\n", "bad.png cannot be read"),
        ("\0\x01garbage\nKd\nmap_Kd x\nKd 1 1 1\n", "'a' is not defined"),
    ],
)
def test_missing_materials_are_warned_of_and_become_plain(write, caplog, library, told):
    write(b"\x89PNG cut short", "bad.png")
    if library is not None:
        write(library, "model.mtl")
    with caplog.at_level(logging.WARNING, logger="cadalign"):
        mesh = load_mesh(write(f"mtllib model.mtl\n{SQUARE}usemtl a\nf 1 2 3\n"))
    assert told in caplog.text
    assert mesh.materials[0].texture is None
    assert len(mesh.materials[0].color) == 4


# --- OBJ: damage


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (f"{SQUARE}f 1 2\n", "line 5: cannot read 'f 1 2'"),
        (f"{SQUARE}f 1//1 2//\n", "line 5"),
        (f"{SQUARE}f 1 2 3\nf 1 2 x\n", "line 6"),
        (f"{SQUARE}f 1 2 3/1/1/1\n", "line 5"),
        ("v 0 0 0\nv 1 0\nv 0 1 0\nf 1 2 3\n", "line 2: cannot read 'v 1 0'"),
        ("v 0 0 0\nv 1 0 0.1.2\nv 0 1 0\nf 1 2 3\n", "line 2"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0.1.2\nf 1 2 3\n", "line 3"),
        ("v 0 0 0\nv 1 0 zero\nv 0 1 0\nf 1 2 3\n", "line 2"),
        ("v 0 0 \\\n0\nv 1 0 zero\nv 0 1 0\nf 1 2 3\n", "line 3"),
        ("f 1 2 3\n", "1 faces, but no vertices"),
        (f"{SQUARE}f 1 2 5\n", "face 0 (counted from 0) names 5/0, but there are 4 vertices"),
        (f"{SQUARE}f 1 2 3\nf 1 2 0\n", "face 1 (counted from 0) names 0/0"),
        (f"{SQUARE}f 1 2 -5\n", "names -5/0"),
        (f"{SQUARE}vt 0 0\nf 1/1 2/2 3/1\n", "names 2/2"),
        (f"{SQUARE}f 1/1 2/1 3/1\n", "names 1/1, but there are 4 vertices, 0 coordinates"),
        (f"{SQUARE}l 1 2\n", "4 vertices, but no faces"),
        ("v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "NaN or infinite"),
        (f"{SQUARE}f 1 2 3\n\0\0\0\0\n", "line 6: holds binary data"),
        ("", "is empty"),
    ],
)
def test_damaged_obj_says_file_and_line(write, text, told):
    path = write(text)
    with pytest.raises(DataError) as caught:
        load_mesh(path)
    assert str(path) in str(caught.value)
    assert told in str(caught.value)


# --- any file


@pytest.mark.parametrize("name", ["a.obj", "a.ply", "a.glb", "a.gltf", "a.stl", "a.off"])
@pytest.mark.parametrize("content", [None, b"", bytes(range(256)) * 20, b"\n\n\n"])
def test_missing_empty_and_garbage_files_are_data_errors(write, tmp_path, name, content):
    path = tmp_path / name if content is None else write(content, name)
    with pytest.raises(DataError, match=name):
        load_mesh(path)


def test_folder_and_unknown_format_are_data_errors(write, tmp_path):
    (tmp_path / "folder.obj").mkdir()
    with pytest.raises(DataError, match=r"folder\.obj"):
        load_mesh(tmp_path / "folder.obj")
    with pytest.raises(DataError, match=r"\.xyz is not a known mesh format"):
        load_mesh(write("0 0 0", "points.xyz"))


# --- PLY


@pytest.fixture(scope="module")
def colored_sphere():
    mesh = trimesh.creation.icosphere(subdivisions=1)
    colors = np.random.default_rng(0).integers(0, 256, (len(mesh.vertices), 4), dtype=np.uint8)
    return trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colors, process=False)


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_ply_keeps_order_and_colors(write, colored_sphere, encoding):
    mesh = load_mesh(write(colored_sphere.export(file_type="ply", encoding=encoding), "a.ply"))
    np.testing.assert_array_equal(mesh.faces, colored_sphere.faces)
    np.testing.assert_allclose(mesh.vertices, colored_sphere.vertices, atol=1e-6)
    np.testing.assert_allclose(mesh.vertex_colors, colored_sphere.visual.vertex_colors / 255)


def _ply(faces: list[list[int]], *, binary: bool) -> bytes:
    points = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1]]
    kind = "binary_little_endian" if binary else "ascii"
    header = (
        f"ply\nformat {kind} 1.0\nelement vertex 5\nproperty float x\nproperty float y\n"
        f"property float z\nelement face {len(faces)}\n"
        "property list uchar int vertex_indices\nend_header\n"
    ).encode()
    if binary:
        body = b"".join(struct.pack("<3f", *point) for point in points)
        return header + body + b"".join(struct.pack(f"<B{len(f)}i", len(f), *f) for f in faces)
    rows = [*points, *([len(face), *face] for face in faces)]
    return header + "\n".join(" ".join(map(str, row)) for row in rows).encode() + b"\n"


@pytest.mark.parametrize(
    ("faces", "binary"),
    [
        ([[0, 1, 2, 3], [0, 1, 2, 4]], True),
        ([[0, 1, 2, 3], [0, 1, 2, 4]], False),
        ([[0, 1, 2, 3], [0, 1, 4], [0, 1, 2, 3, 4], [1, 2, 4]], False),
        ([[0, 1, 2, 3], [0, 1, 4], [1, 2, 4]], True),
        # Of the same bytes as three of the first one's size.
        ([[0, 1, 2, 3], [0, 1, 4], [0, 1, 2, 3, 4]], True),
    ],
)
def test_ply_polygons_keep_their_number(write, faces, binary):
    mesh = load_mesh(write(_ply(faces, binary=binary), "a.ply"))
    assert mesh.polygon.tolist() == [i for i, face in enumerate(faces) for _ in face[2:]]
    for number, face in enumerate(faces):
        first = mesh.faces[np.searchsorted(mesh.polygon, number)]
        assert first.tolist() == face[:3]


@pytest.mark.parametrize("order", ["little", "big"])
def test_binary_ply_polygons_of_several_sizes_are_read(write, order):
    """Also beside lists of other things, and before further elements."""
    sign = "<" if order == "little" else ">"
    header = (
        f"ply\nformat binary_{order}_endian 1.0\nelement vertex 4\n"
        "property double x\nproperty double y\nproperty double z\n"
        "element face 2\nproperty uchar red\nproperty list uchar uint vertex_indices\n"
        "property list ushort float weights\nproperty uchar green\nproperty uchar blue\n"
        "element edge 1\nproperty int vertex1\nproperty int vertex2\nend_header\n"
    )
    body = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], f"{sign}f8").tobytes()
    body += struct.pack(f"{sign}BB3IH2fBB", 255, 3, 3, 0, 1, 2, 0.5, 0.25, 0, 0)
    body += struct.pack(f"{sign}BB4IH0fBB", 0, 4, 0, 1, 2, 3, 0, 255, 0)
    mesh = load_mesh(write(header.encode() + body + struct.pack(f"{sign}2i", 0, 1), "a.ply"))
    assert mesh.faces.tolist() == [[3, 0, 1], [0, 1, 2], [0, 2, 3]]
    assert mesh.polygon.tolist() == [0, 1, 1]


def test_ply_without_faces_is_a_data_error(write):
    content = _ply([], binary=False)
    for number in (b"0", b"-2"):
        with pytest.raises(DataError, match="no faces"):
            load_mesh(write(content.replace(b"face 0", b"face " + number), "a.ply"))


# --- scenes


@pytest.mark.parametrize("where", ["factor", "vertices"])
def test_glb_colors_are_linear_light_and_become_srgb(write, where):
    box = trimesh.creation.box()
    linear = [55, 128, 255, 255]
    if where == "factor":
        material = trimesh.visual.material.PBRMaterial(baseColorFactor=linear)
        box.visual = trimesh.visual.TextureVisuals(material=material)
    else:
        box.visual.vertex_colors = np.tile(linear, (8, 1))
    mesh = load_mesh(write(trimesh.Scene(box).export(file_type="glb"), "a.glb"))
    color = mesh.materials[0].color if where == "factor" else mesh.vertex_colors[0]
    # By IEC 61966-2-1: 1.055 c^(1/2.4) - 0.055.
    np.testing.assert_allclose(color, [0.5018, 0.7366, 1.0, 1.0], atol=1e-4)


@pytest.mark.parametrize("kind", ["stl", "stl_ascii"])
def test_stl(write, colored_sphere, kind):
    content = trimesh.Trimesh(colored_sphere.vertices, colored_sphere.faces).export(file_type=kind)
    mesh = load_mesh(write(content, "a.stl"))
    np.testing.assert_allclose(mesh.triangles, colored_sphere.triangles, atol=1e-6)


def test_polygons_of_off_keep_their_number(write):
    text = "OFF\n4 2 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n4 0 1 2 3\n"
    mesh = load_mesh(write(text, "a.off"))
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 1, 2], [0, 2, 3]]
    assert mesh.polygon.tolist() == [0, 1, 1]


def test_faces_without_area_are_refused(write):
    with pytest.raises(DataError, match="all faces of the mesh have zero area"):
        load_mesh(write(f"{SQUARE}f 1 2 2\n"))


# --- thickness


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_errors_of_flat_models_name_the_axis(axis):
    box = trimesh.creation.box(extents=(1, 2, 3))
    thin = np.array(box.vertices)
    thin[:, axis] *= 1e-7
    mesh = Mesh(thin, box.faces, source="bottle")
    with pytest.raises(
        DataError, match=f"bottle: the model has zero thickness along {'xyz'[axis]}"
    ):
        check_solid(mesh)
    thin[:, axis] *= 1e4
    check_solid(replace(mesh, vertices=thin))


# --- what a file announces, and what is there

CUBE = trimesh.creation.box()
VERTICES = "".join(f"{x} {y} {z}\n" for x, y, z in CUBE.vertices)
FACES = "".join(f"3 {a} {b} {c}\n" for a, b, c in CUBE.faces)


@pytest.mark.parametrize(
    ("header", "vertex", "face"),
    [
        ("OFF\n8 12 0 # counts\n", "\n", "\n"),
        ("OFF 8 12 0\n", " # of the vertex\n", "\n"),
        ("OFF8 12\n", "\n", " # of the face\n"),
        ("# first\noff\n# then\n8 12 18\n", "\n# between\n\n", "\n# between\n"),
        ("COFF\n8 12 0\n", " 255 0 0 255\n", " 0.5 0.5 0.5\n"),
        ("STCNOFF\n8 12 0\n", " 0 0 1 1 0 0 1 0 0\n", "\n"),
    ],
)
def test_forms_of_off_give_the_same_cube(write, header, vertex, face):
    text = header + VERTICES.replace("\n", vertex) + FACES.replace("\n", face)
    for end in ("\n", "\r\n"):
        mesh = load_mesh(write(text.replace("\n", end).encode(), "a.off"))
        np.testing.assert_array_equal(mesh.vertices, CUBE.vertices)
        np.testing.assert_array_equal(mesh.faces, CUBE.faces)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("OFF\n8 13 0\n", "the header announces 13 faces, but only 12 are there; the file is cut"),
        ("OFF\n30 1 0\n", "the header announces 30 vertices, but only 20 are there; the file is"),
        ("OFF\n7 13 0\n", "face 0 is '0.5 0.5 0.5', after the announced 7 vertices; the file is"),
        ("OFF\n-8 12 0\n", "the header announces -8 vertices and 12 faces; the file is cut short"),
        ("4OFF\n8 12 0\n", "not an OFF file of text with three dimensions; give a file"),
        ("OFF BINARY\n8 12 0\n", "not an OFF file of text with three dimensions; give a file"),
    ],
)
def test_wrong_counts_of_off_are_named(write, text, message):
    path = write(text + VERTICES + FACES, "a.off")
    assert refusal_text(lambda: load_mesh(path)).startswith(f"{path}: {message}")


@pytest.mark.parametrize("kind", ["off", "stl", "stl_ascii", "glb", "ply"])
def test_surplus_bytes_after_a_mesh_cause_a_warning(write, kind, caplog):
    content = CUBE.export(file_type=kind)
    content = content if isinstance(content, bytes) else content.encode()
    surplus = {"off": b"\n3 0 1 2\n", "stl_ascii": b"\nmore\n"}.get(kind, b"\n")
    mesh = load_mesh(write(content + surplus, f"a.{kind.removesuffix('_ascii')}"))
    np.testing.assert_allclose(mesh.triangles, CUBE.triangles)
    assert "bytes after its data are ignored" in caplog.text


@pytest.mark.parametrize(
    ("kind", "cut", "message"),
    [
        ("stl", -10, "the header announces 12 faces, but only 11 are there"),
        ("stl", 60, "60 bytes, but the header alone has 84"),
        ("stl_ascii", -8, "the text ends before 'endsolid', after 12 faces"),
        ("ply", -10, r"the header announces 12 faces, but only \d+ are there"),
        ("ply_ascii", -10, r"the header announces 12 faces, but only \d+ are there"),
        ("ply", 60, "the PLY header has no end"),
        ("glb", -10, r"the header announces \d+ bytes, but only \d+ are there"),
        ("glb", 15, r"the header announces \d+ bytes, but only 15 are there"),
    ],
)
def test_errors_of_files_cut_short_name_the_counts(write, kind, cut, message):
    if kind == "ply_ascii":
        content = CUBE.export(file_type="ply", encoding="ascii").rstrip()
    else:
        content = CUBE.export(file_type=kind)
        content = content.encode().rstrip() if isinstance(content, str) else content
    with pytest.raises(DataError, match=message):
        load_mesh(write(content[:cut], f"a.{kind.removesuffix('_ascii')}"))


# --- written files


@pytest.mark.parametrize("kind", ["obj", "ply"])
def test_vertices_faces_and_colors_come_back(tmp_path: Path, kind: Literal["obj", "ply"]) -> None:
    colors = np.round(np.random.default_rng(0).uniform(0, 1, (6, 4)) * 255) / 255
    colors[:, 3] = 1
    mesh = replace(wedge(), vertex_colors=colors)
    path = tmp_path / "new" / "folder" / f"wedge.{kind}"
    write_mesh(path, mesh, kind=kind)
    read = load_mesh(path)
    np.testing.assert_allclose(read.vertices, mesh.vertices, rtol=1e-6)
    np.testing.assert_array_equal(read.faces, mesh.faces)
    assert read.vertex_colors is not None
    np.testing.assert_allclose(read.vertex_colors, colors, atol=1e-6)
