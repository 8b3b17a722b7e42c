"""The tour, tooltips and the list of keys."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect
from support.annotating import Case, opened_page

import cadalign.web

pytestmark = pytest.mark.long

SCRIPTS = Path(cadalign.web.__file__).parent / "annotate"


@pytest.fixture(scope="module", params=[(1366, 768), (390, 844)], ids=["desktop", "phone"])
def page(
    request: pytest.FixtureRequest,
    browser: Browser,
    original: Case,
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[Page]:
    """One page for the tests that change no annotation; each leaves it without a dialog."""
    width, height = request.param
    session = original.copied_to(tmp_path_factory.mktemp("help") / "photos").open()
    with opened_page(browser, session, width=width, height=height) as page:
        yield page


def test_tour_has_three_steps_and_comes_once(page: Page) -> None:
    page.evaluate("annotator.tour.startOnce()")
    box = page.get_by_role("dialog", name=re.compile(r"^\d\. "))
    for step in (1, 2, 3):
        expect(box).to_contain_text(f"{step}. ")
        assert page.locator(".toured").count() == 1
        assert page.evaluate(
            "(() => { const b = document.querySelector('.tour').getBoundingClientRect();"
            " return b.left >= 0 && b.right <= innerWidth && b.bottom <= innerHeight; })()"
        )
        page.keyboard.press("Enter")
    expect(box).to_be_hidden()
    assert page.locator(".toured").count() == 0
    page.evaluate("annotator.tour.startOnce()")
    expect(box).to_be_hidden()
    page.keyboard.press("?")
    page.get_by_role("button", name="Show the tour").click()
    expect(box).to_be_visible()
    page.keyboard.press("Escape")
    expect(box).to_be_hidden()


def test_help_opens_at_its_beginning_and_covers_no_photo(page: Page) -> None:
    page.keyboard.press("?")
    title = page.get_by_role("heading", name="Keys and mouse")
    expect(title).to_be_focused()
    assert page.locator("dialog.help").evaluate("d => d.scrollTop") == 0
    help_box = page.locator("dialog.help").bounding_box()
    photo = page.locator("section[aria-label=Photo]").bounding_box()
    assert help_box is not None
    assert photo is not None
    beside = help_box["x"] >= photo["x"] + photo["width"]
    assert beside or help_box["y"] >= photo["y"] + photo["height"]
    page.locator("dialog.help").evaluate("d => d.scrollTo(0, 1e6)")
    page.keyboard.press("Escape")
    expect(title).to_be_hidden()
    page.keyboard.press("?")
    assert page.locator("dialog.help").evaluate("d => d.scrollTop") == 0
    page.keyboard.press("Escape")
    expect(title).to_be_hidden()


def test_every_key_is_listed(page: Page) -> None:
    keys = re.findall(r'key: "(\w)"', (SCRIPTS / "marking.js").read_text())
    keys += re.findall(r"\b(\w): \(app\b", (SCRIPTS / "keys.js").read_text())
    page.keyboard.press("?")
    listed = " ".join(page.locator("dialog[open] dt").all_inner_texts())
    words = set(re.findall(r"\b\w\b", listed))
    assert len(set(keys)) > 10
    assert {key.upper() for key in keys} <= words
    page.keyboard.press("Escape")
