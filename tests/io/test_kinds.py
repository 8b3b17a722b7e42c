"""Files of the wrong kind; fields that are missing or occur twice."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from support.files import TETRAHEDRON
from support.refusals import refusal_text

from cadalign import Result, load_mesh
from cadalign.datasets import ModelKeypoints, read_image_keypoints
from cadalign.errors import DataError
from cadalign.io.documents import parse_json
from cadalign.io.images import read_photo
from cadalign.io.observation import Observation, read_camera

CAMERA = {"model": "PINHOLE", "width": 640, "height": 480, "params": [900, 900, 320, 240]}
CONTENTS: dict[str, Any] = {
    "a photo": ("a.jpg", None),
    "a mesh": ("a.obj", TETRAHEDRON),
    "an observation": ("seen.json", {"camera": CAMERA, "keypoints": [{"xyz": [0, 0, 0]}]}),
    "a detector's keypoints": ("found.json", {"annotations": [], "images": []}),
    "keypoints of a model": (
        "a.keypoints.json",
        {"format": "cadalign model keypoints", "version": 1, "keypoints": []},
    ),
    "the result of a fit": ("fit.json", {"alignment": {}, "method": "optimal"}),
    "a camera": ("camera.json", CAMERA),
}
READERS: dict[str, Callable[[Path], Any]] = {
    "a photo": read_photo,
    "a mesh": load_mesh,
    "an observation": Observation.load,
    "a detector's keypoints": read_image_keypoints,
    "keypoints of a model": ModelKeypoints.load,
    "the result of a fit": Result.load,
    "a camera": read_camera,
}


def written(folder: Path, kind: str) -> Path:
    name, content = CONTENTS[kind]
    path = folder / name
    if content is None:
        Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(path)
    else:
        path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


@pytest.mark.parametrize("wanted", READERS)
@pytest.mark.parametrize("kind", CONTENTS)
def test_readers_name_the_kind_of_a_wrong_file(tmp_path: Path, kind: str, wanted: str) -> None:
    if kind == wanted:
        return
    path = written(tmp_path, kind)
    with pytest.raises(DataError) as caught:
        READERS[wanted](path)
    assert str(caught.value).startswith(f"{path}: {kind}, not {wanted}; ")


def test_a_field_that_occurs_twice_is_named() -> None:
    text = '{"keypoints": [{}, {"uv": [1, 2], "uv": [3, 4]}]}'
    wanted = "o.json: the field 'uv' occurs twice in one object; remove one of them"
    assert refusal_text(lambda: parse_json(text, "o.json")) == wanted
    assert refusal_text(lambda: parse_json(text.encode(), "o.json")) == wanted  # a line of a file
    assert parse_json(b'{"a": {"b": "x\\":"}, "c" : 1}', "") == {"a": {"b": 'x":'}, "c": 1}


@pytest.mark.parametrize(
    ("keypoint", "text"),
    [
        ({"xyz": [0, 0, 0], "xy": [1, 2]}, "keypoints[0].uv: missing, and there is an unknown "),
        ({"position": [0, 0, 0], "uv": [1, 2]}, "keypoints[0]: unknown field 'position'; known "),
        ({"xyz": [0, 0, 0], "uv": [1, 2], "nmae": "a"}, "keypoints[0]: unknown field 'nmae', did"),
    ],
)
def test_a_missing_field_is_named_before_a_guess(keypoint: dict[str, Any], text: str) -> None:
    data = {"camera": CAMERA, "keypoints": [keypoint]}
    assert refusal_text(lambda: Observation.from_dict(data)).startswith(text)
