"""A session in the annotator's page that opens every panel, by the keyboard alone."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from playwright.sync_api import Browser, Page

from cadalign.annotate.session import Session
from support.annotating import IDLE, Case, wait

SETTLED = f"{IDLE} && annotator.state.alignment.status !== 'preparing'"
"""Condition that nothing is under way and that nothing is still being prepared."""
WATCH_SHIFTS = """
window.shifts = [];
new PerformanceObserver((list) => {
    for (const entry of list.getEntries()) {
        const nodes = entry.sources.map(({ node, previousRect: a, currentRect: b }) =>
            `${node?.outerHTML?.slice(0, 90) ?? node?.nodeValue} ${a.x},${a.y} -> ${b.x},${b.y}`);
        window.shifts.push({ value: entry.value, input: entry.hadRecentInput, nodes });
    }
}).observe({ type: "layout-shift", buffered: true });
"""
"""Script that collects all layout shifts, those after an input by the user included."""

AXE = """async (options) => {
    const { violations } = await axe.run(document, { resultTypes: ["violations"], ...options });
    return violations.map(({ id, impact, nodes }) =>
        ({ id, impact, nodes: nodes.map((each) => `${each.html}: ${each.failureSummary}`) }));
}"""
PHOTO, MODEL = "section[aria-label=Photo] canvas", "section[aria-label=Model] canvas"
_TWO_FRAMES = """async () => {
    for (let k = 0; k < 2; k += 1) await new Promise((drawn) => requestAnimationFrame(drawn));
}"""


def prepare(case: Case, *, photos: int = 3) -> Session:
    """A folder of photos, opened."""
    for number in range(2, photos + 1):
        shutil.copy(case.photo, case.folder / f"photo_{number}.png")
    return case.open(image=case.folder)


@dataclass
class Keyboard:
    """A page used by its keys; ``seen`` is called in every panel with the panel's name.

    ``clicks`` are the keypoints that are marked and their pixels.
    """

    page: Page
    clicks: Sequence[tuple[int, list[float]]] = ()
    seen: Callable[[str], None] = lambda name: None
    visited: list[str] = field(default_factory=list)

    def wait(self, condition: str = SETTLED) -> None:
        wait(self.page, condition)

    def keys(self, *keys: str, then: str = SETTLED) -> None:
        """Press keys where the focus is, and wait."""
        for key in keys:
            self.page.keyboard.press(key)
            self.wait()
        self.wait(then)

    def press(self, selector: str, key: str = "Enter") -> None:
        """Press a key on a control, which has the focus then."""
        self.page.locator(selector).first.press(key)
        self.wait()

    def disclose(self, selector: str) -> None:
        """Open what is folded. It pushes down what is below it, as asked, however late it comes."""
        before = self.page.evaluate("window.shifts?.length ?? 0")
        self.press(selector)
        self.page.evaluate(_TWO_FRAMES)
        self.page.wait_for_timeout(100)
        self.page.evaluate("count => { if (window.shifts) window.shifts.length = count; }", before)

    def type(self, selector: str, text: str) -> None:
        self.page.locator(selector).first.press("Control+a")
        self.page.keyboard.type(text)
        self.page.keyboard.press("Enter")
        self.wait()

    def look(self, name: str) -> None:
        self.visited.append(name)
        self.page.evaluate(_TWO_FRAMES)
        self.seen(name)

    def session(self) -> None:
        """Open every panel, annotate a photo by all means, and go on to the next."""
        for part in (
            self._first, self._pairs, self._evidence, self._seeing, self._dialogs, self._end,
        ):  # fmt: skip
            part()

    def _first(self) -> None:
        self.look("empty")
        self.keys("?")
        self.look("help")
        self.page.get_by_role("button", name="Show the tour").press("Enter")
        for step in (1, 2, 3):
            self.look(f"tour {step}")
            self.keys("Enter")
        self.page.locator(PHOTO).focus()

    def _pairs(self) -> None:
        for keypoint, uv in self.clicks:
            for action in ({"do": "place_uv", "uv": uv}, _placed(keypoint)):
                self.page.evaluate("action => annotator.act(action)", action)
        self.wait(f"{SETTLED} && annotator.state.alignment.status === 'done'")
        self.look("aligned")
        self.disclose(".keypoints-list > summary")
        self.look("details")
        self.keys("]")
        self.type("td.name input", "left knee")
        self.page.locator(PHOTO).focus()
        self.keys(*["Shift+ArrowRight"] * 12)
        (wrong,) = self.page.locator("tr.wrong").all_inner_texts()
        assert "contradicts the others: " in wrong
        self.look("contradiction")
        self.keys("Control+z", "Control+y", "Control+z")
        self.page.locator(MODEL).focus()
        self.keys("n", "Control+z")

    def _evidence(self) -> None:
        self.page.locator(PHOTO).focus()
        self.keys("x", "Enter")
        self.look("box")
        self.keys("Escape", "p")

    def _seeing(self) -> None:
        self.keys("l", "1", "2", "5", "v", "f", "+", "-")
        self.look("loupe")
        self.keys("l", "o", "o")
        self.look("object's box")
        self.keys("o", "o", "r", then="!!annotator.model.result")
        self.look("result in 3D")
        self.keys("r")
        self.press("section[aria-label=Photo] [aria-label='Zoom in']")
        self.press(".priors input[type=checkbox]", "Space")
        self.press(".priors input[type=checkbox]", "Space")

    def _dialogs(self) -> None:
        self.keys("w", then="document.querySelectorAll('dialog[open] .thumbs li').length > 0")
        self.look("work list")
        self.keys("Escape")
        self.page.locator(MODEL).focus()
        self.page.evaluate("annotator.model.zoom(0.02)")
        self.keys("Enter")
        self.look("message")

    def _end(self) -> None:
        self.page.locator(PHOTO).focus()
        self.keys("f", "PageDown", then=f"{SETTLED} && annotator.state.image.number === 1")
        self.look("next photo")


def _placed(keypoint: int) -> dict[str, Any]:
    return {"do": "place_keypoint", "keypoint": keypoint}


def open_page(
    browser: Browser,
    address: str,
    *,
    width: int,
    height: int,
    scheme: Any,
    scripts: tuple[str, ...],
) -> Page:
    """The annotator's page in a context of its own, with scripts that run before its own."""
    context = browser.new_context(viewport={"width": width, "height": height}, color_scheme=scheme)
    page = context.new_page()
    for script in scripts:
        page.add_init_script(script)
    page.goto(address)
    Keyboard(page).wait()
    return page


def shifts(page: Page, *, also_after_input: bool) -> Iterator[dict[str, Any]]:
    """Layout shifts so far, as `WATCH_SHIFTS` collects them."""
    time.sleep(0.1)
    for each in page.evaluate("window.shifts"):
        if also_after_input or not each["input"]:
            yield each
