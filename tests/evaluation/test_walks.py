"""What a change touches: a new experiment on photos, a new data set of photos, a new metric.

In the tree an experiment is its module in ``cadalign/evaluation/experiments`` and its line in
``registry.py``; a data set its module in ``datasets`` and its line in ``formats.py``, see
`test_written_photos`; a metric a line of a set in ``cadalign/evaluation/metrics``, or a function.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.photo_sets import write_pix3d

from cadalign.cli import main
from cadalign.evaluation import registry
from cadalign.evaluation.benchmark import Benchmark
from cadalign.evaluation.experiments import photos
from cadalign.evaluation.experiments.photos import PhotosOptions
from cadalign.evaluation.methods import MethodInput
from cadalign.evaluation.metrics import Metric
from cadalign.evaluation.metrics import photos as metrics
from cadalign.evaluation.metrics.photos import score_alignment, score_columns, statistics_of
from cadalign.evaluation.photos.objects import PhotoObjects
from cadalign.evaluation.photos.target import PhotoTask, Sighting, opened, photo_tasks
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.work import Plan
from cadalign.evaluation.summary import Group

# --- a new experiment on photos: this module, and its line in the table -------------------------


@dataclass(frozen=True)
class WrongClickOptions(PhotosOptions):
    """Evaluate methods on photos of which one keypoint was clicked at a wrong place."""

    experiment = "wrong-click"

    methods: tuple[str, ...] = ("optimal", "ransac-optimal")
    """Methods of `cadalign fit`, and functions of one's own."""
    click_px: float = 40.0
    """Distance of the wrong click from the keypoint, in pixels."""

    def __post_init__(self) -> None:
        self.check_methods()
        self.check_least(click_px=0)


@dataclass(frozen=True)
class WrongClicks(PhotoObjects):
    """Objects in photos, the first keypoint of which is moved."""

    def given(self, sighting: Sighting) -> MethodInput:
        found = super().given(sighting)
        assert isinstance(self.options, WrongClickOptions)
        moved = found.points_2d.copy()
        moved[0, 0] += self.options.click_px
        return replace(found, points_2d=moved)


def plan(options: WrongClickOptions, folder: RunFolder) -> Plan[PhotoTask]:
    dataset = opened(options.root)
    setting = WrongClicks(options, folder.made_for_pictures())
    tasks = photo_tasks(dataset, options.max_photos)
    benchmark = Benchmark.chosen(setting, options.methods, metrics=options.metrics)
    return benchmark.plan(options, tasks, chunk=4, kind=dataset.kind)


SPEC = replace(photos.SPEC, options=WrongClickOptions, plan=plan, topic="wrong clicks")


def test_a_new_experiment_on_photos_is_one_module_and_its_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(registry._EXPERIMENTS, "wrong-click", __name__)
    opened.cache_clear()
    root, out = write_pix3d(tmp_path / "data"), tmp_path / "run"
    command = ["evaluate", "wrong-click", root, "--out", out, "--workers", "0", "--pictures", "1"]
    assert main([*map(str, command)]) == 0
    assert "ransac-optimal" in capsys.readouterr().out
    cells = SPEC.open(out).cells
    errors = {
        method: np.median(cells["rotation_error_deg"][cells["method"] == method].astype(float))
        for method in ("optimal", "ransac-optimal")
    }
    assert errors["ransac-optimal"] < errors["optimal"]
    assert "Wrong clicks on data" in (out / "report.html").read_text()


# --- a new metric: a line of a set, in the module with its formula -------------------------------


def test_columns_scores_and_summaries_follow_from_the_line_of_a_metric() -> None:
    """A function of one's own is a metric, too: see `test_metrics`."""
    depth = Metric("depth_off", "depth error", "m")
    extended = replace(
        metrics.VIEWPOINT,
        measure=lambda target, est, gt, box: {depth.key: abs(float((est - gt).sum()))},
        medians=(*metrics.VIEWPOINT.medians, depth),
    )
    assert score_columns([extended])[-1] == (depth.key, float)
    target: Any = SimpleNamespace(gt=np.array([0.0, 0.0, 2.0]))
    ests: list[Any] = [target.gt + [0, 0, off] for off in (0.25, 0.5, 2.0)]
    box: Any = None
    rows = [score_alignment(target, [extended], est, box) for est in ests]
    cells = {depth.key: np.array([row[depth.key] for row in rows])}
    found = statistics_of([extended], cells | {metrics.ROTATION.key: np.full(3, np.nan)})
    assert found[depth.key](Group(cells, cells)) == 0.5
