"""Make the README's picture of the annotator, in a headless browser.

The photo and the model are those of `align_other_chair.py`, whose files are needed:

    python scripts/align_other_chair.py --files chairs
    python scripts/make_annotator_picture.py --files chairs
"""

from __future__ import annotations

import sys
from pathlib import Path

import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from support.annotating import IDLE, opened_page, wait
from support.chromium import chromium

from cadalign import Observation
from cadalign.annotate.opening import open_session
from cadalign.annotate.options import SessionOptions


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
    options = SessionOptions(image=files / "photo.png", model=model, observation=observation)
    session = open_session(options)
    session.warm_up()
    with chromium() as browser, opened_page(browser, session, width=1280, height=960) as page:
        wait(page, f"{IDLE} && annotator.state.alignment.status === 'done'")
        page.keyboard.press("v")
        page.wait_for_timeout(1000)  # until everything is drawn
        out.parent.mkdir(parents=True, exist_ok=True)
        page.screenshot(path=out)


if __name__ == "__main__":
    tyro.cli(main)
