"""`cadalign render` and `cadalign doctor`: what they write, and what they refuse."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
import trimesh
import tyro
from PIL import Image
from support.refusals import refusal_line

from cadalign.cli.doctor import Doctor, compiled_cache
from cadalign.cli.render import Render
from cadalign.compile.folder import kernel_folder
from cadalign.errors import DataError, InputError, RenderError
from cadalign.render.probe import RENDERERS, Probe


@pytest.fixture
def model(tmp_path) -> Path:
    path = tmp_path / "parts" / "box.obj"
    path.parent.mkdir()
    trimesh.creation.box((0.4, 0.8, 0.6)).export(path)
    return path


def _run(model, *arguments, renderer="raycast"):
    """Run the command as the command line does."""
    command = tyro.cli(Render, args=[str(model), "--renderer", renderer, *map(str, arguments)])
    return command.run()


def _pixels(path):
    with Image.open(path) as image:
        return np.asarray(image)


def test_one_view_gives_a_still(model, tmp_path):
    out = tmp_path / "new" / "still.png"
    assert _run(model, "--out", out, "--resolution", "200x150") == 0
    pixels = _pixels(out)
    assert pixels.shape == (150, 200, 3)
    assert tuple(pixels[0, 0]) == (228, 230, 233)
    changed = (pixels != pixels[0, 0]).any(axis=2)
    assert 0.15 < changed.mean() < 0.8


@pytest.mark.parametrize("views", [["front", "top"], ["30,20", "-30,20,10", "left"], ["all"]])
def test_several_views_give_a_contact_sheet(model, tmp_path, views):
    _run(model, "--out", tmp_path / "s.png", "--resolution", "80x60", "--view", *views)
    height, width = _pixels(tmp_path / "s.png").shape[:2]
    assert width > 160
    assert height > 60 * (1 if len(views) == 2 else 2)


def test_a_jpg_is_a_still(model, tmp_path):
    out = tmp_path / "s.jpg"
    _run(model, "--out", out, "--resolution", "80x60")
    assert out.read_bytes()[:2] == b"\xff\xd8"
    assert _pixels(out).shape[:2] == (60, 80)


@pytest.mark.long
def test_the_stretch_shows(model, tmp_path):
    extents = []
    for scale in ((1, 1, 1), (1, 0.5, 1)):
        out = tmp_path / "s.png"
        _run(model, "--out", out, "--view", "front", "--scale", *scale)
        rows, columns = np.nonzero((_pixels(out) != (228, 230, 233)).any(axis=2))
        extents.append(np.ptp(rows) / np.ptp(columns))
    assert extents[0] / extents[1] == pytest.approx(2, abs=0.1)


@pytest.mark.long
def test_keypoints_are_drawn_from_their_file(model, tmp_path):
    named = {"name": "corner", "xyz": [0.2, 0.4, -0.3]}
    own = {"format": "cadalign model keypoints", "version": 1, "keypoints": [named]}
    (tmp_path / "parts.keypoints.json").write_text(json.dumps(own))
    out, keypoints = tmp_path / "k.png", tmp_path / "parts.keypoints.json"
    _run(model, "--out", out, "--keypoints", keypoints, "--resolution", "160x120")
    drawn = _pixels(out).astype(int)
    assert ((drawn[:, :, 0] - drawn[:, :, 2]) > 100).sum() > 10


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (["--resolution", "0x0"], InputError, "'0x0' is no resolution"),
        (["--resolution", "640"], InputError, "give WIDTHxHEIGHT"),
        (["--resolution", "20000x20000"], RenderError, "the limits are 16384 px a side"),
        (["--resolution", "999999999x1"], RenderError, "the limits are"),
        (["--view", "sideways"], InputError, "is not a view"),
        (["--view", "nothing.json"], InputError, "is not a view"),
        (["--out", "picture.jpeg"], InputError, "neither a PNG nor a JPEG"),
        (["--scale", "1", "0", "1"], InputError, "is not positive"),
        (["--fov", "180"], InputError, "--fov: 180.0 is not between 0 and 180"),
        (["--view", "10,200"], InputError, "--view: 200 is not between -90 and 90"),
        (["--samples", "0"], InputError, "--samples: 0 is not from 1 to 256"),
        (["--out", "t.mp4"], InputError, "neither a PNG nor a JPEG"),
    ],
)
def test_wrong_words_are_refused(model, tmp_path, monkeypatch, arguments, error, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(error, match=message):
        _run(model, *arguments)
    assert not [path for path in tmp_path.iterdir() if path.suffix in (".png", ".mp4", ".jpeg")]


def test_a_bad_mesh_is_refused_by_name(tmp_path):
    path = tmp_path / "bad.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n")
    with pytest.raises(DataError, match=r"bad\.obj: .*names vertex 9"):
        _run(path, "--out", tmp_path / "x.png")


@pytest.mark.long
def test_a_million_faces_are_drawn(tmp_path):
    rows = 720
    u, v = np.mgrid[:rows, :rows] / rows
    waves = np.column_stack([u.ravel(), 0.1 * np.sin(9 * u * v).ravel(), v.ravel()])
    corner = (np.arange(rows - 1)[:, None] * rows + np.arange(rows - 1)).ravel()
    beside, above = corner + 1, corner + rows
    faces = np.column_stack([corner, beside, above, above + 1, above, beside]).reshape(-1, 3)
    assert len(faces) > 1_000_000
    path = tmp_path / "fine.ply"
    trimesh.Trimesh(waves, faces, process=False).export(path)
    _run(path, "--out", tmp_path / "x.png", "--resolution", "160x120")
    assert (_pixels(tmp_path / "x.png") != (228, 230, 233)).any(axis=2).mean() > 0.1


def test_a_file_that_cannot_be_written_is_named(model, tmp_path):
    (tmp_path / "taken").write_text("")
    with pytest.raises(DataError, match="taken"):
        _run(model, "--out", tmp_path / "taken" / "x.png")


# doctor


def _health(**changes):
    good = Probe("raycast", True, "processor")
    bad = Probe("pyrender", False, "OpenGL does not start")
    values = {
        "renderers": [vars(bad), vars(good)],
        "best": "raycast",
        "remedies": {"pyrender": "sudo apt-get install libegl1 libgl1"},
        "cores": 8,
        "usable_cores": 2,
        "cache": "12 functions kept in /somewhere",
        "python": "3.11",
        "numpy": "2.4",
        "numba": "0.68",
    }
    return {**values, **changes}


def test_doctor_tells_what_works_and_how_to_enable_the_rest(monkeypatch, capsys):
    monkeypatch.setattr("cadalign.cli.doctor.examine", _health)
    monkeypatch.setenv("COLUMNS", "160")
    assert Doctor().run() == 0
    text = capsys.readouterr().out
    assert "To enable pyrender: sudo apt-get install libegl1 libgl1" in text
    assert "--renderer auto takes: raycast" in text
    assert "OpenGL does not start" in text
    assert "of which this process may use 2" in text
    assert Doctor(json=True).run() == 0
    assert json.loads(capsys.readouterr().out)["renderers"][1]["detail"] == "processor"


def test_doctor_fails_where_not_even_ray_casting_works(monkeypatch, capsys):
    broken = Probe("raycast", False, "embreex is gone")
    monkeypatch.setattr("cadalign.cli.doctor.examine", lambda: _health(renderers=[vars(broken)]))
    assert Doctor().run() == 1


def test_the_state_of_the_cache_is_told(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    assert compiled_cache() == f"none yet; they will be kept in {kernel_folder()}"
    assert kernel_folder().parent == tmp_path / "cache"
    kernel_folder().mkdir(parents=True)
    (kernel_folder() / "one.nbi").write_text("")
    assert compiled_cache().startswith("1 functions kept")
    if hasattr(os, "getuid") and os.getuid():
        (tmp_path / "shut").mkdir(mode=0o500)
        monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "shut" / "cache"))
        assert "set NUMBA_CACHE_DIR" in compiled_cache()


def test_nothing_is_compiled_ahead_that_could_not_be_kept(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr("cadalign.compile.folder.can_write", lambda folder: False)
    fix = "set NUMBA_CACHE_DIR to a folder that can be"
    line = refusal_line(capsys, "doctor", "--compile")
    assert line == f"--compile: {kernel_folder()} cannot be written to; {fix}"


@pytest.mark.long
def test_doctor_runs_for_real(monkeypatch, capsys):
    monkeypatch.delitem(RENDERERS, "open3d")  # which takes seconds to load
    assert Doctor(json=True).run() == 0
    health = json.loads(capsys.readouterr().out)
    names = [renderer["name"] for renderer in health["renderers"]]
    assert names == ["pyrender", "raycast"]
    for renderer in health["renderers"]:
        assert renderer["detail"]


def test_textures_of_the_model_are_not_written_over(model, capsys) -> None:
    lines = [line for line in model.read_text().splitlines() if not line.startswith(("mtl", "use"))]
    faces = [line.split() for line in lines if line.startswith("f ")]
    corners = ["f " + " ".join(f"{word.split('/')[0]}/1" for word in face[1:]) for face in faces]
    vertices = [line for line in lines if line.startswith("v ")]
    words = ["mtllib paint.mtl", *vertices, "vt 0 0", "usemtl paint", *corners]
    model.write_text("\n".join(words) + "\n")
    model.with_name("paint.mtl").write_text("newmtl paint\nmap_Kd box.png\n")
    texture = model.with_name("box.png")
    Image.new("RGB", (4, 4), (200, 30, 30)).save(texture)
    before = texture.read_bytes()
    line = refusal_line(capsys, "render", model, "--out", texture, "--resolution", "32x24")
    assert line == f"{texture}: what is to be written is made from this file; give another name"
    assert texture.read_bytes() == before
