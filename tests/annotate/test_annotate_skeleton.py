"""The annotator without a CAD model: proposals, estimated keypoints, and categories."""

from __future__ import annotations

import json
import operator
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image, ImageDraw
from playwright.sync_api import Browser, Route, expect
from support.annotating import opened_page, place_of_pixel, wait
from support.refusals import refusal_text

from cadalign import Alignment, CadalignError, Camera, Result, ShapeModel
from cadalign.annotate.actions import perform
from cadalign.annotate.files import SessionOptions
from cadalign.annotate.page_state import page_state
from cadalign.annotate.session import Session, open_session
from cadalign.cli import main
from cadalign.datasets import ModelKeypoints
from cadalign.datasets.model_keypoints import ModelKeypoint
from cadalign.geometry.mesh import Mesh
from cadalign.io.meshes.files import write_mesh
from cadalign.io.observation import Observation

CAMERA = Camera(800, 600, 900.0, 900.0, 399.5, 299.5)
LEGGED = slice(0, 10), slice(17, 21)
"""Rows of the chair's back, seat and armrests, and of its legs."""


def chair_pixels() -> dict[str, list[float]]:
    """Pixels of the keypoints of a chair with four legs, by name."""
    shape = ShapeModel.pretrained("chair")
    eye = np.array([1.1, 0.9, -1.9])
    ahead = -eye / np.linalg.norm(eye)
    right = np.cross(ahead, [0, 1, 0])
    axes = np.stack([right / np.linalg.norm(right), np.cross(ahead, right), ahead])
    axes[1] /= np.linalg.norm(axes[1])
    pose = Alignment(axes, -axes @ eye, np.ones(3))
    pixels = CAMERA.project(pose.apply(shape.mean[: len(shape.ids)]))
    rows = [row for part in LEGGED for row in range(part.start, part.stop)]
    return {shape.names[row]: pixels[row].tolist() for row in rows}


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    """A picture of the chair's skeleton."""
    shape, pixels = ShapeModel.pretrained("chair"), chair_pixels()
    image = Image.new("RGB", (CAMERA.width, CAMERA.height), "#d9d4c8")
    draw = ImageDraw.Draw(image)
    for start, end in shape.lines:
        ends = [pixels.get(shape.names[row]) for row in (start, end)]
        if None not in ends:
            draw.line([tuple(each) for each in ends if each], fill="#7a4a21", width=9)
    path = tmp_path / "photo.png"
    image.save(path)
    return path


def opened(photo: Path, shape: str = "chair", *, ready: bool = False, **options: Any) -> Session:
    session = open_session(SessionOptions(image=photo, shape=Path(shape), **options))
    session.ready = ready
    return session


def named(state: dict[str, Any], number: int | None) -> str:
    names = {each["keypoint"]: str(each["name"]) for each in state["keypoints"]}
    return names[number] if number is not None else ""


def take_proposed(session: Session) -> str:
    """Mark the proposed keypoint where the photo has it, or skip it; returns its name."""
    state, pixels = page_state(session, 0), chair_pixels()
    proposed = state["model"]["proposed"]
    name = named(state, proposed)
    if name in pixels:
        perform(session, 0, {"do": "take", "keypoint": proposed, "uv": pixels[name]})
    else:
        perform(session, 0, {"do": "skip"})
    return name


def mark_until(session: Session, count: int) -> None:
    """Mark or skip what is proposed until ``count`` pairs are there, each keypoint once at most."""
    for _ in page_state(session, 0)["keypoints"]:
        if len(page_state(session, 0)["pairs"]) < count:
            take_proposed(session)
    assert len(page_state(session, 0)["pairs"]) == count


def test_keypoints_far_from_each_other_are_proposed_first(photo: Path) -> None:
    session = opened(photo)
    names = [take_proposed(session) for _ in range(4)]
    assert len(set(names)) == 4
    assert any("back, top" in name for name in names)
    assert any("leg" in name or "base" in name for name in names)


def test_keypoints_that_few_models_have_are_proposed_last(photo: Path) -> None:
    session, shape = opened(photo), ShapeModel.pretrained("chair")
    usual = {name for name, share in zip(shape.names, shape.shares, strict=True) if share > 0.5}
    assert {take_proposed(session) for _ in usual} == usual
    assert take_proposed(session).startswith(("armrest", "star base", "column"))


def test_skipped_keypoints_are_proposed_again_after_all_others(photo: Path) -> None:
    session = opened(photo)
    count = len(page_state(session, 0)["keypoints"])
    first = page_state(session, 0)["model"]["proposed"]
    seen = set()
    for _ in range(count):
        seen.add(page_state(session, 0)["model"]["proposed"])
        perform(session, 0, {"do": "skip"})
    assert len(seen) == count
    assert page_state(session, 0)["model"]["proposed"] is None
    perform(session, 0, {"do": "skip"})
    assert page_state(session, 0)["model"]["proposed"] == first
    assert not photo.with_suffix(".json").exists()


def test_a_click_on_the_skeleton_replaces_the_pending_keypoint(photo: Path) -> None:
    session = opened(photo)
    perform(session, 0, {"do": "place_keypoint", "keypoint": 3})
    perform(session, 0, {"do": "place_keypoint", "keypoint": 5})
    perform(session, 0, {"do": "place_uv", "uv": [10, 20]})
    (pair,) = page_state(session, 0)["pairs"]
    assert (pair["keypoint"], pair["uv"]) == (5, (10, 20))
    missed = {"do": "pick", "origin": [0, 0, -3], "direction": [0, 0, 1]}
    assert "one of the keypoints" in perform(session, 0, missed).message
    with pytest.raises(CadalignError, match="keeps its name"):
        perform(session, 0, {"do": "rename", "pair": pair["pair"], "name": "foot"})


def test_two_pairs_need_two_more(photo: Path) -> None:
    session = opened(photo, ready=True)
    for keypoint, uv in ((0, [10, 20]), (1, [300, 20])):
        perform(session, 0, {"do": "take", "keypoint": keypoint, "uv": uv})
    message = page_state(session, 0)["alignment"]["message"]
    assert message == "2 more pairs to the first alignment"


def test_four_clicks_align_and_the_rest_is_taken_and_reopened(
    photo: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = opened(photo, ready=True, focal=900.0)
    mark_until(session, 4)
    state = page_state(session, 0)
    drawn = state["alignment"]
    assert drawn["status"] == "done"
    assert drawn["lines"]
    used = {pair["keypoint"] for pair in state["pairs"]}
    estimated = {each["keypoint"]: each["uv"] for each in drawn["unmarked"]}
    assert not used & set(estimated)
    assert state["model"]["proposed"] in estimated
    ring, uv = next(iter(estimated.items()))
    perform(session, 0, {"do": "take", "keypoint": ring, "uv": uv})
    with pytest.raises(CadalignError, match="already used"):
        perform(session, 0, {"do": "take", "keypoint": ring, "uv": uv})
    mark_until(session, 9)

    observation = Observation.load(photo.with_suffix(".json"))
    assert observation.model is None
    assert json.loads(photo.with_suffix(".json").read_text())["shape"] == "chair"
    assert not list(photo.parent.glob("*.keypoints.json"))
    again = page_state(opened(photo), 0)["pairs"]
    before = page_state(session, 0)["pairs"]
    for pairs in (again, before):
        pairs.sort(key=lambda pair: pair["keypoint"])
    assert [(p["keypoint"], list(p["uv"])) for p in again] == [
        (p["keypoint"], list(p["uv"])) for p in before
    ]
    out = ["--json", "--no-picture", "--out", str(photo.parent / "fit")]
    assert main(["fit", str(photo.with_suffix(".json")), *out]) == 0
    fitted = json.loads(capsys.readouterr().out)
    live = session.live(session.photos[0]).result
    assert live is not None
    found = Alignment.from_dict(fitted["alignment"])
    np.testing.assert_allclose(found.translation, live.alignment.translation, rtol=1e-4)
    np.testing.assert_allclose(found.rotation, live.alignment.rotation, atol=1e-4)


def test_another_category_keeps_pairs_of_equal_names(photo: Path) -> None:
    session = opened(photo)
    state = page_state(session, 0)
    assert "sofa" not in state["model"]["categories"]
    ids = {each["name"]: each["keypoint"] for each in state["keypoints"]}
    table = ShapeModel.pretrained("table").names
    shared = [name for name in ids if name in table]
    own = [name for name in ids if name not in table][:2]
    for name in (*shared, *own):
        uv = [10.0 + ids[name], 20.0]
        perform(session, 0, {"do": "take", "keypoint": ids[name], "uv": uv})
    outcome = perform(session, 0, {"do": "category", "name": "table"})
    assert f"{len(shared)} of {len(shared) + len(own)} pairs stay" in outcome.message
    state = page_state(session, 0)
    assert state["model"]["key"] == "table"
    kept = {pair["name"] for pair in state["pairs"] if pair["name"]}
    assert kept == set(shared)
    halves = [pair for pair in state["pairs"] if pair["keypoint"] is None]
    assert sorted(pair["uv"][0] for pair in halves) == sorted(10.0 + ids[name] for name in own)
    # The observation remembers its category. Undo restores the one before, with all pairs.
    again = page_state(opened(photo), 0)
    assert again["model"]["key"] == "table"
    assert len(again["pairs"]) == len(state["pairs"])
    for do, key, names in (("undo", "chair", {*shared, *own}), ("redo", "table", kept)):
        perform(session, 0, {"do": do})
        for state in (page_state(session, 0), page_state(opened(photo), 0)):
            assert state["model"]["key"] == key
            assert {pair["name"] for pair in state["pairs"] if pair["name"]} == names
    with pytest.raises(CadalignError, match="unknown category 'sofa'"):
        perform(session, 0, {"do": "category", "name": "sofa"})


def test_keypoints_of_a_skeleton_join_a_cad_model_by_name(photo: Path) -> None:
    """Their places on the mean shape are nobody's: they are not written."""
    session = opened(photo)
    ids = {each["name"]: each["keypoint"] for each in page_state(session, 0)["keypoints"]}
    shared, other, half = list(ids)[:3]
    for name, u in ((shared, 10), (other, 30)):
        perform(session, 0, {"do": "take", "keypoint": ids[name], "uv": [u, 20]})
    perform(session, 0, {"do": "place_keypoint", "keypoint": ids[half]})
    path = photo.with_suffix(".json")
    assert "xyz" not in path.read_text()

    corners = [(0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (0.0, 0.5, 0.0), (0.0, 0.0, 0.4)]
    model = photo.with_name("own.obj")
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 1, 3]])
    write_mesh(model, Mesh(np.array(corners), faces), kind="obj")
    own = tuple(map(ModelKeypoint, (shared, half, "tip"), corners))
    ModelKeypoints(own, model).save(model.with_suffix(".keypoints.json"))
    earlier = json.loads(path.read_text())  # earlier files have places on the mean shape
    for each in (*earlier["keypoints"], *earlier["unfinished"]["pairs"]):
        each["xyz"] = [0.1, 0.1, 0.1]
    for data in (json.loads(path.read_text()), earlier):
        path.write_text(json.dumps(data))
        state = page_state(opened(photo, model=model), 0)
        found = [(pair["name"], pair["uv"] and pair["uv"][0]) for pair in state["pairs"]]
        assert found == [(shared, 10), ("", 30), (half, None)]
        assert [each["name"] for each in state["keypoints"]] == [shared, half, "tip"]


def test_a_file_of_another_shape_is_refused_and_kept(
    photo: Path, caplog: pytest.LogCaptureFixture
) -> None:
    own, path = photo.with_name("own.shape"), photo.with_suffix(".json")
    replace(ShapeModel.pretrained("chair"), names=()).save(own)
    perform(opened(photo, str(own)), 0, {"do": "take", "keypoint": 4, "uv": [10, 20]})
    kept = path.read_bytes()
    fix = "give that shape, or give another --observation or --out"
    assert refusal_text(lambda: opened(photo)) == (
        f"{path}: belongs to the shape {own}, not chair; {fix}"
    )
    assert path.read_bytes() == kept
    state = page_state(opened(photo, str(own)), 0)
    assert [pair["name"] for pair in state["pairs"]] == ["keypoint 4"]
    own.unlink()  # deleted, it counts as renamed
    assert page_state(opened(photo), 0)["model"]["key"] == "chair"
    assert f"its shape {own} no longer exists, chair is used instead" in caplog.text


def test_shapes_from_files_are_not_exchanged(photo: Path) -> None:
    path = photo.parent / "own.shape"
    ShapeModel.pretrained("mug").save(path)
    session = opened(photo, str(path))
    assert not page_state(session, 0)["model"]["categories"]
    with pytest.raises(CadalignError, match="that come with cadalign"):
        perform(session, 0, {"do": "category", "name": "table"})


def test_input_without_model_or_shape_is_refused(
    photo: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for arguments, said in (
        (["--shape", "sofa"], "unknown shape 'sofa'"),
        (["--shape", "chair", "--keypoints", "k.json"], "given without a model"),
    ):
        assert main(["annotate", str(photo), *arguments, "--no-open"]) == 1
        assert said in capsys.readouterr().err
    observation = photo.with_suffix(".json")
    Observation(np.zeros((1, 3)), np.zeros((1, 2)), CAMERA, model=photo.parent / "chair.obj").save(
        observation
    )
    with pytest.raises(CadalignError, match="belongs to the model"):
        opened(photo)


@pytest.mark.parametrize("width", [1000, 1200, 1366])
def test_pairs_without_a_model_take_one_line_each(
    browser: Browser, photo: Path, width: int
) -> None:
    session = opened(photo)
    mark_until(session, 8)
    perform(session, 0, {"do": "category", "name": "table"})
    with opened_page(browser, session, width=width, height=700) as page:
        # Found and measured in one step: while solvers are prepared, rows are made anew.
        measured = "([all, size]) => [...document.querySelectorAll(all)].map((each) => each[size])"
        assert max(page.evaluate(measured, [".pairs li", "offsetHeight"])) < 34
        needed = page.evaluate(measured, [".pairs .name", "scrollWidth"])
        given = page.evaluate(measured, [".pairs .name", "clientWidth"])
        assert len(needed) >= 3
        assert all(map(operator.ge, given, needed))
        assert min(page.evaluate(measured, [".pairs select", "offsetWidth"])) > 200


def test_the_skeleton_shown_is_of_the_photos_category(browser: Browser, photo: Path) -> None:
    """A slow answer replaces no later one, and a failed one is asked for again."""
    shutil.copy(photo, photo.with_name("second.png"))
    session = opened(photo.parent, ready=True)
    perform(session, 1, {"do": "category", "name": "table"})
    sizes = [
        3 * int(np.frombuffer(each.model.cad.display_bytes[:4], "<u4")[0])
        for each in session.photos
    ]
    assert sizes[0] != sizes[1]
    shown = "annotator.model.mesh?.geometry.attributes.position.count === {}"
    with opened_page(browser, session) as page:
        wait(page, shown.format(sizes[0]))
        slow: list[Route] = []
        page.route("**/model/1?*", lambda route: slow.append(route))
        page.evaluate("annotator.goTo(1)")
        wait(page, "annotator.state.image.number === 1")
        page.evaluate("annotator.goTo(0)")
        wait(page, shown.format(sizes[0]))
        with page.expect_response("**/model/1?*"):
            slow[0].continue_()
        page.wait_for_timeout(200)
        assert page.evaluate(shown.format(sizes[0]))

        page.unroute("**/model/1?*")
        page.route("**/model/1?*", lambda route: route.fulfill(status=422, body="no"), times=1)
        page.evaluate("annotator.goTo(1)")
        expect(page.get_by_role("status")).to_contain_text("The model cannot be shown: no")
        page.evaluate("annotator.api.refresh()")
        wait(page, shown.format(sizes[1]))


@pytest.mark.long
def test_a_chair_from_nothing_to_an_exported_box(browser: Browser, photo: Path) -> None:
    """Clicks alone: the proposed keypoints, then an estimated one is taken, another dragged."""
    session, pixels = opened(photo, focal=900.0), chair_pixels()
    session.warm_up()
    with opened_page(browser, session, width=1200, height=800) as page:
        status = page.get_by_role("status")
        expect(status).to_contain_text("Click in the photo: ")
        for _ in range(8):
            state = page.evaluate("annotator.state")
            name, count = named(state, state["model"]["proposed"]), len(state["pairs"])
            if name in pixels:
                page.mouse.click(*place_of_pixel(page, pixels[name]))
                wait(page, f"annotator.idle && annotator.state.pairs.length === {count + 1}")
            else:
                page.keyboard.press("s")
                old = state["model"]["proposed"]
                wait(page, f"annotator.idle && annotator.state.model.proposed !== {old}")
        wait(page, "annotator.state.alignment.status === 'done'")

        state = page.evaluate("annotator.state")
        rings = [
            ring
            for ring in state["alignment"]["unmarked"]
            if ring["keypoint"] != state["model"]["proposed"]
            and named(state, ring["keypoint"]) in pixels
        ]
        taken, dragged = rings[0], rings[-1]
        page.mouse.click(*place_of_pixel(page, taken["uv"]))
        count = len(state["pairs"])
        wait(page, f"annotator.idle && annotator.state.pairs.length === {count + 1}")
        pair = page.evaluate("annotator.state.pairs.at(-1)")
        assert (pair["keypoint"], pair["uv"]) == (taken["keypoint"], taken["uv"])
        now = page.evaluate("annotator.state.alignment.unmarked")
        (start,) = (ring["uv"] for ring in now if ring["keypoint"] == dragged["keypoint"])
        target = pixels[named(state, dragged["keypoint"])]
        page.mouse.move(*place_of_pixel(page, start))
        page.mouse.down()
        page.mouse.move(*place_of_pixel(page, [target[0] + 9, target[1]]))
        page.mouse.move(*place_of_pixel(page, target))
        page.mouse.up()
        wait(page, f"annotator.idle && annotator.state.pairs.length === {count + 2}")
        pair = page.evaluate("annotator.state.pairs.at(-1)")
        assert pair["keypoint"] == dragged["keypoint"]
        np.testing.assert_allclose(pair["uv"], target, atol=1.5)
    out = photo.parent / "x"
    assert main(["fit", str(photo.with_suffix(".json")), "--out", str(out)]) == 0
    found = Result.load(out / "fit.json")
    shape = ShapeModel.pretrained("chair")
    size = np.ptp(found.bounds, axis=0) * found.alignment.scale
    np.testing.assert_allclose(size, np.ptp(shape.mean[-2:], axis=0), rtol=0.3)
    assert main(["export", str(out / "fit.json"), "--to", str(out / "chair.glb")]) == 0
    scene = trimesh.load(out / "chair.glb")
    place, name = scene.graph["model_0"]
    lengths = np.ptp(scene.geometry[name].bounds, axis=0) * np.linalg.norm(place[:3, :3], axis=0)
    np.testing.assert_allclose(lengths, size, rtol=1e-5)
