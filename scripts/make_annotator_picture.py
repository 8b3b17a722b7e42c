"""Make the README's picture of the annotator, in a headless browser.

The photo and the model are those of `align_other_chair.py`, whose files are needed:

    python scripts/align_other_chair.py --files chairs
    python scripts/make_annotator_picture.py --files chairs
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import tyro
from common import COMMAND
from playwright.sync_api import Page

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from support.chromium import chromium

from cadalign.io.observation import Observation

READY = """!!(annotator.state?.alignment.status === "done" && annotator.model.mesh
    && annotator.photo.picture)"""


def main(*, out: Path = Path("docs/annotator.png"), files: Path) -> None:
    """Make the README's picture of the annotator.

    Parameters
    ----------
    out : Path
        Where to write the picture.
    files : Path
        Where `align_other_chair.py` has written its files.
    """
    observation = files / "photo.json"
    model = Observation.load(observation).model
    command = [*COMMAND, "annotate", "--no-open", "--image", str(files / "photo.png")]
    command += ["--model", str(model), "--observation", str(observation)]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None
        url = server.stdout.readline().strip()
        with chromium() as browser:
            page = browser.new_page(viewport={"width": 1280, "height": 960}, color_scheme="light")
            page.goto(url)
            wait(page)
            out.parent.mkdir(parents=True, exist_ok=True)
            page.screenshot(path=out)
    finally:
        server.terminate()
        server.wait()


def wait(page: Page) -> None:
    """Wait until everything is drawn."""
    while not page.evaluate(READY):
        page.wait_for_timeout(100)
    page.keyboard.press("v")
    page.wait_for_timeout(1000)


if __name__ == "__main__":
    tyro.cli(main)
