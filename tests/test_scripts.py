"""The scripts start, and the worked example's files are what its page says."""

from __future__ import annotations

import importlib
import json
import runpy
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks.evidence import SeenObject, aligned, draw_object, moved

from cadalign.cli import main
from cadalign.datasets import KeypointNet
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA
from cadalign.metrics import rotation_error

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[1]
SCRIPTS = sorted(
    path
    for path in (ROOT / "scripts").glob("*.py")
    if "tyro.cli" in path.read_text() or "argparse" in path.read_text()
)


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    """Run a script in this process; gives its exit code."""

    def run_script(script: Path, *arguments: str) -> int:
        monkeypatch.setattr(sys, "argv", [str(script), *arguments])
        monkeypatch.syspath_prepend(script.parent)
        try:
            runpy.run_path(str(script), run_name="__main__")
        except SystemExit as stop:
            return int(stop.code or 0)
        return 0

    return run_script


@pytest.mark.long
@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_every_script_starts(
    script: Path, run: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(script, "--help") == 0
    shown = capsys.readouterr().out
    assert "usage: " in shown
    assert ("--quick" in shown) == (script.stem == "reproduce_paper")


@pytest.mark.long
def test_the_worked_photo_aligns_as_its_page_says(
    tmp_path: Path, run: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    files, script = tmp_path / "chairs", ROOT / "scripts" / "make_pictures.py"
    assert run(script, "chairs", "--files", str(files)) == 0
    assert (files / "other_chair.png").is_file()
    assert main(["fit", str(files / "photo.json"), "--out", str(tmp_path / "fit")]) == 0
    page = (ROOT / "docs" / "photo_to_glb.md").read_text(encoding="utf-8")
    printed = capsys.readouterr().out
    for line in page.partition("```text\n")[2].partition("```")[0].splitlines():
        assert line in printed


class TestComparingRatios:
    """`bench.py` with a section whose one ratio is 1.19."""

    @pytest.fixture
    def bench(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., int]:
        monkeypatch.syspath_prepend(ROOT / "scripts")
        module = importlib.import_module("bench")
        figure = importlib.import_module("benchmarks.section").figure

        def toy(given: Any) -> Iterator[tuple[str, list[dict[str, Any]]]]:
            yield "sizes", [{"points": 7, "R": (0.5, 1.25)}]
            yield "times", [figure("fit", 9.0, "us", 1.19)]

        monkeypatch.setattr(module, "SECTIONS", {"toy": toy})
        named = ["--stored", str(tmp_path / "stored.json"), "--out", str(tmp_path)]
        return lambda *options: int(module.main([*named, *options]))

    @pytest.mark.parametrize(("stored", "status"), [(1.0, 0), (0.98, 1)])
    def test_a_fifth_worse_than_stored_fails(
        self,
        stored: float,
        status: int,
        bench: Callable[..., int],
        tmp_path: Path,
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        (tmp_path / "stored.json").write_text(f'{{"fit": {stored}}}')
        assert bench() == status
        printed = capsys.readouterr().out
        assert ("more than 20% worse than stored: fit" in printed) == bool(status)
        assert "0.5 (1.25)" in printed
        assert json.loads((tmp_path / "toy.json").read_text())["times"][0]["ratio"] == 1.19

    def test_stored_ratios_are_compared_with_next_time(
        self, bench: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        (tmp_path / "stored.json").write_text('{"other": 2.0}')
        assert bench("--store") == 0
        assert json.loads((tmp_path / "stored.json").read_text()) == {"fit": 1.19, "other": 2.0}
        capsys.readouterr()
        bench()
        (line,) = (each for each in capsys.readouterr().out.splitlines() if " fit " in each)
        assert line.split(" | ")[-1] == "1.19 |"

    def test_an_unknown_section_is_refused(self, bench: Callable[..., int]) -> None:
        with pytest.raises(SystemExit, match="no section nothing; known are toy"):
            bench("nothing")


@pytest.fixture(scope="module")
def car(sample_root: Path) -> SeenObject:
    return draw_object(KeypointNet(sample_root)["car"][0], 0, noise=0.0, seed=0)


class TestEvidenceWithoutNoise:
    """The problems of `bench.py evidence`."""

    def test_shots_show_the_truth(self, car: SeenObject) -> None:
        points = np.asarray(car.model.points_3d)
        for shot in car.shots:
            seen = moved(car.instance.gt, shot.cam_from_first).apply(points[shot.rows])
            np.testing.assert_allclose(KEYPOINT_CAMERA.project(seen), shot.points_2d, atol=1e-8)
        rows, columns = np.nonzero(car.mask())
        low, high = car.shots[0].points_2d.min(axis=0), car.shots[0].points_2d.max(axis=0)
        assert (low >= [columns.min() - 3, rows.min() - 3]).all()
        assert (high <= [columns.max() + 3, rows.max() + 3]).all()

    @pytest.mark.parametrize(
        "kind",
        ["keypoints", "gravity", "length", "depth", "views-2", "views-2-free"],
    )
    def test_bound_is_that_of_the_estimate(self, car: SeenObject, kind: str) -> None:
        """The estimate is the truth, where the inverse of the information is the bound."""
        result = aligned(kind, car)
        assert rotation_error(est=result.alignment, gt=car.instance.gt) < 1e-3
        stated, bound = (
            np.sqrt(each.diagonal()) for each in (result.covariance, result.fisher_covariance)
        )
        np.testing.assert_allclose(bound, stated, rtol=0.2, atol=1e-9)
