"""Report pages, and a browser that fails the test on a page's errors."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser
from support.pages import Opened, Shown, views_of, watched
from support.reports import Recipe, write_page


@pytest.fixture
def opened(browser: Browser) -> Iterator[Opened]:
    with watched(browser) as open_page:
        yield open_page


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> str:
    """URL of the page of an ordinary run."""
    return write_page(tmp_path_factory.mktemp("plain") / "report.html", Recipe())


@pytest.fixture(scope="module")
def shown(browser: Browser, plain: str) -> Iterator[Shown]:
    """Function that shows a view of the page of an ordinary run, opened once per module."""
    with views_of(browser, plain) as show:
        yield show
