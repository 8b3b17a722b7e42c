"""Every panel of the page: reached by keys alone, nothing moves, and it can be heard and read."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from playwright.sync_api import Browser, Page
from support.annotating import Case, make_case, served
from support.panels import AXE, WATCH_SHIFTS, Keyboard, open_page, prepare, shifts
from support.web import axe_script

from cadalign.datasets import write_sample_dataset

DESKTOP, PHONE = (1440, 900), (390, 844)
SERIOUS = ("serious", "critical")


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return write_sample_dataset(tmp_path_factory.mktemp("data") / "sample", per_category=3)


@pytest.fixture(scope="module")
def original(root: Any, tmp_path_factory: pytest.TempPathFactory) -> Case:
    return make_case(root, tmp_path_factory.mktemp("annotate"))


@pytest.fixture
def address(case: Case, root: Any) -> Iterator[str]:
    with served(prepare(case, root)) as access:
        yield access.url


def opened(
    browser: Browser, address: str, size: tuple[int, int], scheme: str, *scripts: str
) -> Page:
    width, height = size
    return open_page(browser, address, width=width, height=height, scheme=scheme, scripts=scripts)


@pytest.mark.long
@pytest.mark.parametrize(("size", "scheme"), [(DESKTOP, "light"), (PHONE, "dark")])
def test_nothing_moves_in_a_session_of_keys_alone(
    browser: Browser, address: str, size: tuple[int, int], scheme: str
) -> None:
    page = opened(browser, address, size, scheme, WATCH_SHIFTS)
    errors: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    keyboard = Keyboard(page)
    keyboard.session()
    assert len(set(keyboard.visited)) == 22
    moved = list(shifts(page, also_after_input=False))
    assert sum(each["value"] for each in moved) == 0, moved
    assert errors == []
    page.context.close()


@pytest.mark.long
@pytest.mark.parametrize(
    ("size", "scheme"), [(DESKTOP, "light"), (DESKTOP, "dark"), (PHONE, "light")]
)
def test_axe_finds_nothing_serious_in_any_panel(
    browser: Browser,
    address: str,
    size: tuple[int, int],
    scheme: str,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    page = opened(browser, address, size, scheme)
    page.evaluate(axe_script(tmp_path_factory.mktemp("web")))
    found: dict[str, Any] = {}

    def check(panel: str) -> None:
        for each in page.evaluate(AXE):
            if each["impact"] in SERIOUS:
                found.setdefault(each["id"], (panel, each["nodes"]))

    Keyboard(page, check).session()
    assert found == {}
    page.context.close()
