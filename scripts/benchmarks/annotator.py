"""The annotator's page in a real Chromium, and pictures of it with ten models."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from playwright.sync_api import Browser, Page
from support.annotating import (
    Case,
    make_case,
    place,
    place_of_pixel,
    place_twenty,
    served,
)
from support.chromium import chromium
from support.panels import (
    AXE,
    MODEL,
    PHOTO,
    SETTLED,
    WATCH_SHIFTS,
    Keyboard,
    open_page,
    prepare,
    shifts,
)
from support.web import axe_script

from benchmarks.section import BenchmarkData, Row, Tables, clocked
from cadalign import Camera
from cadalign.annotate.actions import perform
from cadalign.annotate.evidence import MarkedMask
from cadalign.annotate.session import Session
from cadalign.datasets import write_sample_dataset
from cadalign.io.images import read_photo
from cadalign.render import (
    cast_geometry,
)

SCREENS = {"desktop": (1600, 1000), "laptop": (1366, 768), "phone": (390, 844)}
SCHEMES = ("light", "dark")
SERIOUS = ("serious", "critical")
CAMERA = Camera(1024, 768, 1100.0, 1100.0, 511.5, 383.5)

# From the event of the mouse to the task after the frame in which its answer is painted.
WATCH_PAINT = """
window.painted = [];
window.pressed = null;
addEventListener("pointerup", (event) => { window.pressed = event.timeStamp; }, { capture: true });
window.watchPaint = () => {
    const show = annotator.show.bind(annotator);
    annotator.show = (state) => {
        show(state);
        const { pressed } = window;
        window.pressed = null;
        if (pressed === null) return;
        requestAnimationFrame(() => {
            const after = new MessageChannel();
            after.port1.onmessage = () => window.painted.push(performance.now() - pressed);
            after.port2.postMessage(0);
        });
    };
};
"""
THUMBNAILS = """[...document.querySelectorAll(".thumbs img")].filter((image) => {
    const { top, bottom } = image.getBoundingClientRect();
    return bottom > 0 && top < innerHeight;
}).every((image) => image.complete && image.naturalWidth > 0)"""


_LIST = """async () => {
    const begin = performance.now();
    await annotator.worklist.open(annotator.state.image.number);
    await new Promise((drawn) => requestAnimationFrame(() => requestAnimationFrame(drawn)));
    return performance.now() - begin;
}"""


def annotator(
    given: BenchmarkData,
    *,
    parts: tuple[str, ...] = ("times", "list", "panels"),
    clicks: int = 30,
    photos: int = 200,
) -> Tables:
    """The annotator's page in a real Chromium; it needs the tests' packages and Chromium.

    - times: from the mouse event to the painted frame, with 20 pairs, without and with a mask;
    - list: a folder of 200 photos: the list, its thumbnails, and going from photo to photo;
    - panels: a session by keys alone through every panel: layout shifts, and what axe-core finds.

    Parameters
    ----------
    parts : tuple[str, ...]
        What to measure.
    clicks : int
        Clicks that are timed.
    photos : int
        Photos in the folder.
    """
    measures: dict[str, Callable[[BenchmarkData, Browser, Path], Iterator[Row]]] = {
        "times": partial(_times, clicks),
        "list": partial(_list, photos),
        "panels": _panels,
    }
    with tempfile.TemporaryDirectory() as folder, chromium() as browser:
        for part in parts:
            before = os.getloadavg()[0]
            rows = list(measures[part](given, browser, _new(Path(folder) / part)))
            after = os.getloadavg()[0]
            yield f"annotator, {part} (load {before:.1f}, then {after:.1f})", rows


def _times(clicks: int, given: BenchmarkData, browser: Browser, folder: Path) -> Iterator[Row]:
    """Clicks that complete the twentieth pair, without and with a mask."""
    case = _case(given, folder)
    for kind in ("pairs", "mask"):
        own = case.copied_to(folder / kind)
        session = own.open()
        place_twenty(session, own)
        if kind == "mask":
            pose = own.instance.cam_from_model
            mask = cast_geometry(session.model.cad.scene, own.instance.camera, pose).mask
            session.annotation(0).mark(mask=MarkedMask.of(mask))
            session.save(session.annotation(0))
        last = session.photos[0].document.pairs[-1]
        perform(session, 0, {"do": "delete", "pair": last.number})
        with _page(browser, session, WATCH_PAINT) as page:
            page.evaluate("window.watchPaint()")
            milliseconds = _timed_clicks(page, session, last.uv, clicks)
        median, late = np.percentile(milliseconds, [50, 95]).tolist()
        yield {"with": kind, "clicks": clicks, "median ms": median, "p95 ms": late}


def _list(photos: int, given: BenchmarkData, browser: Browser, folder: Path) -> Iterator[Row]:
    case = _case(given, folder)
    large = Image.fromarray(read_photo(case.photo)).resize((2000, 1500))
    case.photo.unlink()
    for number in range(photos):
        large.save(case.folder / f"photo_{number}.jpg", quality=90)
    opened, _, session = clocked(lambda: case.open(image=case.folder, camera=None, prepared=False))
    session.warm_up()
    for number in range(0, photos, 5):
        for keypoint, (u, v) in case.clicks[:5]:
            scale = 2000 / case.instance.camera.width
            place(session, keypoint, [u * scale, v * scale], image=number)
    listed, pictured, switched = [], [], []
    with _page(browser, session) as page:
        wait = Keyboard(page).wait
        for _ in range(5):
            listed.append(page.evaluate(_LIST))
            start = time.perf_counter()
            wait(THUMBNAILS)
            pictured.append(1000 * (time.perf_counter() - start))
            page.keyboard.press("Escape")
            wait("!annotator.worklist.dialog.isConnected")
        page.locator(PHOTO).focus()
        for number in range(1, 21):
            start = time.perf_counter()
            page.keyboard.press("PageDown")
            wait(
                f"{SETTLED} && annotator.state.image.number === {number}"
                " && annotator.photo.wanted === annotator.photo.picture"
            )
            switched.append(1000 * (time.perf_counter() - start))
    yield {
        "photos": photos,
        "opened s": opened,
        "list ms": float(np.median(listed)),
        "first thumbnails ms": pictured[0],
        "switch ms": float(np.median(switched)),
        "switch p95 ms": float(np.percentile(switched, 95)),
    }


def _case(given: BenchmarkData, folder: Path) -> Case:
    """A photo of a chair: ShapeNet's if it is here, else the sample's."""
    case = _new(folder / "case")
    if given.keypointnet is None:
        return make_case(write_sample_dataset(folder / "sample", per_category=1), case)
    return make_case(given.keypointnet, case, model_id="88382b877be91b2a572f8e1c1caad99e")


def _new(folder: Path) -> Path:
    folder.mkdir()
    return folder


@contextmanager
def _page(
    browser: Browser, session: Session, *scripts: str, screen: str = "laptop", scheme: str = "light"
) -> Iterator[Page]:
    width, height = SCREENS[screen]
    size: dict[str, Any] = {"width": width, "height": height, "scheme": scheme}
    with served(session) as access:
        page = open_page(browser, access.url, scripts=scripts, **size)
        yield page
        page.context.close()


def _timed_clicks(
    page: Page, session: Session, uv: tuple[float, float] | None, count: int
) -> list[float]:
    """Times of clicks on the model that complete a pair, each then undone [ms]."""
    box = page.locator(MODEL).bounding_box()
    assert box is not None
    photo = place_of_pixel(page, uv or (0, 0))
    times = []
    wait = Keyboard(page).wait
    full = len(session.photos[0].document.pairs) + 1
    for click in range(count + 3):
        page.evaluate("window.painted = []; annotator.select(null)")
        page.mouse.click(*photo)
        wait(f"{SETTLED} && annotator.state.pairs.length === {full} && window.painted.length === 1")
        page.wait_for_timeout(350)  # a person's hand; meanwhile the next keypoint is ranked
        place_on_model = page.evaluate(
            "annotator.model.toPage(annotator.state.keypoints.find((each) => !each.used).xyz)"
        )
        page.mouse.click(place_on_model["x"], place_on_model["y"])
        wait(
            f"{SETTLED} && window.painted.length === 2"
            f" && annotator.state.pairs.filter((each) => each.residual).length === {full}"
        )
        if click >= 3:  # the first ones warm up
            times.append(page.evaluate("window.painted[1]"))
        page.evaluate("annotator.act({do: 'undo'}), annotator.act({do: 'undo'})")
        wait(f"{SETTLED} && annotator.state.pairs.length === {full - 1}")
    return times


def _panels(given: BenchmarkData, browser: Browser, folder: Path) -> Iterator[Row]:
    """Layout shifts and what axe-core finds, over a session through every panel."""
    root = write_sample_dataset(folder / "sample", per_category=3)
    original = make_case(root, _new(folder / "case"))
    axe = axe_script(folder)
    for screen in SCREENS:
        for scheme in SCHEMES:
            shift, panels, serious = 0.0, 0, set[str]()
            for with_axe in (False, True):
                own = original.copied_to(folder / f"{screen} {scheme} {with_axe}")
                session, how = prepare(own), {"screen": screen, "scheme": scheme}
                with _page(browser, session, WATCH_SHIFTS, **how) as page:
                    keyboard = Keyboard(page, own.clicks[:7])
                    if with_axe:
                        page.evaluate(axe)
                        keyboard.seen = lambda name, p=page, s=serious: s.update(_serious(p))
                    keyboard.session()
                    if not with_axe:
                        shift = sum(each["value"] for each in shifts(page, also_after_input=False))
                    panels = len(keyboard.visited)
            yield {
                "screen": f"{screen} {scheme}",
                "cumulative layout shift": shift,
                "panels": panels,
                "axe serious": ", ".join(sorted(serious)),
            }


def _serious(page: Page) -> set[str]:
    return {each["id"] for each in page.evaluate(AXE) if each["impact"] in SERIOUS}
