"""The README's snippets run, and what it names exists."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from support.layers import layers

import cadalign
from cadalign.cli import main
from cadalign.cli.evaluate import FOUND, KEYPOINTS

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)


@pytest.mark.long
def test_snippets_run_in_an_empty_folder_and_find_the_stretch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (commands,) = [block for block in blocks("sh") if "cadalign demo" in block]
    for line in commands.splitlines():
        assert main(shlex.split(line, comments=True)[1:]) == 0, line
    (tmp_path / "chair.glb").unlink()  # the Python snippet's is another
    names: dict[str, Any] = {}
    for block in blocks("python"):
        exec(compile(block, "README.md", "exec"), names)
    result = names["result"]
    np.testing.assert_array_equal(names["model"], KEYPOINTS)
    np.testing.assert_array_equal(names["photo"], FOUND)
    same = cadalign.Result.load(tmp_path / "photo_fit" / "fit.json")
    np.testing.assert_allclose(same.alignment.vector, result.alignment.vector, atol=1e-9)
    photo = cv2.imread(str(tmp_path / "photo.jpg"))
    seat = photo[300, 320].astype(int) - photo[5, 5]
    assert np.abs(seat).max() > 50  # the chair is drawn where its keypoints are
    # The snippet's keypoints were made with the stretch (1, 1.3, 0.8).
    deviation = np.array(result.std.scale[1:])
    np.testing.assert_array_less(np.abs(result.alignment.scale[1:] / [1.3, 0.8] - 1), 4 * deviation)
    assert not result.warnings
    assert (tmp_path / "chair.glb").stat().st_size > 10_000


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
