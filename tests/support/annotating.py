"""A rendered photo of a sample chair, ready to annotate, and an annotator served on a free port."""

from __future__ import annotations

import json
import pickle
import shutil
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, ConsoleMessage, Page

from cadalign import Result, View, align
from cadalign.annotate.actions import perform
from cadalign.annotate.files import SessionOptions
from cadalign.annotate.page_state import page_state
from cadalign.annotate.photos import ObjectMask
from cadalign.annotate.server import Access, listen, make_app, make_server
from cadalign.annotate.session import Session, open_session
from cadalign.cli import main
from cadalign.datasets import KeypointNet, ModelKeypoints
from cadalign.datasets.model_keypoints import ModelKeypoint
from cadalign.evaluation.instances.instance import Instance, make_instance, scene_of
from cadalign.io.images import write_image
from cadalign.render import RaycastRenderer

IDLE = "!!(annotator.state && annotator.model.mesh && annotator.photo.picture && annotator.idle)"
"""Condition that all is loaded and nothing is under way."""


@dataclass(frozen=True)
class Case:
    """A photo of a chair, and the chair's model."""

    folder: Path
    photo: Path
    camera: Path
    model: Path
    keypoints: Path
    instance: Instance

    @property
    def observation(self) -> Path:
        return self.folder / "photo.json"

    @property
    def clicks(self) -> list[tuple[int, list[float]]]:
        """Semantic ids and pixels of the visible keypoints."""
        ids = self.instance.ids.tolist()
        return list(zip(ids, self.instance.points_2d.tolist(), strict=True))

    def copied_to(self, folder: Path) -> Case:
        """The same with a photo's folder of its own, which can be written to."""
        shutil.copytree(self.folder, folder)
        return replace(
            self,
            folder=folder,
            photo=folder / self.photo.name,
            camera=folder / self.camera.name,
            keypoints=folder / self.keypoints.name,
        )

    def open(self, *, prepared: bool = True, **options: Any) -> Session:
        """A session with the calibrated camera and the model's keypoints.

        One that is not ``prepared`` aligns nothing.
        """
        defaults: dict[str, Any] = {
            "image": self.photo,
            "model": self.model,
            "camera": self.camera,
            "keypoints": self.keypoints,
        }
        session = open_session(SessionOptions(**(defaults | options)))
        if prepared:
            session.warm_up()
        return session


def make_case(
    root: Path, folder: Path, *, category: str = "chair", model_id: str = "sample_chair_000"
) -> Case:
    """Render the photo of a model and write camera and keypoints."""
    model = KeypointNet(root)[category, model_id]
    instance = make_instance(
        model, noise_px=1.0, min_visible=6, seed=0, view_index=0, scene=scene_of(model)
    )
    frame = RaycastRenderer().render(instance.scene, instance.camera, instance.cam_from_model)
    case = Case(
        folder,
        folder / "photo.png",
        folder / "camera.json",
        model.mesh_path,
        folder / "given.keypoints.json",
        instance,
    )
    write_image(case.photo, frame.composite())
    case.camera.write_text(json.dumps(instance.camera.to_dict()))
    ModelKeypoints.from_model(model).save(case.keypoints)
    return case


def place(session: Session, keypoint: int, uv: list[float], *, image: int = 0) -> None:
    """Place both halves of a pair."""
    perform(session, image, {"do": "place_uv", "uv": uv})
    perform(session, image, {"do": "place_keypoint", "keypoint": keypoint})


def place_all(session: Session, case: Case, *, count: int | None = None) -> dict[str, Any]:
    """Place the first of the visible keypoints; gives the state."""
    with aligned_once(session):
        for keypoint, uv in case.clicks[:count]:
            place(session, keypoint, uv)
    return page_state(session, 0)


@contextmanager
def aligned_once(session: Session) -> Iterator[None]:
    """Align what is placed when all of it is, as a session does while it loads its solvers."""
    ready, session.ready = session.ready, False
    yield
    if ready:
        session.warm_up()


def corners_of(session: Session, count: int = 96) -> list[ModelKeypoint]:
    """Vertices of the model that are far from each other."""
    points = np.unique(session.model.cad.scene.mesh.vertices, axis=0)
    rows = [int(np.linalg.norm(points - session.model.cad.center, axis=1).argmax())]
    nearest = np.full(len(points), np.inf)
    while len(rows) < min(count, len(points)):
        nearest = np.minimum(nearest, np.linalg.norm(points - points[rows[-1]], axis=1))
        rows.append(int(nearest.argmax()))
    return [ModelKeypoint("", (x, y, z)) for x, y, z in points[rows].tolist()]


def draw_mask(session: Session, mask: np.ndarray) -> None:
    """Have a mask drawn on the first photo."""
    with session.lock:
        state = session.annotation(0)
        state.record(replace(state.marks, mask=ObjectMask.from_pixels(mask)))
        session.save(state)


@contextmanager
def served(session: Session) -> Iterator[Access]:
    """Serve a session on a free port as `cadalign annotate` does."""
    listener = listen(0)
    access = Access(listener.getsockname()[1])
    server = make_server(make_app(session, access))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
    thread.start()
    try:
        yield access
    finally:
        server.should_exit = True
        thread.join(timeout=10)
        listener.close()


@contextmanager
def opened_page(
    browser: Browser,
    session: Session,
    *,
    width: int = 1366,
    height: int = 768,
    **options: Any,
) -> Iterator[Page]:
    """Serve a session and open its page, in which no error may occur until it is closed.

    What the server refuses (4xx) is none. ``options`` are a browser context's.
    """
    context = browser.new_context(viewport={"width": width, "height": height}, **options)
    errors: list[str] = []

    def note(message: ConsoleMessage) -> None:
        if message.type == "error" and "status of 4" not in message.text:
            errors.append(message.text)

    with served(session) as access:
        page = context.new_page()
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", note)
        page.goto(access.url)
        wait(page, IDLE)
        yield page
        context.close()
    assert errors == []


# The page itself looks, every few milliseconds: a look from here costs three processes as long.
_UNTIL = """async (limit) => {{
    const end = performance.now() + limit;
    while (!({condition})) {{
        if (performance.now() > end) return false;
        await new Promise((passed) => setTimeout(passed, 10));
    }}
    return true;
}}"""


def wait(page: Page, condition: str, *, seconds: float = 60) -> None:
    """Wait for a condition in a page, given in JavaScript."""
    # Not `wait_for_function`, which evaluates text in the page: its policy forbids that.
    if not page.evaluate(_UNTIL.format(condition=condition), 1000 * seconds):
        raise AssertionError(f"never true: {condition}")


def place_of_pixel(page: Page, uv: Sequence[float]) -> tuple[float, float]:
    """Place in the page of a pixel of the photo."""
    x, y = page.evaluate(
        """uv => {
            const { left, top } = annotator.photo.canvas.getBoundingClientRect();
            const place = annotator.photo.toView(uv);
            return [left + place.x, top + place.y];
        }""",
        list(uv),
    )
    return x, y


@contextmanager
def masks_searched_once() -> Iterator[None]:
    """Keep what a mask alone allows for all sessions: it is the same search of many seconds."""
    found: dict[bytes, Result] = {}

    def align_once(model: Any, views: Any, **options: Any) -> Result:
        if not isinstance(views, View):  # with keypoints
            return align(model, views, **options)
        key = pickle.dumps((model, views, options))
        if key not in found:
            found[key] = align(model, views, **options)
        return found[key]

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("cadalign.annotate.problem.align", align_once)
        yield


def fitted(
    case: Case, capsys: pytest.CaptureFixture[str], name: str = "photo.json"
) -> dict[str, Any]:
    """The output of `cadalign fit --json` for an observation file."""
    command = [
        "fit",
        str(case.folder / name),
        "--json",
        "--no-picture",
        "--out",
        str(case.folder / "x"),
    ]
    assert main(command) == 0
    return dict(json.loads(capsys.readouterr().out))


def agree_with_fit(
    session: Session, case: Case, capsys: pytest.CaptureFixture[str], *, rtol: float = 1e-9
) -> dict[str, Any]:
    """The page's alignment, which `cadalign fit` must find in the saved file, too."""
    live = session.live(session.photos[0])
    assert live.result is not None, live.message
    command, page = fitted(case, capsys), live.result.to_dict()
    for name in ("alignment", "covariance", "std", "stretch"):
        np.testing.assert_allclose(flat(command[name]), flat(page[name]), rtol=rtol, atol=1e-9)
    assert command["warnings"] == page["warnings"]
    return dict(page_state(session, 0)["alignment"])


def flat(value: Any) -> list[float]:
    """All numbers of nested lists and objects."""
    if isinstance(value, dict):
        return flat(list(value.values()))
    if isinstance(value, list | tuple):
        return [number for item in value for number in flat(item)]
    return [] if isinstance(value, str) else [value]
