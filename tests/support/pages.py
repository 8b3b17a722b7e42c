"""The report pages: their embedded payload, and the pages in a browser, watched for errors."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, Locator, Page, expect

Opened = Callable[..., Page]
"""Opens an address: ``script`` runs before the page's, console errors with ``allowed`` pass."""
Shown = Callable[[str], Page]
"""Shows the view that a fragment names, in a page that several tests share."""


def embedded_payload(page: Path) -> dict[str, Any]:
    """The payload that a page embeds, read as strict JSON."""
    text = page.read_text(encoding="utf-8")
    found = re.search(r'<script type="application/json" id="payload">(.*?)</script>', text, re.S)
    payload: dict[str, Any] = json.loads(found[1], parse_constant=_refuse)
    return payload


def _refuse(constant: str) -> None:
    raise AssertionError(f"{constant} is no JSON")


@contextmanager
def watched(browser: Browser) -> Iterator[Opened]:
    """Yield a function that opens pages; in the end close them and assert that none complained."""
    contexts, complaints = [], []

    def open_page(
        address: str, *, allowed: str = "nothing", script: str = "", **options: Any
    ) -> Page:
        options = {"viewport": {"width": 1280, "height": 800}, **options}
        context = browser.new_context(reduced_motion="reduce", **options)
        contexts.append(context)
        page = context.new_page()
        page.on("pageerror", lambda error: complaints.append(f"error: {error}"))
        page.on(
            "console",
            lambda word: (
                word.type == "error" and allowed not in word.text and complaints.append(word.text)
            ),
        )
        page.on("dialog", lambda dialog: complaints.append(f"dialog: {dialog.message}"))
        page.on(
            "request",
            lambda asked: (
                asked.url.startswith(("file:", "data:")) or complaints.append(f"asks {asked.url}")
            ),
        )
        if script:
            page.add_init_script(script)
        page.goto(address)
        page.locator("html[data-ready]").wait_for()
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert not complaints


_SHOW_VIEW = """async (fragment) => {
    document.activeElement.blur();
    scrollTo(0, 0);
    if (location.hash !== fragment) {
        const changed = new Promise((done) => addEventListener("hashchange", done, { once: true }));
        location.hash = fragment;
        await changed;
    }
    for (let k = 0; k < 2; k += 1) await new Promise((drawn) => requestAnimationFrame(drawn));
}"""


@contextmanager
def views_of(browser: Browser, address: str) -> Iterator[Shown]:
    """Yield a function that shows views of one page: its fragment is all of its state."""
    with watched(browser) as open_page:
        page = open_page(address)

        def show(fragment: str) -> Page:
            page.evaluate(_SHOW_VIEW, fragment)
            return page

        yield show


_SHOW_PLOT = """(number) => {
    const plot = document.querySelectorAll(".plot")[number];
    plot.scrollIntoView({ block: "nearest" });
    return /\\d/.test(plot.dataset.drawn);
}"""


def scroll_through(page: Page) -> None:
    """Bring every plot into view until it is drawn."""
    for plot in range(page.locator(".plot").count()):
        # Looks at every frame; an assertion waits longer and longer between its looks.
        page.wait_for_function(_SHOW_PLOT, arg=plot)


def card_names(page: Page) -> list[str]:
    """Model ids of the gallery, in its order, as far as its cards exist.

    The gallery draws its cards when the browser has measured it, which a busy machine does late.
    """
    names = page.locator(".card .name")
    names.first.wait_for(state="attached")
    return names.all_inner_texts()


def open_first(page: Page) -> Locator:
    """Open the gallery's first instance; its dialog."""
    page.locator(".card").first.click()
    dialog = page.locator("dialog[open]")
    expect(dialog.locator(".overlay")).to_be_visible()
    return dialog
