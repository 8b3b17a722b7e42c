"""Pages of runs over many observations: beside each other, by model."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, expect
from support.pages import Opened, embedded_payload, watched

from cadalign import Alignment, Camera, Observation, ShapeModel
from cadalign.batch import FitRunOptions, ObservationFit, run_many
from cadalign.io.images import read_photo, write_image
from cadalign.render import look_at
from cadalign.report import write_report

CAMERA = Camera(640, 480, 700.0, 700.0, 319.5, 239.5)
POINTS = np.random.default_rng(1).uniform(-1, 1, (8, 3))
SHAPENET = Path("/shapenet/03001627")


def observations(*, models: bool = False) -> Iterator[Observation]:
    rng = np.random.default_rng(0)
    for number in range(6):
        pose = Alignment(np.eye(3), [0.1 * number, 0.2, 6.0], [1, 1.2, 0.9])
        seen = CAMERA.project(pose.apply(POINTS)) + rng.normal(0, 1, (8, 2))
        model = SHAPENET / f"m{number % 2}" / "models" / "model_normalized.obj"
        yield Observation(
            POINTS, seen, CAMERA, model=model if models else None, image=Path(f"{number}.png")
        )


def fit(out: Path, seen: Iterable[Observation], **options: Any) -> None:
    """Do a run of observations; writes the observations as JSON lines beside it."""
    source = out.with_suffix(".jsonl")
    source.write_text("".join(json.dumps(each.to_dict()) + "\n" for each in seen))
    run_many(FitRunOptions(inputs=(source,), **options), out)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Runs of the same observations, with models and without."""
    folder = tmp_path_factory.mktemp("runs")
    fit(folder / "plain", observations())
    cauchy = ObservationFit(loss="cauchy")
    fit(folder / "cauchy", observations(models=True), estimate=cauchy)
    return {name: folder / name for name in ("plain", "cauchy")}


@pytest.fixture
def opened(browser: Browser) -> Iterator[Opened]:
    with watched(browser) as open_page:
        yield open_page


def test_runs_are_joined_by_observation_whatever_the_model(
    runs: dict[str, Path], tmp_path: Path
) -> None:
    page = write_report([runs["plain"], runs["cauchy"]], tmp_path / "r.html")
    instances = embedded_payload(page)["tables"]["instances"]
    assert instances["id"] == [*range(6), *range(6)]
    assert len(set(instances["category"])) == 2


def test_failed_fits_show_their_photos_and_keypoints(tmp_path: Path, opened: Opened) -> None:
    photo = tmp_path / "photo.png"
    write_image(photo, np.full((480, 640, 3), (40, 140, 90), dtype=np.uint8))
    good = replace(next(observations()), image=photo)
    line = replace(good, points_3d=POINTS[:1] * np.arange(1.0, 9.0)[:, None])
    fit(tmp_path / "run", [good, line], pictures=2)
    page = opened(write_report([tmp_path / "run"], tmp_path / "run" / "r.html").as_uri())
    failed = page.locator("figure, li, button", has_text="failed").locator("img").first
    expect(failed).to_be_visible()
    assert failed.evaluate("image => image.decode().then(() => image.naturalWidth)") > 100
    for kind in ("pictures", "thumbs"):
        shown = sorted((tmp_path / "run" / kind).glob("*.webp"))
        assert len(shown) == 2
        for each in shown:
            middle = read_photo(each)[5, 5].astype(int)
            assert np.abs(middle - (40, 140, 90)).max() < 12


@pytest.mark.long
def test_a_category_without_meshes_is_shown_as_its_skeleton(tmp_path: Path, opened: Opened) -> None:
    photo, mug = tmp_path / "photo.png", ShapeModel.pretrained("mug")
    write_image(photo, np.full((480, 640, 3), (40, 140, 90), dtype=np.uint8))
    points = mug.mean[: len(mug.ids)]
    turn = look_at(azimuth=35, elevation=30, distance=2)
    pixels = CAMERA.project(turn.apply(points))
    seen = Observation(points, pixels, CAMERA, names=mug.names, image=photo)
    replace(mug, lines=()).save(tmp_path / "plain.shape")
    thumbs = []
    for name, shape in (("run", "mug"), ("plain", str(tmp_path / "plain.shape"))):
        fit(tmp_path / name, [seen], pictures=1, estimate=ObservationFit(shape=Path(shape)))
        thumbs += [
            read_photo(each).astype(int) for each in (tmp_path / name / "thumbs").glob("*.webp")
        ]
    assert (np.abs(np.diff(thumbs, axis=0)[0]).max(axis=2) > 20).sum() > 200
    assert not list((tmp_path / "plain" / "previews").iterdir())
    page = opened(write_report([tmp_path / "run"], tmp_path / "run" / "r.html").as_uri())
    page.locator(".card").click()
    wire = page.locator(".overlay .wire.est")
    drawn = np.array(re.findall(r"-?[\d.]+", wire.get_attribute("d") or ""), dtype=float)
    ends = pixels[np.array(mug.lines)]
    either = np.concatenate([ends, ends[:, ::-1]]).reshape(-1, 4)
    gaps = np.abs(drawn.reshape(-1, 1, 4) - either).max(axis=2)
    assert sorted(gaps.argmin(axis=1) % len(ends)) == list(range(len(ends)))
    assert gaps.min(axis=1).max() < 3
    page.get_by_role("checkbox", name="keypoints").uncheck()
    expect(wire).to_have_count(0)
    expect(page.get_by_role("checkbox", name="wireframe")).to_have_count(0)
