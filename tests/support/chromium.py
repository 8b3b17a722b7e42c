"""A headless Chromium that draws WebGL in software."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager

from playwright.sync_api import Browser, sync_playwright

# The headless shell has no windows to manage: pages take two thirds of the processor time.
_NAMES = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
# Without a graphics card, only WebGL goes through SwiftShader, as on a person's machine; to compose
# the page there, too, would take five times the processor time.
_FLAGS = (
    *("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    "--disable-gpu-compositing",
)


@contextmanager
def chromium() -> Iterator[Browser]:
    """Launch the browser; Playwright's `Error` where there is none."""
    program = next(filter(None, map(shutil.which, _NAMES)), None)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=_FLAGS)
        yield browser
        browser.close()
