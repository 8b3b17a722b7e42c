"""Runs in other tools' formats: what is written is read back as it was estimated."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import cadalign
from cadalign import Alignment, Camera, Mesh, Observation
from cadalign.batch.exported import export_run
from cadalign.cli import main
from cadalign.errors import DataError, InputError
from cadalign.io.meshes.files import load_mesh, write_obj_mesh

CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
FACES = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
         [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]  # fmt: skip
CAMERA = Camera(640, 480, 700.0, 700.0, 319.5, 239.5)


def pose(turn: float) -> Alignment:
    upright = np.diag([1.0, -1.0, -1.0])
    c, s = np.cos(turn), np.sin(turn)
    about_y = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return Alignment(upright @ about_y, [-0.3, 0.3, 5.0], [1, 1.2, 0.8])


def box_in(photo: Path, number: int, model: Path) -> Observation:
    """A box in a photo, in a pose of its own."""
    pixels = CAMERA.project(pose(0.3 + 0.5 * number).apply(CORNERS))
    return Observation(CORNERS, pixels, CAMERA, image=photo, model=model)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run over three boxes in two photos, and an observation that fails."""
    folder = tmp_path_factory.mktemp("boxes")
    write_obj_mesh(folder / "box.obj", Mesh(CORNERS, FACES))
    for name in ("000004.png", "000007.png"):
        Image.new("RGB", (640, 480), (90, 120, 90)).save(folder / name)
    photos = [folder / name for name in ("000004.png", "000004.png", "000007.png")]
    seen = [box_in(photo, k, folder / "box.obj") for k, photo in enumerate(photos)]
    few = Observation(CORNERS[:2], seen[0].points_2d[:2], CAMERA)
    cadalign.fit_many([*seen, few], out=folder / "run")
    return folder / "run"


def test_glb_is_one_file_of_each(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["export", str(run), "--to", "glb"]) == 0
    assert sorted(path.name for path in Path("glb").iterdir()) == [
        "000000.glb",
        "000001.glb",
        "000002.glb",
    ]
    assert len(load_mesh(Path("glb/000001.glb")).faces) == len(FACES) + 2  # and the photo


def test_what_cannot_be_written_is_said(run: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="format: unknown format 'out'; known are glb, obj, ply"):
        export_run(run, tmp_path / "out")
    with pytest.raises(DataError, match="not the folder of a run of fits; give"):
        export_run(tmp_path, tmp_path / "glb")
    unfinished = shutil.copytree(run, tmp_path / "unfinished")
    (unfinished / "results.parquet").unlink()
    with pytest.raises(DataError, match="the run is not finished; start the command that made"):
        export_run(unfinished, tmp_path / "glb")


def test_meshes_of_a_run_are_not_written_over(run: Path, tmp_path: Path) -> None:
    mesh = tmp_path / "000001.obj"  # which the second one's file would be called
    shutil.copy(run.parent / "box.obj", mesh)
    seen = [box_in(run.parent / "000004.png", number, mesh) for number in range(2)]
    cadalign.fit_many(seen, out=tmp_path / "run")
    before = mesh.read_bytes()
    count, left_out = export_run(tmp_path / "run", tmp_path, format="obj")
    assert (count, mesh.read_bytes()) == (1, before)
    assert [error.where for error in left_out] == [str(mesh)]


def test_a_fit_holds_its_observation(run: Path, tmp_path: Path) -> None:
    pixels = CAMERA.project(pose(0.3).apply(CORNERS))
    path, out = tmp_path / "somewhere" / "seen.json", tmp_path / "elsewhere"
    path.parent.mkdir()
    Observation(CORNERS, pixels, CAMERA, model=run.parent / "box.obj").save(path)
    assert main(["fit", str(path), "--out", str(out), "--no-picture"]) == 0
    path.unlink()
    assert main(["export", str(out), "--to", str(tmp_path / "box.glb")]) == 0
    assert (tmp_path / "box.glb").is_file()
