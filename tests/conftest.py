"""What several test modules share: real data, a sample data set, random cases for hypothesis."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from playwright.sync_api import Browser, Error, sync_playwright

from cadalign.datasets import write_sample_dataset

# The same cases on every run: a failure can be seen again, and a pass is not luck.
settings.register_profile(
    "cadalign",
    derandomize=True,
    deadline=None,
    max_examples=40,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
settings.load_profile("cadalign")


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of the real data; tests that need it are skipped where it is not named."""
    folder = os.environ.get("CADALIGN_DATA")
    if not folder:
        pytest.skip("CADALIGN_DATA does not name the folder of the real data")
    return Path(folder)


@pytest.fixture(scope="session")
def sample_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sample data set with one model of every category; to be read, not changed."""
    return write_sample_dataset(tmp_path_factory.mktemp("data") / "sample", per_category=1)


# Not for the whole session: an event loop runs while Playwright does, and other tests need theirs.
@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """A headless Chromium that draws WebGL in software; tests are skipped where there is none."""
    names = ("chromium", "chromium-browser", "google-chrome")
    program = next(filter(None, map(shutil.which, names)), None)
    with sync_playwright() as playwright:
        try:
            launched = playwright.chromium.launch(
                executable_path=program,
                args=["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"],
            )
        except Error as error:
            reason = error.message.strip().splitlines()[0]
            pytest.skip(f"no Chromium here ({reason}); on Debian: apt-get install chromium")
        yield launched
        launched.close()
