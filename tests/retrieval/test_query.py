"""Ids of an observation's keypoints in a library, with names of the library or of a shape."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.files import write_json
from support.refusals import refusal_text

from cadalign import Alignment, Camera, Library, Observation, ShapeModel
from cadalign.cli import main
from cadalign.retrieval import LibraryModel
from cadalign.retrieval.query import ObservationRetrieval, relabel

CAMERA = Camera(640, 480, fx=900.0, fy=900.0, cx=319.5, cy=239.5)
POSE = Alignment(
    np.array([[0.8, 0, 0.6], [0, -1, 0], [0.6, 0, -0.8]]), [0.0, 0.0, 3.0], [1.0, 1.0, 1.0]
)
LAPTOP, CAP = ShapeModel.pretrained("laptop"), ShapeModel.pretrained("cap")


def exchange(name: str) -> str:
    return name.replace("right", "#").replace("left", "right").replace("#", "left")


SWAP = {exchange(name): name for name in CAP.names if exchange(name) != name}
"""The shape's name of the names of a library that calls left what the shape calls right."""
THEIRS = tuple(map(exchange, CAP.names))
OWN_IDS = np.arange(10, 10 + len(CAP.ids))


def library_of(
    names: Mapping[str, int], points: np.ndarray, ids: Sequence[int], category: str = "laptop"
) -> Library:
    """Four models of different proportions."""
    rng = np.random.default_rng(0)
    models = []
    for number in range(4):
        own = points * rng.uniform(0.8, 1.2, 3)
        bounds = np.array([own.min(axis=0), own.max(axis=0)])
        models.append(LibraryModel(category, f"{number}", own, np.array(ids), bounds))
    return Library.from_models(models, names=names)


def laptops(names: Mapping[str, int], ids: Sequence[int] = (7, 3, 5, 1)) -> Library:
    return library_of(names, LAPTOP.mean[: len(ids)], ids)


LIBRARY = {"fr": 7, "hr": 3, "hl": 5, "Screen, top-left": 1}
TABLE = {"fr": "keyboard, front right", "hr": 1, "hl": "hinge, left"}


def pairs(table: Mapping[str, Any]) -> tuple[tuple[str, Any], ...]:
    return tuple(table.items())


def test_a_library_with_other_names_needs_a_table() -> None:
    text = refusal_text(lambda: relabel(LAPTOP, laptops(LIBRARY), (), "my.cadalign"))
    assert "give keypoint_names" in text
    assert relabel(LAPTOP, laptops(LIBRARY), pairs(TABLE), "").ids == (7, 3, 5, 8, 9, 1)


def test_keypoints_that_the_library_lacks_do_not_get_ids_of_unnamed_ones() -> None:
    library = laptops(LIBRARY, (7, 3, 5, 1, 8, 9))
    assert relabel(LAPTOP, library, pairs(TABLE), "").ids == (7, 3, 5, 10, 11, 1)


@pytest.mark.parametrize(
    ("names", "table", "text"),
    [
        (LIBRARY, {"x": 0}, "keypoint_names: unknown keypoint of the library 'x'"),
        (LIBRARY, {"fr": 99}, "keypoint_names: laptop has no keypoint 99"),
        (
            LIBRARY,
            {"fr": "hinge, right", "hr": 1},
            "keypoint_names: 'fr' and 'hr' are one keypoint of laptop; give each name a keypoint",
        ),
        (
            LIBRARY | {"Hinge, right": 4},
            TABLE,
            "keypoint_names: 'hr' and 'Hinge, right' are one keypoint of laptop; give each",
        ),
        (
            LIBRARY | {"hl": 7},
            TABLE,
            "keypoint_names: 'fr' and 'hl' are one keypoint of the library; give each",
        ),
        (
            {"hinge, left": 5, "hinge, right": 5, "screen, top left": 1},
            {},
            "here: 'hinge, left' and 'hinge, right' are one keypoint of the library; give each",
        ),
    ],
)
def test_names_that_mean_two_keypoints_are_refused(
    names: dict[str, int], table: dict[str, str | int], text: str
) -> None:
    found = refusal_text(lambda: relabel(LAPTOP, laptops(names), pairs(table), "here"))
    assert found.startswith(text)


def test_two_names_of_one_keypoint_are_no_contradiction() -> None:
    names, table = LIBRARY | {"front": 7, "corner": 7}, TABLE | {"corner": LAPTOP.ids[0]}
    assert relabel(LAPTOP, laptops(names), pairs(table), "").ids == (7, 3, 5, 8, 9, 1)


# --- observations ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def caps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a library of caps that calls left what the shape calls right, and a table."""
    folder = tmp_path_factory.mktemp("caps")
    named = dict(zip(THEIRS, OWN_IDS.tolist(), strict=True))
    library = library_of(named, CAP.mean[:-2], OWN_IDS.tolist(), "cap")
    library.save(folder / "caps.cadalign")
    write_json(folder / "table.json", SWAP)
    return folder


def seen_cap(**fields: Any) -> Observation:
    points = CAP.mean[:-2]
    return Observation(np.zeros_like(points), CAMERA.project(POSE.apply(points)), CAMERA, **fields)


def how_of(caps: Path) -> ObservationRetrieval:
    table = caps / "table.json"
    return ObservationRetrieval(
        library=caps / "caps.cadalign", shape=Path("cap"), keypoint_names=table
    )


@pytest.mark.parametrize(
    "fields",
    [
        {"ids": OWN_IDS},
        {"ids": OWN_IDS, "names": THEIRS},
        {"ids": OWN_IDS, "names": CAP.names},
        {"ids": OWN_IDS, "names": [f"k{row}" for row in OWN_IDS]},
        {"names": THEIRS},
        {"ids": np.arange(len(THEIRS)), "names": THEIRS},  # the user's own numbers
        {"names": [name.upper().replace(" ", "_") for name in THEIRS]},
    ],
)
def test_all_ids_and_names_of_a_keypoint_resolve_to_the_library(
    caps: Path, fields: dict[str, Any]
) -> None:
    resolved = how_of(caps).resolve_ids(seen_cap(**fields), "cap.json")
    assert resolved.ids is not None
    assert resolved.ids.tolist() == OWN_IDS.tolist()
    assert resolved.names == CAP.names


@pytest.mark.parametrize("ids", [None, np.array(CAP.ids)])
def test_names_of_the_shape_resolve_to_ids_of_the_library(tmp_path: Path, ids: Any) -> None:
    library = library_of(dict(zip("fedcba", OWN_IDS.tolist(), strict=False)),
                         CAP.mean[:-2], OWN_IDS.tolist(), "cap")  # fmt: skip
    library.save(tmp_path / "caps.cadalign")
    write_json(tmp_path / "table.json", dict(zip("fedcba", CAP.names, strict=False)))
    seen = seen_cap(ids=ids, names=CAP.names)
    resolved = how_of(tmp_path).resolve_ids(seen, "cap.json")
    assert resolved.ids is not None
    assert resolved.ids.tolist() == OWN_IDS.tolist()


def test_names_that_neither_has_are_refused(caps: Path) -> None:
    seen = seen_cap(names=[f"k{row}" for row in OWN_IDS])
    text = refusal_text(lambda: how_of(caps).resolve_ids(seen, "cap.json"))
    assert text.startswith("cap.json: ids: no model of the library has a keypoint 'k10'; it has ")


def test_matches_in_a_library_with_other_names_do_not_depend_on_the_labels(
    caps: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = Library.open(caps / "caps.cadalign")["cap", "2"]
    pixels = CAMERA.project(POSE.apply(model.xyz))
    options = ["--library", str(caps / "caps.cadalign"), "--shape", "cap", "--sigma", "0.2"]
    options += ["--keypoint-names", str(caps / "table.json")]
    tables = []
    for fields in ({"ids": OWN_IDS}, {"ids": OWN_IDS, "names": THEIRS}, {"names": THEIRS}):
        seen = replace(seen_cap(**fields), points_2d=pixels)
        seen.save(tmp_path / "cap.json")
        assert main(["retrieve", str(tmp_path / "cap.json"), *options]) == 0
        tables.append(capsys.readouterr().out)
    assert tables[0].splitlines()[2].split()[1:3] == ["cap", "2"]
    assert tables == [tables[0]] * 3
