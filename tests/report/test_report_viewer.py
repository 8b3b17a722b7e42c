"""The report's dialog in a browser: overlays, numbers, keys, and the 3D view."""

from __future__ import annotations

import base64
import io
import itertools
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Locator, expect
from support.pages import Opened, Shown, card_names, open_first
from support.reports import METHODS, WARNING, Recipe, listed, payload_of, write_page

from cadalign import Alignment
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA

pytestmark = pytest.mark.slow

NO_WEBGL = """
const real = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
    return kind.startsWith("webgl") ? null : real.call(this, kind, ...rest);
};
"""


def look(canvas: Locator) -> np.ndarray:
    """Pixels of the canvas, (n, 4) uint8, after the next frame."""
    canvas.evaluate(
        "() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
    )
    address = canvas.evaluate("(canvas) => canvas.toDataURL()")
    data = base64.b64decode(address.split(",")[1])
    return np.array(Image.open(io.BytesIO(data)), dtype=np.int16).reshape(-1, 4)


def changed(before: np.ndarray, after: np.ndarray) -> float:
    """Share of pixels that differ."""
    return float((np.abs(before - after).max(axis=1) > 24).mean())


@pytest.mark.long
def test_an_instance_opens_with_layers_numbers_and_warnings(shown: Shown) -> None:
    page = shown("#order=best")
    dialog = open_first(page)
    best = listed(payload_of(Recipe()), "rotation_error_deg")
    best = min(best, key=lambda i: np.inf if i["error"] is None else i["error"])
    expect(dialog.locator("h2")).to_have_text(best["model"])
    for label, selector in (
        ("ground truth", ".overlay .box.gt"),
        ("prediction", ".overlay .box.est"),
        ("keypoints", ".overlay .keypoints"),
    ):
        expect(dialog.locator(selector)).to_have_count(1)
        dialog.get_by_label(label).uncheck()
        expect(dialog.locator(selector)).to_have_count(0)
        dialog.get_by_label(label).check()
    dialog.get_by_label("wireframe").check()
    expect(dialog.locator(".overlay .wire")).to_have_count(2)
    expect(dialog.locator(".warnings")).to_contain_text(WARNING)
    estimate = dialog.locator("table").nth(1)
    expect(estimate).to_contain_text(re.compile(r"scale y.*\u00b1 2\.00%"))
    expect(estimate).to_contain_text(re.compile(r"rotation\u00b1 0\.70\u00b0"))
    drawn = dialog.locator(".overlay .box.est").get_attribute("d")
    dialog.get_by_label("another").check()
    expect(dialog.locator(".overlay .box.est")).not_to_have_attribute("d", drawn or "")
    dialog.get_by_role("radio", name="aepnp", exact=True).check()
    expect(dialog.locator(".warnings")).to_have_count(0)


def test_layers_that_an_instance_lacks_are_not_offered(opened: Opened, tmp_path: Path) -> None:
    exhibits = payload_of(Recipe())["exhibits"]
    for exhibit in exhibits.values():
        exhibit.update(gt=None, points_2d=[])
    page = opened(write_page(tmp_path / "report.html", Recipe(), exhibits=exhibits))
    dialog = open_first(page)
    expect(dialog.get_by_role("checkbox", name="prediction")).to_be_visible()
    for label in ("ground truth", "keypoints"):
        expect(dialog.get_by_role("checkbox", name=label)).to_have_count(0)


@pytest.mark.long
def test_boxes_and_keypoints_are_where_the_camera_sees_them(shown: Shown) -> None:
    payload = payload_of(Recipe())
    page = shown(f"#order=listed&show={METHODS[1]}")
    dialog = open_first(page)
    exhibit = payload["exhibits"]["0"]
    gt = Alignment(np.reshape(exhibit["gt"]["rotation"], (3, 3)), *_rest(exhibit["gt"]))
    low, high = exhibit["bounds"]
    corners = KEYPOINT_CAMERA.project(
        gt.apply(list(itertools.product(*zip(low, high, strict=True))))
    )
    path = dialog.locator(".overlay .box.gt").get_attribute("d")
    drawn = np.array(re.findall(r"(-?[\d.]+) (-?[\d.]+)", path or ""), dtype=float)
    assert len(drawn) == 24
    distance = np.linalg.norm(drawn[:, None] - corners[None], axis=2)
    assert distance.min(axis=1).max() < 0.1
    assert distance.min(axis=0).max() < 0.1
    seen = dialog.locator(".overlay .seen").evaluate_all(
        "(rings) => rings.map((ring) => [ring.cx.baseVal.value, ring.cy.baseVal.value])"
    )
    np.testing.assert_allclose(seen, exhibit["points_2d"], atol=1e-3)
    # Pixel centres are integers: the picture starts at -0.5.
    assert dialog.locator(".overlay").get_attribute("viewBox") == "-0.5 -0.5 640 480"


def _rest(pose: dict[str, Any]) -> tuple[list[float], list[float]]:
    return pose["translation"], pose["scale"]


def test_keys_walk_through_and_close(shown: Shown) -> None:
    page = shown("")
    order = card_names(page)
    dialog = open_first(page)
    expect(dialog.get_by_label("previous instance")).to_be_disabled()
    for step, model in (
        ("ArrowRight", order[1]),
        ("ArrowRight", order[2]),
        ("ArrowLeft", order[1]),
    ):
        page.keyboard.press(step)
        expect(dialog.locator("h2")).to_have_text(model)
    for _ in range(40):  # the focus does not leave the dialog
        page.keyboard.press("Tab")
        assert page.evaluate("!document.activeElement.closest('.page')")
    page.keyboard.press("Escape")
    expect(page.locator("dialog[open]")).to_have_count(0)
    page.wait_for_function("!location.hash.includes('open=')")  # the event follows the closing
    page.locator(".card").nth(2).press("Enter")
    expect(page.locator("dialog[open] h2")).to_have_text(order[2])
    page.go_back()
    expect(page.locator("dialog[open]")).to_have_count(0)
    expect(page.locator("#gallery")).to_be_visible()


def test_the_scene_is_drawn_and_orbits(shown: Shown) -> None:
    page = shown("#order=best")
    canvas = open_first(page).locator("canvas")
    canvas.scroll_into_view_if_needed()
    views = [look(canvas)]
    assert (views[0][:, 3] > 0).mean() > 0.05  # more than an empty canvas
    red = (views[0][:, 0] > views[0][:, 1] + 40) & (views[0][:, 3] > 0)
    green = (views[0][:, 1] > views[0][:, 0] + 20) & (views[0][:, 3] > 0)
    assert min(red.sum(), green.sum()) > 200  # both models are seen
    box = canvas.bounding_box()
    assert box is not None
    middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.move(*middle)
    page.mouse.down()
    page.mouse.move(middle[0] + 120, middle[1] + 20, steps=4)
    page.mouse.up()
    views.append(look(canvas))
    page.mouse.wheel(0, 300)
    views.append(look(canvas))
    title = page.locator("dialog h2").inner_text()
    canvas.focus()
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("ArrowLeft")
    views.append(look(canvas))
    page.keyboard.press("+")
    page.keyboard.press("+")
    views.append(look(canvas))
    for way in ("As in the picture", "With the camera", "The object"):
        page.get_by_role("button", name=way).click()
        views.append(look(canvas))
    assert all(changed(a, b) > 0.04 for a, b in itertools.pairwise(views))
    assert changed(views[0], views[-1]) < 0.01
    assert page.locator("dialog h2").inner_text() == title  # arrow keys did not change the instance


def test_without_webgl_there_is_a_message(opened: Opened, plain: str) -> None:
    page = opened(plain, script=NO_WEBGL, allowed="WebGL")
    dialog = open_first(page)
    expect(dialog.locator(".stage")).to_contain_text("needs WebGL")
    page.keyboard.press("ArrowRight")
    expect(dialog.locator("table").first).to_be_visible()


@pytest.mark.long
def test_a_warped_model_is_drawn_at_the_estimated_keypoints(
    opened: Opened, plain: str, tmp_path: Path
) -> None:
    """In the overlay and the 3D view; the box is unchanged."""
    exhibits = payload_of(Recipe())["exhibits"]
    for exhibit in exhibits.values():
        places = np.array(exhibit["points_3d"])
        for estimate in exhibit["estimates"]:
            moved = places + 0.2 * np.ptp(places, axis=0)
            estimate["warp"] = {"from": places.tolist(), "to": moved.tolist()}
    warped = write_page(tmp_path / "report.html", Recipe(), exhibits=exhibits)
    seen = []
    for address in (plain, warped):
        page = opened(f"{address}#order=listed&show={METHODS[1]}&layers=gpkw")
        dialog = open_first(page)
        shown = {
            name: dialog.locator(f".overlay .{name}").get_attribute("d") or ""
            for name in ("wire.est", "wire.gt", "box.est")
        }
        seen.append((shown, look(dialog.locator(".stage canvas"))))
        words = dialog.get_by_text("the model is warped to the estimated shape")
        expect(words).to_have_count(int(address == warped))
    (before, solid_before), (after, solid_after) = seen
    assert before["wire.gt"] == after["wire.gt"]
    assert before["box.est"] == after["box.est"]
    assert before["wire.est"] != after["wire.est"]
    assert changed(solid_before, solid_after) > 0.01
