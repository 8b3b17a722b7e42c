"""Every panel of the page: reached by keys alone, nothing moves, and it can be heard and read."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser
from support.annotating import Case, make_case, opened_page, place_all, served
from support.panels import AXE, WATCH_SHIFTS, Keyboard, open_page, prepare, shifts
from support.web import axe_script

from cadalign.datasets import write_sample_dataset

DESKTOP, PHONE = (1280, 800), (390, 844)
SERIOUS = ("serious", "critical")


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Any:
    folder = tmp_path_factory.mktemp("data") / "sample"
    return write_sample_dataset(folder, per_category=3, categories=["chair"])


@pytest.fixture(scope="module")
def original(root: Any, tmp_path_factory: pytest.TempPathFactory) -> Case:
    return make_case(root, tmp_path_factory.mktemp("annotate"))


@dataclass(frozen=True)
class Used:
    """What a session of keys alone met in a window of one size."""

    visited: list[str]
    errors: list[str]
    moved: list[dict[str, Any]]
    found: dict[str, Any]


# Colours do not depend on the window's size, nor all else on the scheme.
@pytest.fixture(
    scope="module", params=[(DESKTOP, "light"), (PHONE, "dark")], ids=["desktop", "phone"]
)
def used(
    request: pytest.FixtureRequest,
    browser: Browser,
    original: Case,
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[Used]:
    """One session for all tests: what it takes is the way through the panels, not what is asked."""
    folder = tmp_path_factory.mktemp("used")
    (width, height), scheme = request.param
    with served(prepare(original.copied_to(folder / "photos"))) as access:
        page = open_page(
            browser, access.url, width=width, height=height, scheme=scheme, scripts=(WATCH_SHIFTS,)
        )
        errors: list[str] = []
        found: dict[str, Any] = {}
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.evaluate(axe_script())

        def check(panel: str) -> None:
            for each in page.evaluate(AXE, {}):
                if each["impact"] in SERIOUS:
                    found.setdefault(each["id"], (panel, each["nodes"]))
            if page.evaluate("document.documentElement.scrollWidth > innerWidth"):
                found.setdefault("beyond the window", panel)

        keyboard = Keyboard(page, original.clicks[:7], check)
        keyboard.session()
        yield Used(keyboard.visited, errors, list(shifts(page, also_after_input=False)), found)
        page.context.close()


@pytest.mark.long
def test_nothing_moves_in_a_session_of_keys_alone(used: Used) -> None:
    assert len(set(used.visited)) == 15
    assert sum(each["value"] for each in used.moved) == 0, used.moved
    assert used.errors == []


@pytest.mark.long
def test_axe_finds_nothing_serious_in_any_panel(used: Used) -> None:
    assert used.found == {}


@pytest.mark.parametrize("width", [DESKTOP[0], 1024, 901, PHONE[0]])
def test_pairs_show_whole_names_and_all_buttons(
    browser: Browser, original: Case, tmp_path: Path, width: int
) -> None:
    session = original.copied_to(tmp_path / "photos").open()
    place_all(session, original, count=6)

    with opened_page(browser, session, width=width, height=800) as page:
        names = page.locator("td.name input")
        assert names.count() == 6
        widths = "all => all.map((each) => [each.value, each.clientWidth, each.scrollWidth])"
        assert [each for each in names.evaluate_all(widths) if each[1] < each[2]] == []
        beyond = """all => all.map((each) => each.getBoundingClientRect().right
            - each.closest(".scroll").getBoundingClientRect().right)"""
        assert max(page.locator("td.actions button").evaluate_all(beyond)) <= 0
