"""`cadalign retrieve` and `cadalign library`: tables, files, pictures, refusals."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from support.files import write_json
from support.refusals import refusal_line

from cadalign import Library
from cadalign.cli import main
from cadalign.datasets import KeypointNet, write_sample_dataset
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA as CAMERA
from cadalign.io.meshes.files import load_mesh
from cadalign.io.observation import Observation
from cadalign.render import Frame, RaycastRenderer, Scene, look_at
from cadalign.retrieval import Match
from cadalign.retrieval.folder import draw_match


@dataclass(frozen=True)
class Case:
    """A photo of a stretched chair, its keypoints, and a library with the chair."""

    folder: Path
    library: Library
    model_id: str
    frame: Frame
    observation: Observation

    @property
    def photo(self) -> np.ndarray:
        return self.frame.composite()

    def retrieve(self, **options: Any) -> list[Match]:
        seen = self.observation
        return self.library.retrieve(seen.points_2d, seen.ids, CAMERA, **options)

    @property
    def arguments(self) -> list[str]:
        return [str(self.folder / "seen.json"), "--library", str(self.folder / "lib.cadalign")]


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Case:
    folder = tmp_path_factory.mktemp("retrieval")
    root = write_sample_dataset(folder / "sample", per_category=4, categories=["chair", "bottle"])
    library = Library.from_models(KeypointNet(root))
    library.save(folder / "lib.cadalign")
    model = library["chair", "sample_chair_002"]
    pose = look_at(azimuth=40.0, elevation=25.0, distance=2.6, scale=(1.0, 1.3, 0.8))
    frame = RaycastRenderer().render(Scene(load_mesh(model.mesh_path)), CAMERA, pose)
    cv2.imwrite(str(folder / "photo.png"), frame.composite()[..., ::-1])
    cv2.imwrite(str(folder / "mask.png"), 255 * frame.mask.astype(np.uint8))
    noise = np.random.default_rng(0).standard_normal((len(model.xyz), 2))
    observation = Observation(
        points_3d=np.zeros((len(model.xyz), 3)),
        points_2d=CAMERA.project(pose.apply(model.xyz)) + noise,
        camera=CAMERA,
        ids=model.ids,
        image=folder / "photo.png",
    )
    observation.save(folder / "seen.json")
    return Case(folder, library, model.model_id, frame, observation)


# --- the commands ----------------------------------------------------------------------------


@pytest.mark.long
def test_a_library_is_built_and_shown(
    case: Case, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "deep" / "all.cadalign"
    assert main(["library", "build", str(case.folder / "sample"), "--out", str(out)]) == 0
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "8 models: 4 bottle, 4 chair" in captured.err
    assert out.read_bytes() == (case.folder / "lib.cadalign").read_bytes()
    assert main(["library", "show", str(out)]) == 0
    assert capsys.readouterr().out == "8 models: 4 bottle, 4 chair\n"
    chairs = ["--categories", "chair", "--split", "train", "--out", str(tmp_path / "some")]
    assert main(["library", "build", str(case.folder / "sample"), *chairs]) == 0
    assert Library.open(tmp_path / "some").categories == ("chair",)


def test_models_with_malformed_annotations_are_left_out_and_counted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = write_sample_dataset(tmp_path / "sample", per_category=2, categories=["chair"])
    path = root / "annotations" / "chair.json"
    entries = json.loads(path.read_text())
    del entries[0]["keypoints"]
    path.write_text(json.dumps(entries))
    assert main(["library", "build", str(root), "--out", str(tmp_path / "lib")]) == 0
    assert "Left out: 1 models with malformed annotations" in capsys.readouterr().err
    assert len(Library.open(tmp_path / "lib")) == 1


def test_only_the_first_of_several_photos_is_a_query(
    case: Case, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "two.json"
    replace(case.observation, others=(case.observation,)).save(path)
    assert main(["retrieve", str(path), *case.arguments[1:]]) == 0
    assert f"{path}: models are ranked by the first of its 2 photos alone" in caplog.text


def test_a_table_of_the_matches_is_printed(case: Case, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["retrieve", *case.arguments, "--top", "3"]) == 0
    lines = capsys.readouterr().out.splitlines()
    matches = case.retrieve(top=3)
    assert lines[0].split()[:3] == ["category", "model", "score"]
    assert len(lines) == 5
    assert lines[2].split()[:4] == ["1", "chair", case.model_id, "100.0"]
    assert f"{matches[0].rms:.2f}  13/13" in lines[2].replace("   ", "  ")
    assert all(text in lines[2] for text in matches[0].stretch_texts)


@pytest.mark.long
def test_table_and_file_have_none_probability(
    case: Case, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    others = Library.from_models(m for m in case.library if m.model_id != case.model_id)
    others.save(tmp_path / "others.cadalign")
    seen = str(case.folder / "seen.json")
    options = ["--library", str(tmp_path / "others.cadalign"), "--out", str(tmp_path / "out")]
    assert main(["retrieve", seen, *options]) == 0
    said = capsys.readouterr().err
    assert "None of these: 100.0 %" in said
    saved = json.loads((tmp_path / "out" / "matches.json").read_text("utf-8"))
    assert saved[0]["none_probability"] > 0.999
    assert main(["retrieve", *case.arguments]) == 0
    assert "None of these: 100" not in capsys.readouterr().err


def test_matches_as_json_are_those_of_the_library(
    case: Case, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--sigma", "2", "--category", "chair", "--loss", "cauchy", "--json"]
    assert main(["retrieve", *case.arguments, *options]) == 0
    expected = case.retrieve(sigma=2.0, category="chair", loss="cauchy")
    found = json.loads(capsys.readouterr().out)
    assert found == [match.to_dict() for match in expected]
    assert found[0]["camera"] == CAMERA.to_dict()


def test_refused_options_are_named_as_they_are_typed(
    case: Case, capsys: pytest.CaptureFixture[str]
) -> None:
    assert refusal_line(capsys, "retrieve", *case.arguments, "--shape-sigma", "-1") == (
        "--shape-sigma: must be >= 0, not -1.0"
    )
    assert refusal_line(capsys, "retrieve", *case.arguments, "--workers", "2") == (
        "--workers: has no effect on one observation; leave it out"
    )
    assert refusal_line(capsys, "retrieve", *case.arguments, "--category", "tabel").startswith(
        "--category: unknown category 'tabel'; known are "
    )


def test_the_sigma_of_the_file_is_used(case: Case, capsys: pytest.CaptureFixture[str]) -> None:
    path = case.folder / "sigmas.json"
    sigma = np.linspace(1, 3, 13)
    replace(case.observation, sigma=sigma).save(path)
    assert main(["retrieve", str(path), *case.arguments[1:], "--json"]) == 0
    expected = [match.to_dict() for match in case.retrieve(sigma=sigma)]
    assert json.loads(capsys.readouterr().out) == expected


def test_an_observation_of_a_mask_alone_is_refused(
    case: Case, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    view = {"camera": CAMERA.to_dict(), "mask": str(case.folder / "mask.png")}
    path = write_json(tmp_path / "seen.json", {"views": [view]})
    text = refusal_line(capsys, "retrieve", path, *case.arguments[1:])
    assert text == f"{path}: there are no keypoints"


@pytest.mark.long
def test_a_missing_photo_only_matters_for_pictures(
    case: Case, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, gone = tmp_path / "moved.json", tmp_path / "gone.png"
    replace(case.observation, image=gone).save(path)
    arguments = [str(path), *case.arguments[1:]]
    assert main(["retrieve", *arguments]) == 0
    assert case.model_id in capsys.readouterr().out
    text = refusal_line(capsys, "retrieve", *arguments, "--out", str(tmp_path / "out"))
    assert text == f"{gone}: no such file"
    assert not (tmp_path / "out").exists()


@pytest.mark.long
def test_a_folder_has_the_matches_and_their_pictures(
    case: Case, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(["retrieve", *case.arguments, "--top", "4", "--out", str(out)]) == 0
    assert f"Pictures: {out / 'matches.png'}" in capsys.readouterr().err
    written = [f"overlay_{place:02d}.png" for place in range(1, 5)]
    seen = [f"match_{place:02d}.json" for place in range(1, 5)]
    names = [*seen, "matches.json", "matches.png", *written]
    assert sorted(path.name for path in out.iterdir()) == names
    matches = case.retrieve(top=4)
    assert json.loads((out / "matches.json").read_text()) == [m.to_dict() for m in matches]
    first = cv2.imread(str(out / written[0]))[..., ::-1]
    np.testing.assert_array_equal(first, draw_match(case.photo, matches[0]))
    assert min(cv2.imread(str(out / "matches.png")).shape[:2]) > 2 * 480


@pytest.mark.slow
def test_an_observation_is_not_retrieved_into_its_own_folder(
    case: Case, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["retrieve", *case.arguments, "--top", "2", "--out", str(tmp_path)]) == 0
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.*")}
    query = tmp_path / "match_02.json"
    assert main(["retrieve", str(query), *case.arguments[1:], "--out", str(tmp_path)]) == 1
    assert f"{query}: this file is an input and would be overwritten" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.*")} == before


# --- refusals --------------------------------------------------------------------------------


def test_a_query_needs_ids_or_names_but_no_xyz(
    case: Case, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = json.loads((case.folder / "seen.json").read_text())
    for keypoint in data["keypoints"]:
        del keypoint["xyz"]
    data["image"] = None if "image" not in data else str(case.folder / "photo.png")
    path, options = str(write_json(tmp_path / "bare.json", data)), case.arguments[1:]
    assert main(["retrieve", path, *options]) == 0
    whole = capsys.readouterr().out
    assert main(["retrieve", *case.arguments]) == 0
    assert capsys.readouterr().out == whole
    for keypoint in data["keypoints"]:
        keypoint["name"] = f"Keypoint_{keypoint.pop('semantic_id')}"
    write_json(Path(path), data)
    assert main(["retrieve", path, *options]) == 0
    assert capsys.readouterr().out == whole
    for keypoint in data["keypoints"]:
        del keypoint["name"]
    write_json(Path(path), data)
    line = refusal_line(capsys, "retrieve", path, *options)
    assert f"{path}: the keypoints have no semantic_id and no name; give each" in line


def test_errors_of_the_library_are_one_line(
    case: Case, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    seen = case.arguments[0]
    nowhere = refusal_line(capsys, "retrieve", seen, "--library", str(tmp_path / "no"))
    assert nowhere == f"{tmp_path / 'no'}: no such file"
    assert "no such folder" in refusal_line(capsys, "library", "build", str(tmp_path / "none"))
    (tmp_path / "lib").write_text("something else that is a file of more than sixty-four bytes ...")
    assert "not a library file" in refusal_line(capsys, "library", "show", str(tmp_path / "lib"))
