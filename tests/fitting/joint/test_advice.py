"""Next-best evidence: predicted deviations are those of estimates with the piece."""

from __future__ import annotations

import numpy as np
import pytest
from support.refusals import refusal_text
from support.scenes import CAMERA, around, keypoints, seen, truth_of

from cadalign import Alignment, Mesh, Model, Size, View, align
from cadalign.fitting.joint.advice import Advice, rank_evidence
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
