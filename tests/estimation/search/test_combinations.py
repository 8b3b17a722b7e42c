"""`align` with all pairs of models, evidence, focal lengths, noise and outliers."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from support.combinations import Cell, all_pairs, has_covariance, model_of, problem_of

from cadalign import Alignment, Camera, View, align
from cadalign.estimation.result import Result
from cadalign.metrics import rotation_error

SIGMAS = 5.0
LARGEST_ROTATION_DEG = 12.0
LARGEST_LOG_FOCAL = 0.4


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cells")


@pytest.mark.parametrize("cell", all_pairs(), ids=str)
def test_all_pairs_align_within_their_own_deviations(cell: Cell, folder: Path) -> None:
    problem = problem_of(cell, folder)
    result = problem.align()
    for view, truth in zip(result.views, problem.truths, strict=True):
        error = rotation_error(est=view.alignment, gt=truth, symmetry=problem.symmetry)
        assert error < LARGEST_ROTATION_DEG
        assert (view.covariance is not None) == has_covariance(cell)
        if view.covariance is not None:
            assert_covers(cell, view.covariance, error, view.alignment, truth)
            log_focal = np.log(view.camera.fx / 500.0)
            assert abs(log_focal) < LARGEST_LOG_FOCAL
            if cell.focal != "known":
                assert abs(log_focal) < SIGMAS * np.sqrt(view.covariance[9, 9]) + 1e-3
    assert_told(result)
    if cell.outliers == "linear":
        assert not any(each.kind == "contradiction" for each in result.warnings)
        assert_drawn(result, folder)


def assert_covers(
    cell: Cell, covariance: np.ndarray, error: float, found: Alignment, truth: Alignment
) -> None:
    """The covariance is valid, and explains the errors of rotation and translation."""
    size = 9 if cell.focal == "known" else 10
    assert covariance.shape == (size, size)
    assert np.isfinite(covariance).all()
    assert np.linalg.eigvalsh(covariance)[0] > -1e-9
    variances = covariance.diagonal()
    assert error < SIGMAS * np.degrees(np.sqrt(variances[:3].sum())) + 0.05
    shift = np.linalg.norm(found.translation - truth.translation)
    assert shift < SIGMAS * np.sqrt(variances[3:6].sum()) + 0.002


def assert_told(result: Result) -> None:
    """The result is printed and stored, with its evidence."""
    text = json.dumps(result.to_dict())
    again = Result.from_dict(json.loads(text))
    assert json.dumps(again.to_dict()) == text
    assert str(again) == str(result)
    assert repr(result).startswith("Result(")
    assert again.evidence == result.evidence


def assert_drawn(result: Result, folder: Path) -> None:
    """The result is drawn in every view, and exported."""
    for view in range(len(result.views)):
        result.plot(view=view, axes=Figure().add_subplot())
    if getattr(result.model, "mesh", None) is not None:
        assert result.export(folder / "object.glb").stat().st_size > 0


@pytest.mark.parametrize("model", ["held", "similar", "learned", "mixture"])
def test_the_focal_length_of_a_far_flat_object_is_uncertain(model: str, folder: Path) -> None:
    problem = problem_of(Cell(model, "keypoints", "known", "number", "linear"), folder)
    rows = [0, 1, 2, 3, 8, 9, 10]
    camera = Camera(480, 360, 8000.0, 8000.0, 239.5, 179.5)
    far = Alignment(problem.truths[0].rotation, [0.0, 0.0, 60.0], np.ones(3))
    points = np.array(model_of("held", None).points_3d)[rows]
    pixels = camera.project(far.apply(points)) + np.random.default_rng(0).normal(size=(7, 2))
    view = View(Camera.from_size(480, 360), pixels, ids=rows)
    usual = align(model_of(model, None), view, focal="estimate")
    assert 0.3 < usual.std.focal < 0.7
    result = align(model_of(model, None), view, focal="estimate", focal_prior=None)
    assert result.std.focal > 0.5
    assert "focal length" in result.uncertain
