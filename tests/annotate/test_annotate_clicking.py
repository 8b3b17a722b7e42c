"""Snapping, dragging on the model, and the loupe."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, Page
from support.annotating import IDLE, Case, opened_page, place_all, wait

from cadalign.annotate.actions import perform
from cadalign.annotate.model import ClickableModel
from cadalign.annotate.page_state import page_state
from cadalign.annotate.session import Session
from cadalign.errors import CadalignError
from cadalign.geometry.mesh import Mesh

pytestmark = pytest.mark.long


def cube() -> Mesh:
    """A cube about the origin with sides of 2, each of two triangles."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = [[a, b, c] for q in quads for a, b, c in ([q[0], q[1], q[2]], [q[0], q[2], q[3]])]
    return Mesh(corners, np.array(faces))


def sphere() -> Mesh:
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=4)
    return Mesh(np.asarray(ball.vertices), np.asarray(ball.faces))


# --- snapping ----------------------------------------------------------------------------------


def test_click_near_a_corner_snaps_to_it() -> None:
    model = ClickableModel(cube())
    eye = np.array([0.4, 0.3, 6.0])
    beside = np.array([0.97, 0.96, 1.0]) - eye
    plain = model.pick(eye, beside)
    snapped = model.pick(eye, beside, snap=0.02)
    assert plain is not None
    assert snapped is not None
    np.testing.assert_allclose(plain.xyz, [0.97, 0.96, 1.0], atol=1e-6)
    np.testing.assert_array_equal(snapped.xyz, [1, 1, 1])
    # Also from beside the model, but never to one that the model hides.
    missed = model.pick(eye, np.array([1.03, 1.02, 1.0]) - eye, snap=0.02)
    assert missed is not None
    np.testing.assert_array_equal(missed.xyz, [1, 1, 1])
    hidden = model.pick(np.array([0, 0, 6.0]), np.array([0.7, 0.7, -1.0]) - [0, 0, 6], snap=0.02)
    assert hidden is not None
    assert hidden.xyz[2] == pytest.approx(1)


@pytest.mark.parametrize("radius", [0.985, 1.015])
def test_click_near_the_silhouette_snaps_to_it(radius: float) -> None:
    model = ClickableModel(sphere())
    eye = np.array([0, 0, 50.0])
    direction = np.array([radius * np.cos(0.3), radius * np.sin(0.3), 0]) - eye
    snapped = model.pick(eye, direction, snap=0.001)
    assert snapped is not None
    x, y, _ = snapped.xyz
    assert np.hypot(x, y) == pytest.approx(1, abs=4e-3)
    assert np.arctan2(y, x) == pytest.approx(0.3, abs=0.15)


def aim(session: Session) -> dict[str, Any]:
    """A ray that hits the model away from its keypoints."""
    model = session.model.cad
    keypoints = np.array([point.xyz for _, point in session.model.registry])
    for target in model.scene.triangles.mean(axis=1):
        origin = target + [0, 0, -3 * model.diagonal]
        point = model.pick(origin, [0, 0, 1])
        if point and np.linalg.norm(keypoints - point.xyz, axis=1).min() > 0.05 * model.diagonal:
            return {"origin": model.to_display(origin).tolist(), "direction": [0, 0, 1]}
    raise AssertionError


def test_alignment_shows_where_a_model_point_is_expected(case: Case) -> None:
    session = case.open()
    place_all(session, case, count=6)
    keypoint, uv = case.clicks[6]
    perform(session, 0, {"do": "place_keypoint", "keypoint": keypoint})
    pair = page_state(session, 0)["pairs"][-1]
    assert pair["uv"] is None
    np.testing.assert_allclose(pair["expected"], uv, atol=12)


# --- model points are moved --------------------------------------------------------------------


def test_model_point_is_moved_and_refused_where_another_pair_is(case: Case) -> None:
    session = case.open()
    place_all(session, case, count=5)
    before = session.photos[0].document.pairs[0]
    perform(session, 0, {"do": "repick", "pair": 1, **aim(session)})
    moved = session.photos[0].document.pairs[0]
    assert moved.uv == before.uv
    assert moved.keypoint != before.keypoint
    perform(session, 0, {"do": "undo"})
    assert session.photos[0].document.pairs[0] == before
    missed = perform(
        session, 0, {"do": "repick", "pair": 1, "origin": [9, 9, 9], "direction": [1, 1, 1]}
    )
    assert "missed" in missed.message
    assert session.photos[0].document.pairs[0] == before
    document = session.photos[0].document
    with pytest.raises(CadalignError, match="already used by pair 1"):
        document.exchange_keypoint(2, before.keypoint or 0)


# --- in the page -------------------------------------------------------------------------------


@pytest.fixture
def opened(browser: Browser, case: Case) -> Iterator[tuple[Page, Session]]:
    session = case.open()
    with opened_page(browser, session) as page:
        yield page, session


def on_page(page: Page, xyz: np.ndarray) -> tuple[float, float]:
    at = page.evaluate("xyz => annotator.model.toPage(xyz)", xyz.tolist())
    return at["x"], at["y"]


def seen_corner(page: Page, session: Session) -> np.ndarray:
    """A corner of the model that is seen in the page, apart from the markers."""
    eye = session.model.cad.from_display(
        page.evaluate("annotator.model.stage.camera.position.toArray()")
    )
    points = session.model.cad.snap_points
    keypoints = np.array([point.xyz for _, point in session.model.registry])
    for xyz in points.xyz[points.kind == 0]:
        gap = np.linalg.norm(keypoints - xyz, axis=1).min()
        if gap > 0.1 * session.model.cad.diagonal and session.model.cad.is_seen(eye, xyz):
            return np.asarray(xyz)
    raise AssertionError


def test_key_held_snaps_and_points_are_dragged_on_the_model(
    opened: tuple[Page, Session], case: Case
) -> None:
    page, session = opened
    corner = seen_corner(page, session)
    x, y = on_page(page, session.model.cad.to_display(corner))
    page.keyboard.down("s")
    wait(page, "annotator.isSnapping")
    page.mouse.click(x + 3, y + 2)
    wait(page, "annotator.api.idle && annotator.state.pairs.length === 1")
    page.keyboard.up("s")
    wait(page, "!annotator.isSnapping")
    snapped = np.array(
        session.model.registry[session.photos[0].document.pairs[0].keypoint or 0].xyz
    )
    assert np.linalg.norm(snapped - corner) < 0.03 * session.model.cad.diagonal
    gaps = np.linalg.norm(session.model.cad.snap_points.xyz - snapped, axis=1)
    assert gaps.min() < 1e-9 * session.model.cad.diagonal

    # Dragged, the model stays where it is, and the point goes to the surface under the pointer.
    eye = "annotator.model.stage.camera.position.toArray()"
    before = page.evaluate(eye)
    x, y = on_page(page, session.model.cad.to_display(snapped))
    middle = page.evaluate(
        """() => { const { left, top, width, height } =
            annotator.model.stage.canvas.getBoundingClientRect();
            return [left + width / 2, top + height / 2]; }"""
    )
    page.mouse.move(x, y)
    page.mouse.down()
    target = np.array([x, y]) + 0.25 * (np.array(middle) - [x, y])
    page.mouse.move(*target.tolist(), steps=5)
    page.mouse.up()
    page.wait_for_timeout(300)
    wait(page, IDLE)
    moved = np.array(session.model.registry[session.photos[0].document.pairs[0].keypoint or 0].xyz)
    assert page.evaluate(eye) == pytest.approx(before)
    if np.linalg.norm(moved - snapped) > 0:
        assert on_page(page, session.model.cad.to_display(moved)) == pytest.approx(target, abs=2)
    else:
        assert "missed" in page.locator("[role=alert]").inner_text()
    page.mouse.move(*middle)
    page.mouse.down()
    page.mouse.move(middle[0] + 60, middle[1], steps=4)
    page.mouse.up()
    wait(page, f"Math.abs({eye}[0] - {before[0]}) > 1e-4")  # beside points it is turned as before


def test_loupe_magnifies_about_the_pointer(opened: tuple[Page, Session]) -> None:
    page, _ = opened
    page.keyboard.press("l")
    assert page.get_by_role("button", name="Loupe").get_attribute("aria-pressed") == "true"
    for name in ("Photo", "Model"):
        box = page.locator(f"section[aria-label={name}] canvas").bounding_box()
        assert box is not None
        page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        frame = page.locator(f"section[aria-label={name}] .loupe")
        frame.wait_for(state="visible")
    page.mouse.move(2, 2)
    page.locator(".loupe:visible").wait_for(state="hidden")
    page.keyboard.press("l")
    assert page.get_by_role("button", name="Loupe").get_attribute("aria-pressed") == "false"
