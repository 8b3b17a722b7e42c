"""`cadalign demo`: its files, its pictures, and models that cannot be used."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from support.pages import embedded_payload

from cadalign.cli import main
from cadalign.datasets import KeypointNet

pytestmark = pytest.mark.long

CATEGORIES = ["bottle", "car", "chair", "vessel"]
NUMBERS = ["rotation_error_deg", "translation_error", "scale_y_error", "scale_z_error", "box_iou"]
RED, GREEN = 0, 1


def run(root: Path, out: Path, *options: str) -> int:
    return main(["demo", "--root", str(root), "--out", str(out), "--per-category", "1", *options])


def rows_of(out: Path) -> list[dict[str, Any]]:
    return pq.read_table(out / "results.parquet").to_pylist()


def picture_of(out: Path, row: dict[str, str]) -> Path:
    return out / "thumbs" / f"{row['category']}_{row['model_id']}.webp"


def count_color(path: Path, channel: int) -> int:
    """Count the pixels in which one channel of RGB dominates."""
    picture = cv2.imread(str(path))
    assert picture is not None
    rgb = picture[..., ::-1].astype(int)
    others = np.delete(rgb, channel, axis=2).max(axis=2)
    return int((rgb[..., channel] - others > 50).sum())


@pytest.fixture(scope="module")
def out(sample_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output of a demo on one model of every category."""
    folder = tmp_path_factory.mktemp("demo") / "out"
    assert run(sample_root, folder) == 0
    return folder


def test_there_is_a_row_for_every_model(out: Path) -> None:
    rows = rows_of(out)
    assert [row["category"] for row in rows] == CATEGORIES
    assert len({row["model_id"] for row in rows}) == 4
    assert {row["status"] for row in rows} == {"ok"}
    assert {row["reason"] for row in rows} == {""}
    for row in rows:
        assert int(row["keypoints"]) >= 6
        numbers = [float(row[name]) for name in NUMBERS]
        assert np.isfinite(numbers).all()
        assert min(numbers) >= 0
    assert np.median([float(row["box_iou"]) for row in rows]) > 0.7


def test_every_thumb_shows_boxes_over_a_rendered_model(out: Path) -> None:
    rows = rows_of(out)
    assert sorted(path.name for path in (out / "thumbs").iterdir()) == sorted(
        picture_of(out, row).name for row in rows
    )
    for row in rows:
        picture = picture_of(out, row)
        # Where they agree to a pixel, one box hides the other.
        assert count_color(picture, GREEN) + count_color(picture, RED) > 300
        pixels = cv2.imread(str(picture))
        assert pixels.shape == (240, 320, 3)
        shades = len(np.unique(pixels.astype(int) @ [1, 256, 65536]))
        assert shades > 500  # a shaded object, not lines over one colour
    for color in (GREEN, RED):
        assert max(count_color(picture_of(out, row), color) for row in rows) > 300


def test_page_holds_every_instance_with_its_picture_and_model(out: Path) -> None:
    payload = embedded_payload(out / "index.html")
    instances = payload["tables"]["instances"]
    assert [payload["tables"]["strings"][k] for k in instances["category"]] == CATEGORIES
    assert {row["category"] for row in payload["headline"]["rows"]} == {*CATEGORIES, "all"}
    for key, thumb in zip(instances["exhibit"], instances["thumb"], strict=True):
        exhibit = payload["exhibits"][str(key)]
        assert payload["pictures"][exhibit["picture"]].startswith("data:image/webp;base64,")
        assert payload["thumbs"][str(thumb)].startswith("data:image/webp;base64,")
        assert payload["meshes"][exhibit["mesh"]]["faces"]


def test_demo_can_be_reported_on_like_a_run(
    out: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["report", str(out), "--out", str(tmp_path / "page.html")]) == 0
    assert (tmp_path / "page.html").stat().st_size > 1e6
    rows = embedded_payload(tmp_path / "page.html")["headline"]["rows"]
    ours = [row["category"] for row in rows if row["method"] == "optimal"]
    assert ours == ["all", *CATEGORIES]


def test_table_goes_to_standard_output(
    sample_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(sample_root, tmp_path / "out", "--categories", "car") == 0
    captured = capsys.readouterr()
    assert "Medians and rates by category" in captured.out
    assert "car" in captured.out
    assert "chair" not in captured.out
    assert "index.html" in captured.err
    assert [row["category"] for row in rows_of(tmp_path / "out")] == ["car"]


def test_without_a_root_the_sample_data_set_is_made(tmp_path: Path) -> None:
    options = ["--out", str(tmp_path), "--per-category", "1", "--categories", "bottle"]
    assert main(["demo", *options]) == 0
    model, shape = rows_of(tmp_path)
    assert [model["category"], shape["category"]] == ["bottle", "bottle, learned shape"]
    assert model["status"] == shape["status"] == "ok"
    assert float(shape["sym_rotation_error_deg"]) < 5
    assert picture_of(tmp_path, shape).with_stem(f"{picture_of(tmp_path, shape).stem}_1").exists()
    made = KeypointNet(tmp_path / "sample_dataset")
    assert {category: len(made.ids(category)) for category in made.categories} == dict.fromkeys(
        CATEGORIES, 12
    )
    assert main(["demo", *options]) == 0  # a second time beside the first


# --- bad instances ---------------------------------------------------------------------------


@pytest.fixture
def root(sample_root: Path, tmp_path: Path) -> Path:
    """A copy of the sample data set, to damage."""
    return Path(shutil.copytree(sample_root, tmp_path / "spoilt"))


def mesh_path(root: Path, category: str) -> Path:
    dataset = KeypointNet(root)
    path = dataset[dataset.ids(category)[0]].mesh_path
    assert path is not None
    return path


def cut_short(root: Path, category: str) -> None:
    path = mesh_path(root, category)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def displaced(root: Path, category: str) -> None:
    path = root / "annotations" / f"{category}.json"
    entries = json.loads(path.read_text())
    for keypoint in entries[0]["keypoints"]:
        keypoint["xyz"][1] = 0.9
    path.write_text(json.dumps(entries))


def too_few_keypoints(root: Path, category: str) -> None:
    path = root / "annotations" / f"{category}.json"
    entries = json.loads(path.read_text())
    entries[0]["keypoints"] = entries[0]["keypoints"][:3]
    entries[0]["symmetries"] = {"reflection": [], "rotation": []}
    path.write_text(json.dumps(entries))


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (cut_short, r"\.ply: "),
        (displaced, r"keypoints\[\d+\] lies .* from the point that its face and barycentric"),
        (too_few_keypoints, r"keypoints"),
    ],
)
def test_bad_instance_becomes_a_failed_row_and_the_rest_goes_on(
    root: Path, tmp_path: Path, spoil: Callable[[Path, str], None], reason: str
) -> None:
    spoil(root, "car")
    out = tmp_path / "out"
    assert run(root, out, "--categories", "bottle", "car", "chair") == 0
    bottle, car, chair = rows_of(out)
    assert bottle["status"] == chair["status"] == "ok"
    assert car["category"] == "car"
    assert car["status"] == ("skipped" if spoil is too_few_keypoints else "failed")
    assert re.search(reason, car["reason"])
    assert "\n" not in car["reason"]
    assert "Error(" not in car["reason"]  # words of cadalign's own, not a bare exception
    assert [car[name] for name in NUMBERS] == [None] * 5
    assert [picture_of(out, row).exists() for row in (bottle, car)] == [True, False]
    page = embedded_payload(out / "index.html")
    skipped = [each["reason"] for each in page["headline"]["skipped"]]
    assert skipped == ([car["reason"]] if spoil is too_few_keypoints else [])
    assert len(page["pictures"]) == len(page["thumbs"]) == 2


def test_exit_code_is_1_where_every_instance_fails(root: Path, tmp_path: Path) -> None:
    cut_short(root, "car")
    assert run(root, tmp_path / "out", "--categories", "car") == 1
    assert [row["status"] for row in rows_of(tmp_path / "out")] == ["failed"]


# --- refusals --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--per-category", "0"], "--per-category: 0 is less than 1"),
        (
            ["--root", "/nowhere/at/all"],
            "/nowhere/at/all: no such folder; give KeypointNet's root",
        ),
    ],
)
def test_wrong_options_are_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], text: str
) -> None:
    assert main(["demo", "--out", str(tmp_path / "out"), *options]) == 1
    captured = capsys.readouterr()
    assert captured.err == f"cadalign: {text}\n"
    assert captured.out == ""
