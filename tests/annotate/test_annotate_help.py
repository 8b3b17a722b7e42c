"""The tour, tooltips and the list of keys; layout and access for a team."""

from __future__ import annotations

import re
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Browser, expect
from support.annotating import IDLE, Case, served, wait

import cadalign.web
from cadalign.annotate.claims import LEASE, Claims
from cadalign.annotate.guard import Access
from cadalign.annotate.server import listen
from cadalign.errors import CadalignError

pytestmark = pytest.mark.long

SCRIPTS = Path(cadalign.web.__file__).parent / "annotate"


@pytest.mark.parametrize(("width", "height"), [(1366, 768), (390, 844)])
def test_tour_has_three_steps_and_comes_once(
    browser: Browser, case: Case, width: int, height: int
) -> None:
    context = browser.new_context(viewport={"width": width, "height": height})
    with served(case.open()) as access:
        page = context.new_page()
        page.goto(access.url)
        wait(page, IDLE)
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
        context.close()


def test_every_key_is_listed_and_controls_have_tooltips_or_texts(
    browser: Browser, case: Case
) -> None:
    keys = re.findall(r'case "(\w)":', (SCRIPTS / "keys.js").read_text())
    keys += re.findall(r'key: "(\w)"', (SCRIPTS / "marking.js").read_text())
    keys += re.findall(r"[{ ](\w): \(app, held\)", (SCRIPTS / "keys.js").read_text())
    context = browser.new_context(viewport={"width": 1366, "height": 768})
    with served(case.open()) as access:
        page = context.new_page()
        page.goto(access.url)
        wait(page, IDLE)
        page.keyboard.press("?")
        listed = " ".join(page.locator("dialog[open] dt").all_inner_texts())
        words = set(re.findall(r"\b\w\b", listed))
        assert len(set(keys)) > 12
        assert {key.upper() for key in keys} <= words
        page.keyboard.press("Escape")
        for control in page.locator("button:visible, select:visible").all():
            assert control.evaluate("c => c.title || c.ariaLabel || c.textContent").strip()
        context.close()


# --- a team ------------------------------------------------------------------------------------


def test_photo_is_free_a_while_after_its_last_change() -> None:
    now = [0.0]
    claims = Claims(clock=lambda: now[0])
    claims.take(0, "one")
    claims.take(1, "two")
    now[0] = LEASE - 1
    with pytest.raises(CadalignError, match="someone else is annotating this photo"):
        claims.take(0, "two")
    claims.take(0, "one")
    now[0] = LEASE + 1
    with pytest.raises(CadalignError, match="someone else"):
        claims.take(0, "two")
    now[0] = 2 * LEASE
    claims.take(0, "two")
    with pytest.raises(CadalignError, match="someone else"):
        claims.take(0, "one")


def test_second_browser_is_told_that_the_photo_is_taken(browser: Browser, case: Case) -> None:
    session = case.open()
    with served(session) as access:
        pages = []
        for _ in range(2):
            page = browser.new_context().new_page()
            page.goto(access.url)
            wait(page, IDLE)
            pages.append(page)
        first, second = pages
        first.evaluate("annotator.act({ do: 'place_uv', uv: [100, 100] })")
        wait(first, "annotator.api.idle && annotator.state.pairs.length === 1")
        second.evaluate("annotator.act({ do: 'place_uv', uv: [200, 100] })")
        told = "document.querySelector('[role=alert]').textContent.includes('someone else is')"
        wait(second, told)
        assert len(session.photos[0].document.pairs) == 1
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
