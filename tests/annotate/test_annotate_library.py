"""The model chosen from a library by the pairs marked so far."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import httpx
import pytest
from playwright.sync_api import Browser, expect
from support.annotating import IDLE, Case, make_case, opened_page, place, place_all, served, wait
from support.refusals import refusal_line

from cadalign.annotate.actions import perform
from cadalign.annotate.evidence_actions import carry_keypoints
from cadalign.annotate.library import ModelChoice, starting_model
from cadalign.annotate.models import KeypointRegistry
from cadalign.annotate.options import FileOptions
from cadalign.annotate.page_state import page_state
from cadalign.annotate.ranking import ranking_state
from cadalign.annotate.session import Session
from cadalign.cli import main
from cadalign.datasets import KeypointNet, ModelKeypoint, write_sample_dataset
from cadalign.errors import CadalignError
from cadalign.io.observation import Observation
from cadalign.retrieval import Library

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six chairs and two bottles."""
    folder = tmp_path_factory.mktemp("library")
    root = write_sample_dataset(folder / "sample", per_category=6)
    dataset = KeypointNet(root).subset(categories=["chair", "bottle"])
    path = folder / "models.library"
    Library.from_dataset(dataset).save(path)
    return path


@pytest.fixture(scope="module")
def original(library: Path, tmp_path_factory: pytest.TempPathFactory) -> Case:
    return make_case(library.parent / "sample", tmp_path_factory.mktemp("annotate"))


def opened(case: Case, library: Path, **options: Any) -> Session:
    chosen = {"keypoints": None, "library": library, "category": "chair"}
    return case.open(**chosen | options)


def other_chair(library: Path, number: int = 3) -> Path:
    mesh = Library.open(library)["chair", f"sample_chair_{number:03d}"].mesh_path
    assert mesh is not None
    return mesh


def retrieved(
    case: Case, library: Path, capsys: pytest.CaptureFixture[str]
) -> list[dict[str, Any]]:
    given = ["--library", str(library), "--category", "chair", "--json"]
    assert main(["retrieve", str(case.observation), *given]) == 0
    return list(json.loads(capsys.readouterr().out))


def test_ranking_is_that_of_the_command_on_the_saved_file(
    case: Case, library: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = opened(case, library, model=other_chair(library))
    known = dict(session.models[0].registry)
    for keypoint, uv in case.clicks:
        if keypoint in known:
            place(session, keypoint, uv)
    ranking = ranking_state(session, 0)
    command = retrieved(case, library, capsys)
    assert [each["model"] for each in ranking["models"]] == [each["model_id"] for each in command]
    assert ranking["models"][0]["model"] == "sample_chair_000"
    for ours, theirs in zip(ranking["models"], command, strict=True):
        assert ours["score"] == theirs["score"]
        assert ours["rms"] == theirs["rms"]
    assert [each["model"] for each in ranking["models"] if each["current"]] == ["sample_chair_003"]
    assert ranking["none"] is not None


def test_points_that_the_library_lacks_do_not_count(case: Case, library: Path) -> None:
    session = opened(case, library)
    place_all(session, case, count=3)
    perform(session, 0, {"do": "place_uv", "uv": [300, 200]})
    perform(session, 0, {"do": "pick", "origin": [0.02, 3, 0.03], "direction": [0, -1, 0]})
    (clicked,) = session.photos[0].document.keypoints - dict(case.clicks[:3]).keys()
    choice = session.choice
    assert choice is not None
    assert clicked > max(choice.ids)
    ranking = ranking_state(session, 0)
    assert ranking["models"] == []
    assert ranking["note"].startswith("Mark 1 more of the named keypoints")
    place(session, *case.clicks[3])
    assert "1 of other points don't count" in ranking_state(session, 0)["note"]


def test_switch_keeps_pairs_by_name_and_is_saved(case: Case, library: Path) -> None:
    session = opened(case, library)
    place_all(session, case, count=6)
    perform(session, 0, {"do": "rename", "pair": 2, "name": "left knee"})
    perform(session, 0, {"do": "place_uv", "uv": [300, 200]})
    perform(session, 0, {"do": "pick", "origin": [0.02, 3, 0.03], "direction": [0, -1, 0]})
    before = session.photos[0].document.pairs
    other = other_chair(library)
    outcome = perform(session, 0, {"do": "model", "category": "chair", "model": "sample_chair_003"})
    pairs = session.photos[0].document.pairs
    registry = session.photos[0].model.registry
    on_both = {number for number, _ in registry}
    for old, new in zip(before, pairs, strict=True):
        assert new.uv == old.uv
        assert new.keypoint == (old.keypoint if old.keypoint in on_both else None)
    assert pairs[-1].keypoint is None
    assert "no keypoint on this model: click on it" in outcome.message
    assert registry[pairs[1].keypoint or 0].name == "left knee"
    state = page_state(session, 0)
    assert state["image"]["model_number"] == 1
    assert state["alignment"]["status"] == "done"

    observation = Observation.load(case.observation)
    assert observation.model is not None
    assert observation.model.samefile(other)
    shown = Library.open(library)["chair", "sample_chair_003"]
    for number, xyz in zip(observation.ids.tolist(), observation.points_3d.tolist(), strict=True):
        row = shown.ids.tolist().index(number)
        assert xyz == shown.xyz[row].tolist()

    # Undo goes on with the new model, and a restart without MODEL finds it.
    perform(session, 0, {"do": "undo"})
    assert len(session.photos[0].document.keypoints) == sum(
        pair.keypoint is not None for pair in pairs
    )
    options = FileOptions(library=library, category="chair")
    assert starting_model(options, case.photo).samefile(other)
    again = opened(case, library, model=other)
    assert again.photos[0].document.keypoints == session.photos[0].document.keypoints
    assert again.models[0].registry[pairs[1].keypoint or 0].name == "left knee"


def test_begins_with_the_model_of_the_most_keypoints(case: Case, library: Path) -> None:
    first = starting_model(FileOptions(library=library, category="chair"), case.photo)
    models = [model for model in Library.open(library) if model.category == "chair"]
    most = max(len(model.ids) for model in models)
    (chosen,) = (model for model in models if model.mesh_path == first)
    assert len(chosen.ids) == most


def test_names_carry_where_ids_do_not() -> None:
    def registry(*points: tuple[str, int]) -> KeypointRegistry:
        return KeypointRegistry(ModelKeypoint(name, (0.0, 0.0, 0.0), k) for name, k in points)

    old = registry(("seat", 0), ("knob", 7), ("tip", 9))
    new = registry(("keypoint 0", 0), ("tip", 4), ("keypoint 7", 7))
    assert carry_keypoints(old, new, {0}) == {0: 0, 9: 4}
    assert new[0].name == "seat"


def test_refusals_name_the_option(
    case: Case, library: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ("annotate", "--no-open", "--image", case.photo)
    assert "--category: unknown category 'sofa'" in refusal_line(
        capsys, *given, "--library", library, "--category", "sofa"
    )
    assert "--category: names a category of a library" in refusal_line(
        capsys, *given, "--model", case.model, "--category", "chair"
    )
    session = opened(case, library)
    with pytest.raises(CadalignError, match="there is no model 'x' of 'chair'"):
        perform(session, 0, {"do": "model", "category": "chair", "model": "x"})
    with pytest.raises(CadalignError, match="the session has no library"):
        perform(case.open(), 0, {"do": "model", "category": "chair", "model": "x"})


def test_thumbnails_show_the_models(case: Case, library: Path) -> None:
    session = opened(case, library)
    choice = ModelChoice.open(FileOptions(library=library, category="chair"))
    assert choice is not None
    with served(session) as access:
        client = httpx.Client(base_url=access.address, headers={"X-Cadalign-Token": access.token})
        pictures = {client.get(f"/library/{number}.jpg").content for number in range(6)}
        assert len(pictures) == 6
        assert client.get("/models/0").json()["models"] == []
        client.close()


def test_model_is_chosen_by_keys_alone_and_by_a_click(
    browser: Browser, case: Case, library: Path
) -> None:
    session = opened(case, library, model=other_chair(library))
    known = dict(session.models[0].registry)
    for keypoint, uv in case.clicks:
        if keypoint in known:
            place(session, keypoint, uv)
    marked = len(session.photos[0].document.complete_pairs)
    with opened_page(browser, session) as page:
        page.keyboard.press("q")
        cards = page.locator("dialog[open] .models button")
        expect(cards).to_have_count(6)
        expect(cards.first).to_contain_text("1. sample_chair_000")
        expect(page.locator("dialog[open]")).to_contain_text("None of these: ")
        before = page.evaluate("annotator.model.mesh.uuid")
        page.keyboard.press("1")
        wait(page, f"{IDLE} && annotator.model.mesh.uuid !== '{before}'")
        assert session.photos[0].model.path.samefile(case.model)
        assert len(session.photos[0].document.complete_pairs) == marked
        expect(page.locator("dialog[open]")).to_have_count(0)
        page.get_by_role("button", name="Models…").click()
        expect(page.locator("dialog[open] [aria-current]")).to_contain_text("sample_chair_000")
        page.keyboard.press("0")
        expect(page.locator("dialog[open]")).to_have_count(0)
        page.keyboard.press("q")
        before = page.evaluate("annotator.model.mesh.uuid")
        page.get_by_role("button", name=re.compile("sample_chair_003")).click()
        wait(page, f"{IDLE} && annotator.model.mesh.uuid !== '{before}'")
        assert session.photos[0].model.path.samefile(other_chair(library))
