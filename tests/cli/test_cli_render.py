"""`cadalign render` and `cadalign doctor`: output and errors."""

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

from cadalign.cli.doctor import Doctor, describe_cache
from cadalign.cli.render import Render
from cadalign.compile.folder import kernel_folder
from cadalign.errors import DataError, InputError, RenderError
from cadalign.render.probe import REMEDIES, Probe


@pytest.fixture
def model(tmp_path) -> Path:
    path = tmp_path / "parts" / "box.obj"
    path.parent.mkdir()
    trimesh.creation.box((0.4, 0.8, 0.6)).export(path)
    return path


def _run(model, *arguments):
    """Run the command as the command line does."""
    return tyro.cli(Render, args=[str(model), *map(str, arguments)]).run()


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
    _run(model, "--out", tmp_path / "s.jpg", "--resolution", "80x60", "--view", *views)
    assert (tmp_path / "s.jpg").read_bytes()[:2] == b"\xff\xd8"
    height, width = _pixels(tmp_path / "s.jpg").shape[:2]
    assert width > 160
    assert height > 60 * (1 if len(views) == 2 else 2)


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
        (["--resolution", "0x0"], InputError, "'0x0' is not a resolution"),
        (["--resolution", "640"], InputError, "give WIDTHxHEIGHT"),
        (["--resolution", "20000x20000"], RenderError, "the limits are 16384 px a side"),
        (["--view", "sideways"], InputError, "is not a view"),
        (["--out", "picture.jpeg"], InputError, "neither a PNG nor a JPEG"),
        (["--fov", "180"], InputError, "--fov: 180.0 is not between 0 and 180"),
        (["--view", "10,200"], InputError, "--view: 200 is not between -90 and 90"),
    ],
)
def test_wrong_words_are_refused(model, tmp_path, monkeypatch, arguments, error, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(error, match=message):
        _run(model, *arguments)
    assert not [path for path in tmp_path.iterdir() if path.suffix in (".png", ".mp4", ".jpeg")]


def test_a_file_that_cannot_be_written_is_named(model, tmp_path):
    (tmp_path / "taken").write_text("")
    with pytest.raises(DataError, match="taken"):
        _run(model, "--out", tmp_path / "taken" / "x.png")


# doctor


def test_doctor_shows_what_works_and_how_to_enable_the_rest(monkeypatch, capsys):
    good, bad = Probe("raycast", True, "processor"), Probe("pyrender", False, "no OpenGL")
    for probed, code in (([bad, good], 0), ([Probe("raycast", False, "embreex is gone")], 1)):
        monkeypatch.setattr("cadalign.cli.doctor.probe_renderers", lambda found=probed: found)
        assert Doctor().run() == code
        text = capsys.readouterr().out
    assert "raycast   fails: embreex is gone\n" in text
    assert f"To enable raycast: {REMEDIES['raycast']}\n" in text
    assert "Compiled solvers: " in text


def test_the_state_of_the_cache_is_shown(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    assert describe_cache() == f"none yet; they will be kept in {kernel_folder()}"
    assert kernel_folder().parent == tmp_path / "cache"
    kernel_folder().mkdir(parents=True)
    (kernel_folder() / "one.nbc").write_text("")
    assert describe_cache().startswith("1 functions kept")
    if hasattr(os, "getuid") and os.getuid():
        (tmp_path / "shut").mkdir(mode=0o500)
        monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "shut" / "cache"))
        assert "set NUMBA_CACHE_DIR" in describe_cache()


def test_nothing_is_compiled_ahead_that_could_not_be_kept(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr("cadalign.cli.doctor.can_write", lambda folder: False)
    fix = "set NUMBA_CACHE_DIR to a writable folder"
    line = refusal_line(capsys, "doctor", "--compile")
    assert line == f"--compile: {kernel_folder()} cannot be written to; {fix}"


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
    assert line == f"{texture}: this file is an input and would be overwritten; give another name"
    assert texture.read_bytes() == before
