"""The tour, tooltips and the list of keys; layout and access for a team."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Browser, Page, expect
from support.annotating import IDLE, Case, opened_page, served, wait

import cadalign.web
from cadalign.annotate.guard import Access
from cadalign.annotate.locks import LEASE, Claims
from cadalign.annotate.server import listen
from cadalign.errors import CadalignError

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


def test_every_key_is_listed_and_controls_have_tooltips_or_texts(page: Page) -> None:
    keys = re.findall(r'case "(\w)":', (SCRIPTS / "keys.js").read_text())
    keys += re.findall(r'key: "(\w)"', (SCRIPTS / "marking.js").read_text())
    keys += re.findall(r"[{ ](\w): \(app, held\)", (SCRIPTS / "keys.js").read_text())
    page.keyboard.press("?")
    listed = " ".join(page.locator("dialog[open] dt").all_inner_texts())
    words = set(re.findall(r"\b\w\b", listed))
    assert len(set(keys)) > 12
    assert {key.upper() for key in keys} <= words
    page.keyboard.press("Escape")
    for name in page.locator("button:visible, select:visible").evaluate_all(
        "(all) => all.map((c) => c.title || c.ariaLabel || c.textContent)"
    ):
        assert name.strip()


# --- a team ------------------------------------------------------------------------------------


def test_photo_is_free_a_while_after_its_last_change_by_another_person() -> None:
    now = [0.0]
    claims = Claims(clock=lambda: now[0])
    claims.take({0}, "one", "ann")
    claims.take({1}, "two", "bob")
    now[0] = LEASE - 1
    with pytest.raises(CadalignError, match="someone else is annotating this photo"):
        claims.take({0, 2}, "two", "bob")
    assert not claims.is_elsewhere(2, "one")
    claims.take({0}, "one", "ann")
    now[0] = LEASE + 1
    with pytest.raises(CadalignError, match="someone else"):
        claims.take({0}, "two", "bob")
    now[0] = 2 * LEASE
    claims.take({0}, "two", "bob")
    with pytest.raises(CadalignError, match="someone else"):
        claims.take({0}, "one", "ann")


def test_another_browser_of_a_person_takes_a_photo_over_at_once() -> None:
    now = [0.0]
    claims = Claims(clock=lambda: now[0])
    claims.take({0}, "one", "ann")
    claims.take({0}, "two", "ann")
    assert claims.is_elsewhere(0, "one")
    assert not claims.is_elsewhere(0, "two")
    now[0] = LEASE
    assert not claims.is_elsewhere(0, "one")


def test_reopened_in_another_browser_goes_on_and_the_first_page_is_told(
    browser: Browser, case: Case
) -> None:
    session = case.open()
    with served(session) as access:
        pages = []
        for _ in range(2):
            page = browser.new_context().new_page()
            page.goto(access.url)
            wait(page, IDLE)
            pages.append(page)
        first, second = pages
        told = "document.querySelector('[role=alert]').textContent.includes('in another browser')"
        first.evaluate("annotator.act({ do: 'place_uv', uv: [100, 100] })")
        wait(first, "annotator.api.idle && annotator.state.pairs.length === 1")
        second.evaluate("annotator.act({ do: 'place_uv', uv: [200, 100] })")
        wait(second, "annotator.api.idle && annotator.state.pairs.length === 2")
        wait(first, "annotator.state.pairs.length === 2")
        wait(first, told)
        first.evaluate("annotator.act({ do: 'delete', pair: 1 })")
        wait(first, f"annotator.state.pairs.length === 1 && !({told})")
        wait(second, f"annotator.state.pairs.length === 1 && {told}")
        assert [pair.uv for pair in session.photos[0].document.pairs] == [(200, 100)]
        for page in pages:
            page.context.close()


def test_page_is_served_to_others_only_by_token_and_name(case: Case) -> None:
    with served(case.open()) as access:
        team = Access(access.port, "0.0.0.0")
        assert "127.0.0.1" in team.names
        assert team.address.endswith(f":{access.port}/")
        assert "0.0.0.0" not in team.address
        assert httpx.get(access.address).status_code == 403
        headers = {"host": f"evil.example:{access.port}"}
        assert httpx.get(access.url, headers=headers).status_code == 400
    with pytest.raises(CadalignError, match="--host"):
        listen(0, "192.0.2.7")
