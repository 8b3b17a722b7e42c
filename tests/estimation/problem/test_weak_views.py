"""Views of unknown motion with few keypoints: supported by other views, or left out."""

from __future__ import annotations

import numpy as np
import pytest
from support.scenes import CAMERA, around, in_camera, keypoints, seen, truth_of

from cadalign import Alignment, Model, Result, ShapeModel, View, align
from cadalign.errors import DegenerateError
from cadalign.estimation import EstimateWarning
from cadalign.metrics import rotation_error

POINTS = keypoints()
TRUTH = truth_of((1.0, 0.7, 1.5))
MODEL = Model(points_3d=POINTS)


def view_at(angle: float, rows: list[int], points: np.ndarray = POINTS, **options: object) -> View:
    rng = np.random.default_rng(int(angle) + 100)
    return seen(points[rows], TRUTH, around(angle), rng, ids=rows, **options)


def truth_at(angle: float) -> Alignment:
    motion = around(angle)
    shift = motion[:3, :3] @ TRUTH.translation + motion[:3, 3]
    return Alignment(motion[:3, :3] @ TRUTH.rotation, shift, TRUTH.scale)


@pytest.mark.parametrize("rows", [[1, 2, 3], [4, 6, 8], [0, 2, 5, 9]])
def test_three_keypoints_of_a_view_suffice_beside_others(rows: list[int]) -> None:
    views = [view_at(0, list(range(8))), view_at(30, list(range(2, 10))), view_at(-25, rows)]
    result = align(MODEL, views)
    assert result.warnings == ()
    assert rotation_error(est=result.alignment, gt=TRUTH) < 1.5
    assert np.abs(result.residuals[2]).max() < 3  # of several poses that explain three keypoints
    assert result.inliers[2].all()


@pytest.mark.parametrize("count", [1, 2])
def test_a_view_that_determines_no_pose_is_left_out_and_named(count: int) -> None:
    views = [view_at(0, list(range(8))), view_at(30, list(range(8)))]
    expected = align(MODEL, views)
    weak = view_at(-25, list(range(count)), up=TRUTH.rotation[:, 1])
    result = align(MODEL, [views[0], weak, views[1]])
    plural = f"views[1] is left out: its {count} keypoints do not determine its pose"
    assert result.warnings == (*expected.warnings, EstimateWarning("left-out", plural, view=1))
    assert result.alignment == expected.alignment
    assert result.poses[2] == expected.poses[1]
    assert not result.views[1].inliers.any()
    assert [each.view for each in result.evidence] == [0, 2]
    written = Result.from_dict(result.to_dict())
    assert written.cameras == tuple(view.camera for view in (views[0], weak, views[1]))
    assert [len(view.points_2d) for view in result.views] == [8, count, 8]


def test_keypoints_on_a_line_determine_no_pose() -> None:
    points = POINTS.copy()
    points[:4] = points[0] + np.linspace(0, 1, 4)[:, None] * (points[1] - points[0])
    model = Model(points_3d=points)
    rows = list(range(10))
    views = [view_at(a, rows, points) for a in (0, 30)]
    result = align(model, [*views, view_at(-25, [0, 1, 2, 3], points)])
    (told,) = (each for each in result.warnings if each.kind == "left-out")
    assert told.text.startswith("views[2] is left out: its 4 keypoints")
    assert result.alignment == align(model, views).alignment


def test_a_learned_shape_leaves_a_view_out_as_well() -> None:
    rng = np.random.default_rng(0)
    shape = ShapeModel.from_basis(POINTS, rng.normal(size=(2, 10, 3)), [0.02, 0.02])
    rows = list(range(8))
    pixels = [CAMERA.project(in_camera(POINTS, truth_of((1, 1, 1)), around(a))) for a in (0, 30)]
    views = [View(CAMERA, each[rows], ids=rows) for each in pixels]
    weak = View(CAMERA, pixels[0][:2], ids=[0, 1])
    result = align(shape, [*views, weak])
    assert any(each.kind == "left-out" for each in result.warnings)


def test_the_first_view_must_determine_its_pose() -> None:
    views = [view_at(-25, [0, 1]), view_at(0, list(range(8)))]
    with pytest.raises(DegenerateError, match="keypoints do not determine its pose") as caught:
        align(MODEL, views)
    assert str(caught.value).startswith("views[0]: ")
    started = align(MODEL, views, init=truth_at(-25))
    assert len(started.poses) == 2


@pytest.mark.parametrize("seed", range(5))
def test_rounding_does_not_decide_on_a_started_view(seed: int) -> None:
    rng = np.random.default_rng(seed)
    moved = [
        View(CAMERA, view.points_2d + rng.normal(0, 1e-12, np.shape(view.points_2d)), ids=view.ids)
        for view in (view_at(-25, [0, 1]), view_at(0, list(range(8))))
    ]
    assert len(align(MODEL, moved, init=truth_at(-25)).poses) == 2
