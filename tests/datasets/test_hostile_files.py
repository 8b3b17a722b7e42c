"""Hostile files: memory and time are bounded by the file's size; all errors are CadalignError."""

from __future__ import annotations

import base64
import json
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from support.timing import Measure, ratio, reference_seconds, timed

from cadalign.datasets import (
    BlindPnP,
    load_mesh,
    read_image_keypoints,
)
from cadalign.errors import CadalignError, DataError
from cadalign.io.documents import read_json
from cadalign.io.images import read_photo
from cadalign.io.observation import Observation

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
MANY_DIGITS = "9" * 5000
LONGEST_REFUSAL = 1.0  # seconds


def gltf(**changes: Any) -> str:
    """A triangle in one accessor of positions and one of indices."""
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
    content = points + np.array(changes.pop("faces", [0, 1, 2]), "<u4").tobytes()
    uri = "data:application/octet-stream;base64," + base64.b64encode(content).decode()
    scene: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "buffers": [{"byteLength": len(content), "uri": uri}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 36},
            {"buffer": 0, "byteOffset": 36, "byteLength": 12},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5125, "count": 3, "type": "SCALAR"},
        ],
    }
    return json.dumps(scene | changes)


EMPTY = {"componentType": 5126, "count": 2**28, "type": "VEC3"}
INDICES = {"bufferView": 1, "componentType": 5125, "count": 3, "type": "SCALAR"}


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("wide.obj", "v 0 0 0\n" * 20_000 + "v " + "1 " * 100_000 + "\nf 1 2 3\n"),
        ("integer.obj", TRIANGLE + f"f 1/1/1 2//2 {'9' * 25}\n"),
        ("negative.obj", TRIANGLE + f"f 1 2 -{'9' * 25}\n"),
        ("digits.obj", TRIANGLE + f"f 1//1 2/1 {MANY_DIGITS}\n"),
        ("infinite.obj", f"v 1e999 0 0\n{TRIANGLE}f 1 2 3\n"),
        ("empty.gltf", gltf(accessors=[EMPTY, INDICES])),
        ("matrix.gltf", gltf(nodes=[{"mesh": 0, "matrix": [1e308] * 16}])),
        ("nan.gltf", gltf(nodes=[{"mesh": 0, "matrix": [float("nan")] * 16}])),
        ("short.gltf", gltf(nodes=[{"mesh": 0, "matrix": [1, 2, 3]}])),
        ("index.gltf", gltf(faces=[0, 1, 2**31 + 7])),
        ("text.gltf", gltf(accessors=[{"count": "many"}, 3])),
        ("list.gltf", "[]"),
        ("digits.gltf", f'{{"accessors": {MANY_DIGITS}}}'),
        (
            "digits.ply",
            f"ply\nformat ascii 1.0\nelement vertex {MANY_DIGITS}\nproperty float x\n"
            "element face 1\nproperty list uchar int vertex_indices\nend_header\n0\n",
        ),
        ("digits.off", f"OFF\n3 {MANY_DIGITS} 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"),
    ],
    ids=lambda value: value if len(value) < 20 else "",
)
@pytest.mark.timing
@pytest.mark.filterwarnings("error")
def test_hostile_meshes_are_refused_quickly(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)

    def refuse() -> None:
        with pytest.raises(DataError) as caught:
            load_mesh(tmp_path / name)
        assert len(str(caught.value)) < 600 + len(str(tmp_path))

    assert reference_seconds(timed(refuse), below=LONGEST_REFUSAL, rounds=1) < LONGEST_REFUSAL


@pytest.mark.timing
def test_time_for_continued_lines_grows_with_the_file(tmp_path: Path) -> None:
    def loading(count: int) -> Measure:
        path = tmp_path / f"{count}.obj"
        path.write_text(TRIANGLE + "f " + "1 \\\n" * count + "2 3\n")
        assert len(load_mesh(path).faces) == count
        return timed(lambda: load_mesh(path))

    # Eight times the lines, which leave the caches: 8 to 12 times the time. With the square of
    # their number it would be 64 times.
    assert ratio(loading(400_000), loading(50_000), below=24) < 24
    assert reference_seconds(loading(400_000), below=0.6) < 0.6


@pytest.mark.parametrize("options", ["-s 1 1", "-s 1", "-o", "-s", "-mm 1", ""])
def test_texture_options_without_a_file_are_ignored(tmp_path: Path, options: str) -> None:
    (tmp_path / "a.obj").write_text(f"mtllib a.mtl\nusemtl a\n{TRIANGLE}f 1 2 3\n")
    (tmp_path / "a.mtl").write_text(f"newmtl a\nmap_Kd {options}\n")
    assert load_mesh(tmp_path / "a.obj").materials[0].texture is None


@pytest.mark.long
def test_texture_that_is_far_larger_than_its_file_is_left_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    Image.new("1", (13_000, 13_000)).save(tmp_path / "a.png")
    faces = "".join(f"usemtl {n}\nf 1 2 3\n" for n in range(10))
    (tmp_path / "a.obj").write_text(f"mtllib a.mtl\n{TRIANGLE}{faces}")
    (tmp_path / "a.mtl").write_text("".join(f"newmtl {n}\nmap_Kd a.png\n" for n in range(10)))
    mesh = load_mesh(tmp_path / "a.obj")
    assert all(material.texture is None for material in mesh.materials)
    assert "13000 x 13000 pixels in" in caplog.text


def test_materials_share_the_texture_that_they_name(tmp_path: Path) -> None:
    Image.new("RGB", (4, 4)).save(tmp_path / "a.png")
    faces = "".join(f"usemtl {n}\nf 1 2 3\n" for n in range(3))
    (tmp_path / "a.obj").write_text(f"mtllib a.mtl\n{TRIANGLE}{faces}")
    (tmp_path / "a.mtl").write_text("".join(f"newmtl {n}\nmap_Kd a.png\n" for n in range(3)))
    first, second, third = (m.texture for m in load_mesh(tmp_path / "a.obj").materials)
    assert first is second
    assert second is third


# --- numbers -----------------------------------------------------------------------------------


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", ["matches", "R", "t", "inlier_matches"])
@pytest.mark.parametrize("value", [1e308, 1e30, -1e30, 10**400, float("nan")])
def test_huge_numbers_affect_one_sample(tmp_path: Path, name: str, value: float) -> None:
    rows = np.array([[0.1, 0.2, 0.1, 0.2, 1.0]] * 4)
    samples: dict[str, Any] = {
        "matches": rows.tolist(),
        "R": np.eye(3).tolist(),
        "t": [0.0, 0.0, 0.0],
        "inlier_matches": [[0, 0], [1, 1], [2, 2]],
    }
    bad = json.loads(json.dumps(samples[name]))
    if isinstance(bad[0], list):
        bad[0][0] = value
    else:
        bad[0] = value
    for file, good in samples.items():
        content = [good, bad if file == name else good]
        (tmp_path / f"{file}.pkl").write_bytes(pickle.dumps(content, protocol=2))
    data = BlindPnP(tmp_path)
    assert len(data[0]) in (3, 4)
    with pytest.raises(CadalignError):
        data[1]


# --- text and JSON ----------------------------------------------------------------------------


@pytest.mark.parametrize("name", [r"\ud800", r"x\udfff", r"\udc00\ud800"])
def test_unpaired_surrogates_are_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / "a.json"
    path.write_text(f'{{"keypoints": [], "image": "{name}"}}')
    for read in (Observation.load, read_json):
        with pytest.raises(DataError, match="unpaired surrogate"):
            read(path)
    path.write_text(r'{"image": "\ud83e\ude91"}')
    assert read_json(path) == {"image": "\N{CHAIR}"}


@pytest.mark.parametrize("library", ["newmtl a\nmap_Kd {}", "newmtl {}\nmap_Kd a.png"])
def test_long_names_of_textures_and_materials_are_cut(
    tmp_path: Path, library: str, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "a.obj").write_text(f"mtllib a.mtl\n{TRIANGLE}usemtl {'y' * 999}\x1b[2J\nf 1 2 3\n")
    (tmp_path / "a.mtl").write_text(library.format("x" * 5000 + "\x1b[2J"))
    load_mesh(tmp_path / "a.obj")
    assert caplog.records
    for record in caplog.records:
        assert record.getMessage().isprintable()
        assert len(record.getMessage()) < 600


@pytest.mark.parametrize("read", [read_photo, read_image_keypoints, load_mesh])
def test_paths_with_a_nul_are_refused(read: Callable[[str], object]) -> None:
    with pytest.raises(CadalignError):
        read("a\0b.obj")
