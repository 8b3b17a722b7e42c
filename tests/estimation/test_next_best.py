"""Next-best evidence: predicted deviations are those of estimates with the piece."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from support.refusals import refusal_text
from support.scenes import CAMERA, around, in_camera, keypoints, rig, seen, truth_of

from cadalign import Alignment, Mesh, Model, ShapeModel, Size, View, align
from cadalign.estimation.uncertainty.next_best import Advice, rank_evidence
from cadalign.render import Scene, cast_geometry

POINTS = keypoints(8)
TRUTH = truth_of((1.0, 0.7, 1.5))
VIEW = View(CAMERA, seen(POINTS, TRUTH, np.eye(4)).points_2d[:6], ids=range(6), sigma=1.5)
MODEL = Model(points_3d=POINTS)


def one(found: tuple[Advice, ...], kind: str) -> Advice:
    return next(each for each in found if each.kind == kind)


def test_the_most_useful_comes_first() -> None:
    found = rank_evidence(MODEL, VIEW, TRUTH, candidates=[6, 7])
    assert sorted(each.kind for each in found) == ["keypoint", "keypoint", "lengths", "view"]
    worst = [each.worst for each in found]
    assert worst == sorted(worst)


def test_prediction_for_a_keypoint_is_what_marking_it_gives() -> None:
    predicted = one(rank_evidence(MODEL, VIEW, TRUTH, candidates=[7]), "keypoint")
    rows = [*range(6), 7]
    view = View(CAMERA, seen(POINTS, TRUTH, np.eye(4)).points_2d[rows], ids=rows, sigma=1.5)
    std = align(MODEL, view).std
    assert predicted.detail == 7
    assert predicted.rotation_deg == pytest.approx(std.rotation_deg, rel=1e-3)
    assert predicted.stretch == pytest.approx(std.scale, rel=1e-3)
    distance = np.linalg.norm(TRUTH.translation)
    assert predicted.position == pytest.approx(np.linalg.norm(std.translation) / distance, rel=1e-3)


def test_prediction_for_a_view_is_what_it_gives() -> None:
    predicted = one(rank_evidence(MODEL, VIEW, TRUTH), "view")
    centre = TRUTH.apply(np.asarray(MODEL.bounds).mean(axis=0)[None])[0]
    turn = around(25.0)[:3, :3]
    moved = Alignment(
        turn @ TRUTH.rotation, centre + turn @ (TRUTH.translation - centre), TRUTH.scale
    )
    other = View(CAMERA, CAMERA.project(moved.apply(POINTS[:6])), ids=range(6), sigma=1.5)
    std = align(MODEL, [VIEW, other]).std
    assert predicted.rotation_deg == pytest.approx(std.rotation_deg, rel=1e-3)
    assert predicted.stretch == pytest.approx(std.scale, rel=1e-3)


def test_lengths_leave_their_ratio_known() -> None:
    found = one(rank_evidence(MODEL, VIEW, TRUTH), "lengths")
    axis = 1 if found.detail == "width and height" else 2
    assert found.stretch[0] == 0
    assert found.stretch[axis] <= 0.01 * np.sqrt(2) * 1.001
    lengths = np.ptp(np.asarray(MODEL.bounds), axis=0) * TRUTH.scale
    name = "height" if axis == 1 else "length"
    size = Size(width=lengths[0], **{name: lengths[axis]})
    std = align(MODEL, VIEW, size=size).std
    assert found.rotation_deg == pytest.approx(std.rotation_deg, rel=1e-3)


def learned() -> ShapeModel:
    modes = np.random.default_rng(3).normal(size=(2, 8, 3))
    return ShapeModel.from_basis(POINTS, modes, [0.02, 0.02], residual_sigma=2e-3, up_axis="y")


@pytest.mark.parametrize("kind", ["learned", "similar"])
def test_what_is_known_of_a_shape_counts(kind: str) -> None:
    model = learned() if kind == "learned" else Model(points_3d=POINTS, shape_sigma=0.01)
    truth = truth_of((1.0, 1.0, 1.0))
    pixels = seen(POINTS, truth, np.eye(4)).points_2d
    view = View(CAMERA, pixels[:6], ids=range(6), sigma=1.5)
    found = rank_evidence(model, view, align(model, view), candidates=[7])
    rows = [*range(6), 7]
    marked = align(model, View(CAMERA, pixels[rows], ids=rows, sigma=1.5)).std
    predicted = one(found, "keypoint")
    assert predicted.rotation_deg == pytest.approx(marked.rotation_deg, rel=0.05)
    relative = np.array(predicted.stretch)[1:]
    if kind == "similar":
        assert relative == pytest.approx(np.array(marked.scale)[1:], rel=0.05)
    lengths = one(found, "lengths")
    assert min(lengths.stretch[1:]) < 0.0145
    other = View(CAMERA, CAMERA.project(truth.apply(POINTS)), ids=range(8), sigma=1.5)
    assert one(found, "view").rotation_deg < align(model, view).std.rotation_deg
    assert align(model, [view, other]).std.rotation_deg < align(model, view).std.rotation_deg


class TestSeveralViews:
    def test_a_keypoint_is_ranked_in_every_view_that_lacks_it(self) -> None:
        angles = [0, 30]
        views = [
            View(CAMERA, each.points_2d[:count], ids=range(count), cam_from_rig=each.cam_from_rig)
            for each, count in zip(rig(POINTS, TRUTH, angles), (6, 7), strict=True)
        ]
        found = rank_evidence(MODEL, views, align(MODEL, views), candidates=[6, 7])
        marked = {(each.detail, each.view): each for each in found if each.kind == "keypoint"}
        assert set(marked) == {(6, 0), (7, 0), (7, 1)}
        more = list(views)
        rows = [*range(6), 7]
        pixels = rig(POINTS, TRUTH, angles)[0].points_2d[rows]
        more[0] = View(CAMERA, pixels, ids=rows, cam_from_rig=np.eye(4))
        std = align(MODEL, more).std
        assert marked[7, 0].rotation_deg == pytest.approx(std.rotation_deg, rel=1e-3)

    def test_an_alignment_suffices_for_a_rig(self) -> None:
        views = rig(POINTS, TRUTH, [10, 40])
        first = align(MODEL, views)
        whole = rank_evidence(MODEL, views, first)
        of_pose = rank_evidence(MODEL, views, first.alignment)
        assert [each.kind for each in whole] == [each.kind for each in of_pose]
        for ours, theirs in zip(whole, of_pose, strict=True):
            assert ours.rotation_deg == pytest.approx(theirs.rotation_deg, rel=1e-6)

    def test_a_third_view_of_unknown_motion(self) -> None:
        views = [seen(POINTS, TRUTH, around(angle)) for angle in (0, 30)]
        result = align(MODEL, views)
        predicted = one(rank_evidence(MODEL, views, result), "view")
        stds = []
        for angle in (25, -25):
            centre = TRUTH.apply(np.asarray(MODEL.bounds).mean(axis=0)[None])[0]
            turn = around(angle)[:3, :3]
            moved = Alignment(
                turn @ TRUTH.rotation, centre + turn @ (TRUTH.translation - centre), TRUTH.scale
            )
            third = View(CAMERA, CAMERA.project(moved.apply(POINTS)))
            stds.append(align(MODEL, [*views, third]).std)
        assert any(
            predicted.rotation_deg == pytest.approx(std.rotation_deg, rel=1e-3) for std in stds
        )

    def test_what_else_the_views_tell_counts(self) -> None:
        depth = in_camera(POINTS, TRUTH, np.eye(4))[:6, 2]
        told = {"depth": depth, "up": TRUTH.rotation[:, 1], "ids": range(6)}
        view = View(CAMERA, VIEW.points_2d, **told)
        size = Size(height=np.ptp(POINTS[:, 1]) * TRUTH.scale[1])
        result = align(MODEL, view, size=size)
        found = rank_evidence(MODEL, view, result, candidates=[7], size=size)
        rows = [*range(6), 7]
        pixels = seen(POINTS, TRUTH, np.eye(4)).points_2d[rows]
        marked = View(CAMERA, pixels, depth=[*depth, np.nan], up=told["up"], ids=rows)
        std = align(MODEL, marked, size=size).std
        assert one(found, "keypoint").rotation_deg == pytest.approx(std.rotation_deg, rel=1e-3)
        assert "height" not in str(one(found, "lengths").detail)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: rank_evidence(learned(), VIEW, TRUTH),
            "estimate: an alignment does not tell the shape; give the Result of `align`",
        ),
        (
            lambda: rank_evidence(MODEL, [VIEW, VIEW], TRUTH),
            "estimate: an alignment does not tell the poses of the other views; "
            "give the Result of `align`",
        ),
        (
            lambda: rank_evidence(MODEL, [VIEW, VIEW], align(MODEL, VIEW)),
            "views: the estimate is from 1 views, given are 2; give the views that it is from",
        ),
        (lambda: rank_evidence(MODEL, [], TRUTH), "views: none is given"),
        (
            lambda: rank_evidence(MODEL, VIEW, TRUTH.rotation),  # type: ignore[arg-type]
            "estimate: expected an Alignment or a Result, got ndarray",
        ),
        (
            lambda: rank_evidence(MODEL, VIEW, TRUTH, candidates=[0]),
            "candidates: every view has the keypoint 0; give those that a view lacks",
        ),
        (
            lambda: rank_evidence(
                learned(), VIEW, align(learned(), VIEW), mask=np.eye(480, 640, dtype=bool)
            ),
            "views[0].mask: the effect of a mask is predicted for an exact model only; "
            "leave it away, or give a Model without `shape_sigma`",
        ),
    ],
)
def test_what_is_unsupported_is_named(call: Callable[[], object], message: str) -> None:
    assert refusal_text(call) == message


def test_mask_is_predicted_where_it_is_given() -> None:
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float) - 0.5
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))]
    mesh = Mesh(corners, faces)
    model = Model(points_3d=corners, mesh=mesh)
    view = View(CAMERA, CAMERA.project(TRUTH.apply(corners[:6])), ids=range(6))
    mask = cast_geometry(Scene(mesh), CAMERA, TRUTH).mask
    found = rank_evidence(model, view, TRUTH, candidates=[6, 7], mask=mask)
    assert found[0].kind == "mask"
    assert found[0].worst < 0.7 * one(found, "keypoint").worst


def test_unknown_candidate_is_refused() -> None:
    text = refusal_text(lambda: rank_evidence(MODEL, VIEW, TRUTH, candidates=[99]))
    assert text.startswith("candidates: ")
