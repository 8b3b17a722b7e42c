"""Scripts start, and the worked example agrees with its page."""

from __future__ import annotations

import importlib
import runpy
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from benchmarks import section
from benchmarks.evidence import SeenObject, align_with, draw_object, move
from benchmarks.section import BenchmarkData, Row, Tables

from cadalign.datasets import KeypointNet
from cadalign.errors import DegenerateError
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
    """Run a script in this process and return its exit code."""

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


def toy(given: BenchmarkData) -> Tables:
    cases = (({"place": place}, place) for place in ("near", "far", "far"))

    def refused(place: str) -> Row:
        raise DegenerateError(place)

    methods = {"fit": lambda place: {"error": len(place) / 4, "good": False}, "none": refused}
    yield "sizes", section.summaries(section.measure(cases, methods), "method", "place")
    given.folder("keypointnet")


class TestSections:
    """`bench.py` with a section of three cases and two methods; the second one always fails."""

    @pytest.fixture
    def bench(self, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
        monkeypatch.syspath_prepend(ROOT / "scripts")
        module = importlib.import_module("bench")
        monkeypatch.setattr(module, "SECTIONS", {"toy": toy})
        return lambda *options: module.main([*options, "--data", "None"])

    def test_cases_by_methods_are_a_table(
        self, bench: Callable[..., None], capsys: pytest.CaptureFixture[str]
    ) -> None:
        bench()
        printed = capsys.readouterr().out
        assert "| fit | near | 1 | 1 (1) | 0 |\n| fit | far | 2 | 0.75 (0.75) | 0 |" in printed
        assert "the rest of toy is skipped: give --data, or set CADALIGN_DATA" in printed

    @pytest.mark.parametrize(
        ("name", "message"),
        [
            ("toy", "toy: give --data, or set CADALIGN_DATA"),
            ("nothing", "unknown section nothing; known are toy"),
        ],
    )
    def test_a_named_section_must_run(
        self, name: str, message: str, bench: Callable[..., None]
    ) -> None:
        with pytest.raises(SystemExit, match=message):
            bench(name)


@pytest.fixture(scope="module")
def car(sample_root: Path) -> SeenObject:
    return draw_object(KeypointNet(sample_root)["car"][0], 0, noise=0.0, seed=0)


class TestEvidenceWithoutNoise:
    """The problems of `bench.py evidence`."""

    def test_shots_show_the_truth(self, car: SeenObject) -> None:
        points = np.asarray(car.model.points_3d)
        for view in car.views:
            motion = np.asarray(view.cam_from_rig)
            seen = move(car.instance.gt, motion).apply(points[np.asarray(view.ids)])
            np.testing.assert_allclose(KEYPOINT_CAMERA.project(seen), view.points_2d, atol=1e-8)
        rows, columns = np.nonzero(car.mask("exact"))
        pixels = np.asarray(car.views[0].points_2d)
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        assert (low >= [columns.min() - 3, rows.min() - 3]).all()
        assert (high <= [columns.max() + 3, rows.max() + 3]).all()

    @pytest.mark.parametrize(
        "kind",
        ["keypoints", "gravity", "length", "depth", "views-2", "views-2-free"],
    )
    def test_the_estimate_states_the_bound(self, car: SeenObject, kind: str) -> None:
        """Without noise the estimate is the truth, and the inverse information is the bound."""
        result = align_with(kind, car)
        assert rotation_error(est=result.alignment, gt=car.instance.gt) < 1e-3
        stated, bound = (
            np.sqrt(each.diagonal()) for each in (result.covariance, result.fisher_covariance)
        )
        np.testing.assert_allclose(bound, stated, rtol=0.2, atol=1e-9)
