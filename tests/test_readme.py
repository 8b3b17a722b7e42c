"""The README's snippets run, and what it names exists."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import pytest
from support.layers import layers

import cadalign
from cadalign.cli import main
from cadalign.cli.example import CAMERA, SEEN, VIEW, build_chair
from cadalign.io.observation import Observation
from cadalign.metrics import rotation_error
from cadalign.render import pose_in_view

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)


@pytest.mark.long
def test_snippets_run_in_an_empty_folder_and_find_the_pose(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (commands,) = [block for block in blocks("sh") if "cadalign demo" in block]
    for line in commands.splitlines():
        assert main(shlex.split(line, comments=True)[1:]) == 0, line
    names: dict[str, Any] = {}
    for block in blocks("python"):
        exec(compile(block, "README.md", "exec"), names)
    result = names["result"]
    seen = Observation.load(tmp_path / "clicks.json")
    assert names["photo"] == dict(zip(seen.names, seen.points_2d.tolist(), strict=True))
    assert names["camera"] == seen.camera
    scene, _ = build_chair(SEEN)
    truth = pose_in_view(scene, CAMERA, VIEW)
    # The command's last fit is the CAD model's.
    stretched = cadalign.Result.load(tmp_path / "clicks_fit" / "fit.json")
    assert rotation_error(result.alignment, truth) < 2.5 * result.std.rotation_deg
    assert rotation_error(stretched.alignment, truth) < 6
    assert not result.warnings
    assert (tmp_path / "chair.glb").stat().st_size > 10_000


@pytest.mark.long
def test_the_worked_photo_aligns_as_its_page_says(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = (ROOT / "docs" / "photo_to_glb.md").read_text(encoding="utf-8")
    assert main(["demo", "--files", str(tmp_path)]) == 0
    assert main(["fit", str(tmp_path / "clicks.json"), "--similar"]) == 0
    printed = capsys.readouterr().out
    for line in page.partition("```text\n")[2].partition("```")[0].splitlines():
        assert line in printed
    assert main(["demo", "--files", str(tmp_path)]) == 1  # it replaces no file


def test_named_make_targets_exist() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in set(re.findall(r"make ([a-z]+)", README)):
        assert re.search(rf"^{target}:", makefile, flags=re.MULTILINE) or target == "nothing"


@pytest.mark.parametrize("name", ["CONTRIBUTING.md", "docs/architecture.md"])
def test_named_modules_exist(name: str) -> None:
    text = (ROOT / name).read_text(encoding="utf-8")
    for path in re.findall(r"`((?:[\w.]+/)+[\w.]*)`", text):
        assert any((folder / path).exists() for folder in (ROOT, ROOT / "cadalign")), path


def test_picture_of_the_architecture_shows_the_list_of_layers() -> None:
    picture = (ROOT / "docs" / "architecture.svg").read_text(encoding="utf-8")
    shown = re.findall(r'font-family="monospace">([a-z]+)<', picture)
    assert shown == layers()[::-1]


def test_named_python_objects_exist() -> None:
    for name in set(re.findall(r"`cadalign\.([a-z_]+)`", README)):
        assert hasattr(cadalign, name) or __import__(f"cadalign.{name}")
