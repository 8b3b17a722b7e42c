"""Models whose up axis is not y: files, gravity, and how the page shows them."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from playwright.sync_api import Browser, Page
from support.annotating import Case, agree_with_fit, corners_of, opened_page, place, place_all

from cadalign.annotate.actions import perform
from cadalign.annotate.page_state import page_state
from cadalign.datasets.model_keypoints import ModelKeypoint, ModelKeypoints
from cadalign.io.meshes.files import load_mesh, write_mesh
from cadalign.io.observation import Observation

pytestmark = pytest.mark.long

FROM_Y_UP = {
    "x": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
    "z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
}


def turned(case: Case, axis: str) -> Case:
    """The same photo with the model turned so that the given axis points up."""
    mesh, path = load_mesh(case.model), case.folder / f"{axis}_up.obj"
    write_mesh(path, replace(mesh, vertices=mesh.vertices @ FROM_Y_UP[axis].T), kind="obj")
    given = ModelKeypoints.load(case.keypoints)
    points = [
        ModelKeypoint(each.name, tuple(FROM_Y_UP[axis] @ each.xyz), each.semantic_id)
        for each in given.keypoints
    ]
    keypoints = path.with_suffix(".given.keypoints.json")
    ModelKeypoints(tuple(points), path).save(keypoints)
    return replace(case, model=path, keypoints=keypoints)


def test_the_up_axis_is_written_and_kept(case: Case) -> None:
    z_up = turned(case, "z")
    place_all(z_up.open(up_axis="z"), z_up)
    assert Observation.load(case.observation).up_axis == "z"
    again = z_up.open()
    assert page_state(again, 0)["image"]["up_axis"] == "z"
    place(again, again.model.registry.add(corners_of(again)[0]), [300.0, 200.0])
    assert Observation.load(case.observation).up_axis == "z"
    for pair in again.photos[0].marks.pairs:  # a file without keypoints keeps it, too
        perform(again, 0, {"do": "delete", "pair": pair.number})
    assert page_state(z_up.open(), 0)["image"]["up_axis"] == "z"


def test_gravity_is_that_of_the_up_axis(case: Case, capsys: pytest.CaptureFixture[str]) -> None:
    z_up = turned(case, "z")
    place_all(z_up.open(up_axis="z"), z_up)
    stored = json.loads(case.observation.read_text())
    up = case.instance.cam_from_model.rotation @ [0.0, 1.0, 0.0]
    case.observation.write_text(json.dumps(stored | {"up": up.tolist()}))
    session = z_up.open()
    perform(session, 0, {"do": "move", "pair": 1, "uv": case.clicks[0][1]})
    live = session.live(session.photos[0])
    assert live.result is not None
    assert not any("gravity" in warning for warning in map(str, live.result.warnings))
    wanted = case.instance.cam_from_model.rotation @ FROM_Y_UP["z"].T
    error = np.trace(wanted.T @ live.result.alignment.rotation)
    assert np.degrees(np.arccos(np.clip((error - 1) / 2, -1, 1))) < 3
    agree_with_fit(session, z_up, capsys)
    wrong = z_up.open(up_axis="y")
    notes = page_state(wrong, 0)["alignment"]["notes"]
    assert any("give up_axis='z'" in note for note in notes)


def up_on_screen(page: Page, axis: str) -> list[float]:
    """Direction on the screen of a step along a model axis [px], y upwards."""
    step = {"x": [0.3, 0, 0], "y": [0, 0.3, 0], "z": [0, 0, 0.3]}[axis]
    return list(
        page.evaluate(
            """step => {
                const { x, y } = annotator.model.toPage([0, 0, 0]);
                const end = annotator.model.toPage(step);
                return [end.x - x, y - end.y];
            }""",
            step,
        )
    )


@pytest.mark.parametrize("axis", ["x", "z"])
def test_the_model_stands_upright_on_the_page(case: Case, browser: Browser, axis: str) -> None:
    case = turned(case, axis)
    session = case.open(up_axis=axis)
    place_all(session, case)
    with opened_page(browser, session) as page:
        for key in ("", "ArrowLeft", "ArrowUp"):
            if key:
                page.locator("section[aria-label=Model] canvas").press(key)
            page.wait_for_timeout(50)
            aside, up = up_on_screen(page, axis)
            assert up > 20
            assert abs(aside) < 0.02 * up
