"""Every part of the page, reached by keys alone: nothing moves, and it can be heard and read."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page
from support.annotating import IDLE, Case, opened_page, place_all, served, wait
from support.web import axe_script

pytestmark = pytest.mark.long

DESKTOP, PHONE = (1280, 800), (390, 844)
SERIOUS = ("serious", "critical")
SETTLED = f"{IDLE} && annotator.state.alignment.status !== 'preparing'"
PHOTO, MODEL = "section[aria-label=Photo] canvas", "section[aria-label=Model] canvas"
WATCH_SHIFTS = """
window.shifts = [];
new PerformanceObserver((list) => {
    for (const entry of list.getEntries()) {
        if (entry.hadRecentInput) continue;
        for (const { node, previousRect: a, currentRect: b } of entry.sources) {
            const what = node?.outerHTML?.slice(0, 90) ?? node?.nodeValue;
            window.shifts.push(`${what} ${a.x},${a.y} -> ${b.x},${b.y}`);
        }
    }
}).observe({ type: "layout-shift", buffered: true });
"""
AXE = """async () => {
    const { violations } = await axe.run(document, { resultTypes: ["violations"] });
    return violations.map(({ id, impact, nodes }) =>
        ({ id, impact, nodes: nodes.map((each) => `${each.html}: ${each.failureSummary}`) }));
}"""


def use_by_keys(page: Page, case: Case, look: Callable[[str], None]) -> None:
    """Annotate a photo by keys, and go on to the next; ``look`` is called in every part."""

    def keys(*names: str, then: str = SETTLED) -> None:
        for name in names:
            page.keyboard.press(name)
            wait(page, SETTLED)
        wait(page, then)

    look("empty")
    keys("?")
    look("help")
    keys("Escape")
    for keypoint, uv in case.clicks[:7]:
        for action in (
            {"do": "place_uv", "uv": uv},
            {"do": "place_keypoint", "keypoint": keypoint},
        ):
            page.evaluate("action => annotator.act(action)", action)
    wait(page, f"{SETTLED} && annotator.state.alignment.status === 'done'")
    look("aligned")
    page.locator(".pairs input").first.press("Control+a")
    page.keyboard.type("left knee")
    keys("Enter")
    page.locator(PHOTO).focus()
    keys("]")
    for _ in range(12):
        page.keyboard.press("Shift+ArrowRight")
    wait(page, SETTLED)
    assert page.get_by_role("status").inner_text().startswith("Pair ")
    look("contradiction")
    keys("Control+z", "Control+y", "Control+z", "n", "Control+z", "x")
    look("box")
    keys("Escape", "v", "f", "+", "-")
    page.evaluate("annotator.model.stage.camera.lookAt(9, 9, 9)")
    page.locator(MODEL).focus()
    keys("Enter")
    assert "missed the model" in page.get_by_role("status").inner_text()
    look("message")
    page.locator(PHOTO).focus()
    keys("PageDown", then=f"{SETTLED} && annotator.state.image.number === 1")
    look("next photo")


# Colours do not depend on the window's size, nor all else on the scheme.
@pytest.mark.parametrize(
    ("size", "scheme"), [(DESKTOP, "light"), (PHONE, "dark")], ids=["desktop", "phone"]
)
def test_nothing_moves_and_axe_finds_nothing_serious(
    browser: Browser, case: Case, size: tuple[int, int], scheme: Any
) -> None:
    shutil.copy(case.photo, case.folder / "photo_2.png")
    width, height = size
    with served(case.open(image=case.folder)) as access:
        viewport: Any = {"width": width, "height": height}
        context = browser.new_context(viewport=viewport, color_scheme=scheme)
        page = context.new_page()
        page.add_init_script(WATCH_SHIFTS)
        page.goto(access.url)
        wait(page, SETTLED)
        page.evaluate(axe_script())
        found: list[Any] = []

        def look(part: str) -> None:
            found.extend((part, e) for e in page.evaluate(AXE) if e["impact"] in SERIOUS)
            if page.evaluate("document.documentElement.scrollWidth > innerWidth"):
                found.append((part, "beyond the window"))

        use_by_keys(page, case, look)
        assert found == []
        assert page.evaluate("window.shifts") == []
        context.close()


@pytest.mark.parametrize("width", [DESKTOP[0], 1024, 901, PHONE[0]])
def test_pairs_show_whole_names_and_all_buttons(
    browser: Browser, original: Case, tmp_path: Path, width: int
) -> None:
    session = original.copied_to(tmp_path / "photos").open()
    place_all(session, original, count=6)
    with opened_page(browser, session, width=width, height=800) as page:
        names = page.locator(".pairs input")
        assert names.count() == 6
        widths = "all => all.map((each) => [each.value, each.clientWidth, each.scrollWidth])"
        assert [each for each in names.evaluate_all(widths) if each[1] < each[2]] == []
        beyond = """all => all.map((each) => each.getBoundingClientRect().right
            - each.closest(".card").getBoundingClientRect().right)"""
        assert max(page.locator(".pairs button").evaluate_all(beyond)) <= 0
