"""Names of the annotator's files: every photo has its own, whatever its name."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from support.annotating import Case, place
from support.refusals import refusal_text

from cadalign.annotate.actions import perform
from cadalign.annotate.files import observation_file
from cadalign.annotate.page_state import page_state
from cadalign.datasets import ModelKeypoints
from cadalign.io.observation import Observation

AWKWARD = (
    *("x.jpg", "x.png", "X.webp", "x.jpg.jpg", "x.jpg.json.jpg", "x.unfinished.jpg", "y.png"),
    *("sample_chair_000.jpg", "sample_chair_000.png.png", "a" * 240 + ".jpg", "ä" * 120 + ".png"),
)


def write_observation(path: Path, case: Case, image: Path | None) -> Path:
    instance = case.instance
    Observation(instance.points_3d, instance.points_2d, instance.camera, image=image).save(path)
    return path


@pytest.mark.long
def test_every_photo_of_a_folder_keeps_its_own_pairs(case: Case) -> None:
    folder = case.folder / "awkward"
    folder.mkdir()
    photos = [folder / name for name in AWKWARD]
    for photo in photos:
        shutil.copy(case.photo, photo)
    session = case.open(image=folder)
    numbers = {state.photo.path.name: k for k, state in enumerate(session.photos)}
    assert set(numbers) == set(AWKWARD)
    for k, name in enumerate(AWKWARD):
        place(session, 0, [10.0 + k, 20], image=numbers[name])
        perform(session, numbers[name], {"do": "place_uv", "uv": [10.0 + k, 40]})  # a half
    for again in (case.open(image=folder), *(case.open(image=photo) for photo in photos)):
        for k, state in enumerate(again.photos):
            (first, half) = page_state(again, k)["pairs"]
            assert first["uv"] == (10.0 + AWKWARD.index(state.photo.path.name), 20)
            assert half["uv"][1] == 40
    assert ModelKeypoints.load(folder / "sample_chair_000.keypoints.json").keypoints


@pytest.mark.parametrize("option", ["image", "model"])
def test_names_with_no_room_for_an_ending_are_refused(case: Case, option: str) -> None:
    source = case.photo if option == "image" else case.model
    path = case.folder / f"{'m' * 251}{source.suffix}"
    shutil.copy(source, path)
    assert refusal_text(lambda: case.open(**{option: path})).endswith(
        "the name is too long for a file; rename the photo or model, or give --observation"
    )


def test_a_photo_has_its_usual_name_unless_another_photo_has_it(tmp_path: Path) -> None:
    photo, other = tmp_path / "x.jpg", tmp_path / "X.png"
    photo.write_text("")
    other.write_text("")
    first = observation_file(photo, tmp_path)
    assert first.name == "x.json"
    assert observation_file(other, tmp_path, [first]).name == "X.png.json"
    (tmp_path / "X.json").write_text(json.dumps({"image": "x.jpg"}))
    assert observation_file(other, tmp_path).name == "X.png.json"


@pytest.mark.long
@pytest.mark.parametrize("name", ["x.unfinished", "x.jpg", "x"])
def test_file_of_an_earlier_session_is_found_under_its_name(case: Case, name: str) -> None:
    photo = case.folder / f"{name}.jpg"
    shutil.copy(case.photo, photo)
    shutil.copy(case.photo, photo.with_suffix(".png"))
    earlier = write_observation(case.folder / f"{name}.json", case, photo)
    session = case.open(image=photo)
    assert len(page_state(session, 0)["pairs"]) == len(case.clicks)
    perform(session, 0, {"do": "delete", "pair": 1})
    assert len(Observation.load(earlier).points_2d) == len(case.clicks) - 1
    other = case.open(image=photo.with_suffix(".png"))
    assert page_state(other, 0)["pairs"] == []


@pytest.mark.long
def test_photos_of_one_name_in_two_folders_do_not_share_a_file(case: Case) -> None:
    second, third = (case.folder / name / case.photo.name for name in ("second", "third"))
    for copy in (second, third):
        copy.parent.mkdir()
        shutil.copy(case.photo, copy)
    out = case.folder / "out"
    out.mkdir()
    for k, photo in enumerate((case.photo, second)):
        place(case.open(image=photo, out=out), 0, [10 + k, 20])
    for k, photo in enumerate((case.photo, second)):
        (pair,) = page_state(case.open(image=photo, out=out), 0)["pairs"]
        assert pair["uv"] == (10 + k, 20)
    message = refusal_text(lambda: case.open(image=third, out=out))
    assert message == (
        f"{out}: photo.png.json belongs to another photo, not {third}; "
        "give another --observation or --out"
    )


@pytest.mark.parametrize("name", ["sample_chair_000.keypoints.json", "camera.json", "photo.png"])
def test_observation_in_another_files_place_is_refused(case: Case, name: str) -> None:
    path = case.folder / name
    before = path.read_bytes() if path.exists() else None
    assert refusal_text(lambda: case.open(observation=path)) == (
        f"{path}: would be written twice, or over a file that is read; "
        "rename it, or give another --observation or --out"
    )
    assert (path.read_bytes() if path.exists() else None) == before


@pytest.mark.parametrize("make", [Path.mkdir, os.mkfifo])
@pytest.mark.parametrize("name", ["photo.json", "sample_chair_000.keypoints.json"])
def test_folders_and_pipes_in_a_files_place_are_refused(
    case: Case, name: str, make: Callable[[Path], None]
) -> None:
    make(case.folder / name)
    assert refusal_text(case.open).startswith(f"{case.folder / name}: not a regular file; ")


@pytest.mark.long
def test_observation_of_another_photo_is_refused_by_name(case: Case) -> None:
    write_observation(case.observation, case, case.photo)
    other = case.folder / "other.png"
    shutil.copy(case.photo, other)
    assert refusal_text(lambda: case.open(image=other, observation=case.observation)) == (
        f"{case.observation}: belongs to the photo photo.png, not other.png; "
        "give another --observation, or correct the field image in this one"
    )
