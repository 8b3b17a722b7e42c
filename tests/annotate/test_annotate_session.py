"""A session without its page: actions, written files, and reopening."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from support.annotating import Case, fitted, place, place_all
from support.refusals import refusal_text

from cadalign import Camera
from cadalign.annotate.actions import perform
from cadalign.annotate.files import SessionOptions
from cadalign.annotate.page_state import page_state
from cadalign.annotate.photos import PhotoFile, find_photos
from cadalign.annotate.session import Session, open_session
from cadalign.datasets import ModelKeypoint, ModelKeypoints
from cadalign.errors import DataError, InputError
from cadalign.io.observation import Observation

pytestmark = pytest.mark.long

# Down onto the seat, in the page's coordinates.
FROM_ABOVE = {"origin": [0.02, 3, 0.03], "direction": [0, -1, 0]}


def comparable(state: dict[str, Any]) -> dict[str, Any]:
    """A state without the parts of one session: undo, times, the numbers of pairs."""
    left_out = {"saved", "selected", "message", "can_undo", "can_redo"}
    kept = {key: value for key, value in state.items() if key not in left_out}
    kept["pairs"] = [{k: v for k, v in pair.items() if k != "pair"} for pair in state["pairs"]]
    return json.loads(json.dumps(kept))


def alignment_of(session: Session) -> dict[str, Any]:
    """The current alignment of the first photo."""
    result = session.live(session.photos[0]).result
    assert result is not None
    return result.alignment.to_dict()


def focal_of(session: Session) -> float:
    """The focal length of the current alignment [px]."""
    result = session.live(session.photos[0]).result
    assert result is not None
    return result.camera.fx


# --- what is written -------------------------------------------------------------------------


def test_nothing_is_written_before_anything_is_placed(case: Case) -> None:
    before = sorted(case.folder.rglob("*"))
    session = case.open()
    page_state(session, 0)
    assert sorted(case.folder.rglob("*")) == before


def test_file_gives_the_same_alignment_as_the_page(
    case: Case, capsys: pytest.CaptureFixture[str]
) -> None:
    session = case.open()
    state = place_all(session, case)
    assert state["alignment"]["status"] == "done"
    assert fitted(case, capsys)["alignment"] == alignment_of(session)
    observation = Observation.load(case.observation)
    assert observation.ids is not None
    assert observation.ids.tolist() == case.instance.ids.tolist()
    np.testing.assert_array_equal(observation.points_2d, case.instance.points_2d)
    assert observation.camera == case.instance.camera
    assert observation.image is not None
    assert observation.model is not None
    assert observation.image.resolve() == case.photo.resolve()
    assert observation.model.resolve() == case.model.resolve()


def test_every_change_is_on_disk_at_once_and_found_again(case: Case) -> None:
    session = case.open()
    ids = [keypoint for keypoint, _ in case.clicks]
    actions: list[dict[str, Any]] = [
        {"do": "place_uv", "uv": case.clicks[0][1]},
        {"do": "place_keypoint", "keypoint": ids[0]},
        {"do": "place_keypoint", "keypoint": ids[1]},
        {"do": "place_uv", "uv": case.clicks[1][1]},
        {"do": "pick", **FROM_ABOVE},
        {"do": "rename", "pair": 1, "name": "the first"},
        {"do": "move", "pair": 1, "uv": [5.25, 6.5]},
        {"do": "release", "pair": 2},
        {"do": "delete", "pair": 1},
        {"do": "undo"},
        {"do": "redo"},
        {"do": "focal", "pixels": 800},
    ]
    for action in actions:
        perform(session, 0, action)
        for keypoints in (case.keypoints, None):
            again = case.open(keypoints=keypoints)
            assert comparable(page_state(again, 0)) == comparable(page_state(session, 0)), action


def test_unfinished_halves_are_in_the_observation_while_there_are_any(case: Case) -> None:
    session = case.open()

    def unfinished() -> object:
        return json.loads(case.observation.read_text()).get("unfinished")

    perform(session, 0, {"do": "place_uv", "uv": [10, 20]})
    perform(session, 0, {"do": "place_uv", "uv": [30, 40]})
    assert unfinished() == {"pairs": [{"uv": [10, 20]}, {"uv": [30, 40]}]}
    perform(session, 0, {"do": "place_keypoint", "keypoint": 0})
    assert unfinished() == {"pairs": [{"uv": [30, 40]}]}
    assert Observation.load(case.observation).draft == unfinished()
    perform(session, 0, {"do": "delete", "pair": 2})
    assert unfinished() is None


def test_the_observation_alone_holds_all_that_is_marked(case: Case) -> None:
    session = case.open(keypoints=None)
    perform(session, 0, {"do": "pick", **FROM_ABOVE})
    perform(session, 0, {"do": "rename", "pair": 1, "name": "seat"})
    for keypoint, uv in case.clicks[:4]:
        xyz = case.instance.points_3d[case.instance.ids.tolist().index(keypoint)].tolist()
        point = ModelKeypoint(f"keypoint {keypoint}", tuple(xyz), 100 + keypoint)
        place(session, session.model.registry.add(point), uv)
    (case.folder / "sample_chair_000.keypoints.json").unlink()
    again = case.open(keypoints=None)
    unnumbered = [
        sorted((p["name"], p["uv"], tuple(p["xyz"])) for p in page_state(each, 0)["pairs"])
        for each in (session, again)
    ]
    assert unnumbered[0] == unnumbered[1]


def test_a_renamed_keypoint_is_so_in_every_photo_that_shows_it(case: Case) -> None:
    shutil.copy(case.photo, case.folder / "second.png")
    session = case.open(image=case.folder, prepared=False)
    for number in (0, 1):
        place(session, 0, [10, 20], image=number)
    perform(session, 0, {"do": "rename", "pair": 1, "name": "corner"})
    assert Observation.load(case.folder / "second.json").names == ("corner",)


def test_errors_of_saving_are_shown_and_nothing_is_lost(
    case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = case.open()

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr("os.replace", full)
        perform(session, 0, {"do": "place_uv", "uv": [10, 20]})
    state = page_state(session, 0)
    assert "No space left on device" in state["saved"]["trouble"]
    assert len(state["pairs"]) == 1
    assert not list(case.folder.glob(".unfinished-*"))
    perform(session, 0, {"do": "place_uv", "uv": [30, 40]})
    assert page_state(session, 0)["saved"]["trouble"] == ""
    assert len(page_state(case.open(), 0)["pairs"]) == 2


def test_an_observation_that_others_changed_is_not_written_over(case: Case) -> None:
    session = case.open(prepared=False)
    place(session, 0, [10, 20])
    data = json.loads(case.observation.read_text()) | {"object": "seat"}
    case.observation.write_text(json.dumps(data))
    for action in ({"do": "place_uv", "uv": [30, 40]}, {"do": "delete", "pair": 1}):
        perform(session, 0, action)
        assert page_state(session, 0)["saved"]["trouble"] == (
            f"{case.observation}: was changed by another program since the annotator read or wrote "
            "it; rename it to save the marks of this session, or restart to go on from it"
        )
        assert json.loads(case.observation.read_text()) == data
    perform(session, 0, {"do": "undo"})
    case.observation.rename(case.folder / "theirs.json")
    perform(session, 0, {"do": "place_uv", "uv": [50, 60]})
    assert page_state(session, 0)["saved"]["trouble"] == ""
    assert len(page_state(case.open(prepared=False), 0)["pairs"]) == 3


def test_keypoints_that_others_changed_are_not_written_over(case: Case) -> None:
    session = case.open(prepared=False)
    place(session, 0, [10, 20])
    keypoints = case.folder / "sample_chair_000.keypoints.json"
    theirs = keypoints.read_text().replace("keypoint 1", "armrest")
    keypoints.write_text(theirs)
    perform(session, 0, {"do": "place_uv", "uv": [30, 40]})
    trouble = page_state(session, 0)["saved"]["trouble"]
    assert trouble.startswith(f"{keypoints}: was changed by another program")
    assert keypoints.read_text() == theirs
    keypoints.rename(case.folder / "theirs.json")
    perform(session, 0, {"do": "place_uv", "uv": [50, 60]})
    assert page_state(session, 0)["saved"]["trouble"] == ""
    assert keypoints.exists()


def test_what_an_observation_says_of_its_keypoints_is_kept(case: Case) -> None:
    instance = case.instance
    count = len(instance.points_3d)
    sigma, scores = np.linspace(0.5, 3, count), np.linspace(0, 0.9, count)
    names = tuple(f"detected {k}" for k in range(count))
    Observation(
        instance.points_3d,
        instance.points_2d,
        instance.camera,
        sigma=sigma,
        names=names,
        scores=scores,
    ).save(case.observation)
    session = case.open()
    perform(session, 0, {"do": "place_uv", "uv": [10, 20]})
    perform(session, 0, {"do": "pick", **FROM_ABOVE})
    written = Observation.load(case.observation)
    assert written.sigma is not None
    assert written.names is not None
    assert written.scores is not None
    assert written.sigma.tolist() == [*sigma.tolist(), 1.0]
    assert written.names[:-1] == names
    assert written.scores.tolist() == [*scores.tolist(), 1.0]


# --- actions ---------------------------------------------------------------------------------


def test_click_near_a_keypoint_takes_it(case: Case) -> None:
    session = case.open(prepared=False)
    perform(session, 0, {"do": "pick", **FROM_ABOVE, "near": 4})
    assert session.photos[0].marks.pairs[0].keypoint == 4


@pytest.mark.parametrize(
    ("action", "message"),
    [
        ({}, "do: None is not an action; known are place_uv, "),
        ({"do": "__init__"}, "do: '__init__' is not an action; "),
        ({"do": "place_uv"}, "uv: missing"),
        ({"do": "place_uv", "uv": [1, float("nan")]}, "uv[1]: nan is not a finite number"),
        ({"do": "place_uv", "uv": [-1, 2]}, "uv: (-1.0, 2.0) is outside the photo"),
        ({"do": "place_uv", "uv": [1, 2], "pair": "1"}, "pair: '1' is not a whole number"),
        ({"do": "place_keypoint", "keypoint": 999}, "keypoint: there is no keypoint 999"),
        (
            {"do": "pick", "origin": [0, 0, 1], "direction": [0, 0, 0]},
            "direction: the vector is zero",
        ),
        ({"do": "move", "pair": 7, "uv": [1, 2]}, "pair: there is no pair 7; reload the page"),
        ({"do": "focal", "pixels": 0}, "pixels: 0 px is not a focal length of this"),
    ],
)
def test_bad_actions_are_refused_and_change_nothing(
    original: Case, action: dict[str, Any], message: str
) -> None:
    session = open_session(
        SessionOptions(image=original.photo, model=original.model, keypoints=original.keypoints)
    )
    assert refusal_text(lambda: perform(session, 0, action)).startswith(message)
    assert session.photos[0].marks.pairs == ()
    assert not original.observation.exists()


# --- focal length ----------------------------------------------------------------------------


def test_focal_length_can_be_said_to_be_known_and_not(case: Case) -> None:
    session, true = case.open(), case.instance.camera.fx
    place_all(session, case)
    perform(session, 0, {"do": "focal", "pixels": None})
    estimated = focal_of(session)
    assert estimated != true
    assert not case.open().photos[0].marks.camera.focal_known  # the file says so
    perform(session, 0, {"do": "focal", "pixels": true})
    assert focal_of(session) == true
    perform(session, 0, {"do": "undo"})
    assert focal_of(session) == estimated


def test_camera_of_an_observation_is_used(case: Case) -> None:
    instance = case.instance
    Observation(instance.points_3d, instance.points_2d, instance.camera).save(case.observation)
    state = page_state(case.open(camera=None), 0)
    assert state["focal"]["known"]
    assert state["focal"]["pixels"] == instance.camera.fx
    assert len(state["pairs"]) == len(instance.points_3d)


def exif_photo(path: Path, *, orientation: int = 1, focal_35mm: int | None = None) -> None:
    """Write a photo with a red left half, stored in the given EXIF orientation."""
    pixels = np.zeros((300, 400, 3), dtype=np.uint8)
    pixels[:, :200, 0] = 250
    image = Image.fromarray(pixels)
    turns = {6: Image.Transpose.ROTATE_90, 8: Image.Transpose.ROTATE_270}
    if orientation in turns:
        image = image.transpose(turns[orientation])
    exif = Image.Exif()
    exif[0x0112] = orientation
    if focal_35mm is not None:
        exif[0x8769] = {0xA405: focal_35mm}
    image.save(path, exif=exif, quality=95)


def test_exif_focal_length_is_a_hint(case: Case) -> None:
    photo = case.folder / "exif.jpg"
    exif_photo(photo, focal_35mm=50)
    state = page_state(case.open(camera=None, image=photo), 0)
    # 50 mm on a film of 43.27 mm diagonal; the photo's diagonal is 500 px.
    assert state["focal"]["pixels"] == pytest.approx(50 / 43.2666 * 500, rel=0.01)
    assert state["focal"]["prior"].startswith("about 578 px")
    assert not state["focal"]["known"]


# --- photos ----------------------------------------------------------------------------------


@pytest.mark.parametrize("orientation", [1, 6, 8])
def test_photos_are_shown_and_measured_upright(case: Case, orientation: int) -> None:
    path = case.folder / "turned.jpg"
    exif_photo(path, orientation=orientation)
    photo = PhotoFile.open(path)
    assert (photo.width, photo.height) == (400, 300)
    kind, data = photo.encode()
    assert kind == "image/jpeg"
    (case.folder / "shown.jpg").write_bytes(data)
    shown = np.asarray(Image.open(case.folder / "shown.jpg"))
    assert shown.shape == (300, 400, 3)
    assert shown[150, 50, 0] > 200
    assert shown[150, 350, 0] < 50
    assert (orientation == 1) == (data == path.read_bytes())
    session = case.open(camera=None, image=path)
    place_keypoint = {"do": "place_keypoint", "keypoint": 0}
    perform(session, 0, {"do": "place_uv", "uv": [390, 10]})
    perform(session, 0, place_keypoint)
    camera = Observation.load(case.folder / "turned.json").camera
    assert (camera.width, camera.height) == (400, 300)


def test_photo_and_camera_must_have_the_same_size(case: Case) -> None:
    case.camera.write_text(json.dumps(Camera.from_fov(100, 80, fov_x=50).to_dict()))
    assert refusal_text(case.open) == (
        f"{case.photo}: the photo has 640 x 480 pixels, the camera 100 x 80; "
        "give the camera of this photo"
    )


def test_photos_of_a_folder_come_in_turn_each_with_its_file(
    case: Case, caplog: pytest.LogCaptureFixture
) -> None:
    for name in ("b.png", "a.jpg", "b.jpg"):
        Image.open(case.photo).convert("RGB").save(case.folder / name)
    (case.folder / "broken.png").write_text("no photo")
    out = case.folder / "out"
    out.mkdir()
    session = case.open(image=case.folder, out=out)
    names = [photo.photo.path.name for photo in session.photos]
    assert names == ["a.jpg", "b.jpg", "b.png", "photo.png"]
    assert "left out: " in caplog.text
    assert "broken.png" in caplog.text
    place(session, 2, [20.0, 5], image=2)
    assert {"b.png.json", "sample_chair_000.keypoints.json"} == {p.name for p in out.iterdir()}
    assert Observation.load(out / "b.png.json").points_2d.tolist() == [[20, 5]]
    image = page_state(session, 2)["image"]
    assert (image["number"], image["count"], image["name"]) == (2, 4, "b.png")


def test_folder_without_photos_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"no photos in this folder; file names of photos end in .png"
    ):
        find_photos(tmp_path)
    (tmp_path / "x.png").write_text("no photo")
    with pytest.raises(DataError, match=r"none of the photos in this folder can be read$"):
        open_session(SessionOptions(image=tmp_path, model=tmp_path / "m.ply"))


def test_observation_goes_with_one_photo(case: Case) -> None:
    assert refusal_text(lambda: case.open(image=case.folder, observation=case.observation)) == (
        "--observation: names the file of a single photo, but a folder is given too; "
        "use --out for a folder of photos, and not both options"
    )


# --- files that are there already ------------------------------------------------------------


def test_files_of_others_are_never_overwritten(case: Case) -> None:
    case.observation.write_text('{"images": []}')
    assert refusal_text(case.open).startswith(f"{case.observation}: top level: unknown field ")
    assert case.observation.read_text() == '{"images": []}'
    case.observation.unlink()


def test_annotation_goes_on_with_a_renamed_model(
    case: Case, caplog: pytest.LogCaptureFixture
) -> None:
    former, model = case.folder / "former.ply", case.folder / "renamed.ply"
    shutil.copy(case.model, former)
    session = case.open(model=former, prepared=False)
    for keypoint, uv in case.clicks[:3]:
        place(session, keypoint, uv)
    former.rename(model)
    again = case.open(model=model, prepared=False)
    assert len(again.photos[0].marks.complete_pairs) == 3
    text = f"{case.observation}: its model {former} no longer exists, {model} is used instead"
    assert text in caplog.text
    perform(again, 0, {"do": "delete", "pair": 1})
    assert Observation.load(case.observation).model == model


def namesake(case: Case) -> Path:
    """Another model whose file has the same name."""
    other = case.folder / "other" / case.model.name
    other.parent.mkdir()
    shutil.copy(case.model, other)
    return other


def test_annotations_of_a_namesake_are_refused_and_kept(case: Case) -> None:
    place_all(case.open(), case)
    other = namesake(case)
    keypoints = case.folder / "sample_chair_000.keypoints.json"
    kept = case.observation.read_bytes(), keypoints.read_bytes()
    ours = f"belongs to the model {case.model.resolve()}, not {other.resolve()}; "
    fix = "give that model, or give another --observation or --out"
    assert refusal_text(lambda: case.open(model=other)) == f"{keypoints}: {ours}{fix}"
    assert (case.observation.read_bytes(), keypoints.read_bytes()) == kept
    keypoints.unlink()  # the observation is refused without its help
    assert refusal_text(lambda: case.open(model=other)) == f"{case.observation}: {ours}{fix}"
    assert case.observation.read_bytes() == kept[0]
    page_state(case.open(), 0)


def test_given_keypoints_without_ids_all_come(case: Case) -> None:
    given = ModelKeypoints.load(case.keypoints).keypoints
    bare = tuple(replace(point, semantic_id=None) for point in given)
    ModelKeypoints((given[0], *bare[1:])).save(case.keypoints)
    session = case.open()
    assert [point.name for _, point in session.model.registry] == [point.name for point in given]
    assert len(session.model.registry.file_ids) == len(given)


def test_observation_without_ids_is_matched_by_place(case: Case) -> None:
    ids = [keypoint for keypoint, _ in case.clicks]
    places = {p.semantic_id: p.xyz for p in ModelKeypoints.load(case.keypoints).keypoints}
    points = np.array([places[keypoint] for keypoint in ids])
    points[0] += 0.01  # no keypoint is here
    Observation(points, case.instance.points_2d, case.instance.camera).save(case.observation)
    session = case.open()
    keypoints = [pair.keypoint for pair in session.photos[0].marks.pairs]
    assert keypoints[1:] == ids[1:]
    assert keypoints[0] not in session.model.registry.file_ids


def test_session_prepares_its_solvers_before_it_fits(case: Case) -> None:
    session = open_session(SessionOptions(image=case.photo, model=case.model, camera=case.camera))
    assert isinstance(session, Session)
    state = page_state(session, 0)
    assert state["alignment"]["status"] == "preparing"
    session.warm_up()
    assert page_state(session, 0)["alignment"]["status"] == "none"
