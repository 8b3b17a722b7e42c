"""Detectors' keypoints: supported files, pairing with a model, errors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.files import replaced, write_json

from cadalign import Camera
from cadalign.datasets import (
    ImageKeypoints,
    ModelKeypoint,
    ModelKeypoints,
    choose_object,
    join_keypoints,
    read_image_keypoints,
)
from cadalign.datasets.image_keypoints import find_photo
from cadalign.errors import CadalignError, DataError, InputError

CAMERA = Camera.from_size(640, 480)
MODEL = ModelKeypoints(
    (
        ModelKeypoint("left ear", (0.0, 1.0, 0.0), semantic_id=4),
        ModelKeypoint("right ear", (1.0, 1.0, 0.0), semantic_id=5),
        ModelKeypoint("nose", (0.5, 0.5, 1.0), semantic_id=0),
    ),
    Path("/models/cat.obj"),
)
NAMES = ["nose", "left_ear", "right_ear"]
POINTS = [[100.5, 200.25], [80.0, 120.0], [130.0, 121.0]]
ANNOTATIONS: dict[str, Any] = {
    "info": {"description": "two cats"},
    "images": [
        {"id": 3, "file_name": "cats/a.jpg", "width": 640, "height": 480},
        {"id": 4, "file_name": "cats/b.jpg", "width": 320, "height": 240},
    ],
    "categories": [{"id": 17, "name": "cat", "keypoints": NAMES, "skeleton": [[1, 2]]}],
    "annotations": [
        {
            "image_id": 3,
            "category_id": 17,
            "keypoints": [100.5, 200.25, 2, 80, 120, 1, 0, 0, 0],
            "num_keypoints": 2,
        },
        {"image_id": 3, "category_id": 17, "keypoints": [0] * 9, "num_keypoints": 0},
        {"image_id": 4, "category_id": 17, "keypoints": [9, 9, 2, 8, 8, 2, 7, 7, 2]},
    ],
}
CSV = "image,name,u,v,score\na.jpg,nose,100.5,200.25,0.9\na.jpg,left ear,80,120,0.4\n"


def read(tmp_path: Path, data: Any, name: str = "keypoints.json") -> list[ImageKeypoints]:
    return read_image_keypoints(write_json(tmp_path / name, data))


def changed(path: str, value: Any) -> dict[str, Any]:
    """The annotations with the entry at a dotted path replaced; removed where it is `...`."""
    return replaced(ANNOTATIONS, path, value)


# --- COCO and its relatives -------------------------------------------------------------------


def test_coco_annotations_have_names_flags_and_images(tmp_path: Path) -> None:
    first, second = read(tmp_path, ANNOTATIONS)
    assert first.names == tuple(NAMES)
    assert first.points_2d[:2].tolist() == POINTS[:2]
    assert first.scores is not None
    assert first.scores.tolist() == [1.0, 0.5, 0.0]
    assert (first.image, first.size) == ("cats/a.jpg", (640, 480))
    assert (second.image, second.size) == ("cats/b.jpg", (320, 240))


def flat(scores: list[float]) -> list[float]:
    return [n for point, score in zip(POINTS, scores, strict=True) for n in (*point, score)]


SCORES = [0.9, 0.8, 0.1]
X, Y = zip(*POINTS, strict=True)


@pytest.mark.parametrize(
    ("entry", "score"),
    [
        # MMPose's and Detectron2's result files, ultralytics' predictions.json.
        ({"image_id": 7, "category_id": 1, "keypoints": flat(SCORES), "score": 0.75}, 0.75),
        # ultralytics' results.to_json().
        ({"confidence": 0.75, "keypoints": {"x": X, "y": Y, "visible": SCORES}}, 0.75),
    ],
    ids=["results", "ultralytics"],
)
def test_detectors_files_are_read(tmp_path: Path, entry: Any, score: float | None) -> None:
    (found,) = read(tmp_path, [entry])
    assert found.points_2d.tolist() == POINTS
    assert found.scores is not None
    assert found.scores.tolist() == SCORES
    assert found.score == score
    assert found.names is None
    assert found.source == f"{tmp_path / 'keypoints.json'}: [0]"


@pytest.mark.parametrize(
    ("third", "scores"),
    [
        ([0, 1, 2], [0.0, 0.5, 1.0]),
        ([2, 2, 2], [1.0, 1.0, 1.0]),
        ([0.0, 1.0, 1.0], [0.0, 1.0, 1.0]),
        ([0.5, 1.0, 2.0], [0.5, 1.0, 2.0]),
    ],
)
def test_flags_are_distinguished_from_scores(
    tmp_path: Path, third: list[float], scores: list[float]
) -> None:
    (found,) = read(tmp_path, [{"keypoints": flat(third)}])
    assert found.scores is not None
    assert found.scores.tolist() == scores


AT = "annotations[0].keypoints"


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (3, "there are no annotations; give COCO's keypoint JSON"),
        (
            {"frames": []},
            "there are no annotations; give COCO's keypoint JSON, or a detector's; see the page on "
            "detectors in cadalign's docs",
        ),
        ([], "there are no keypoints"),
        ([{"bbox": [1, 2, 3, 4]}], "[0].keypoints: missing; give COCO's keypoint JSON"),
        (changed("annotations.0.keypoints", []), f"{AT}: expected x, y and visib"),
        (
            changed("annotations.0.keypoints", [1, 2, 2, 3]),
            f"{AT}: expected x, y and visibility or score of each keypoint, got 4 numbers",
        ),
        (
            changed("annotations.0.keypoints", [1, 2, 2]),
            f"{AT}: 1 keypoints, but the category names 3",
        ),
        (
            changed("annotations.0.keypoints", [1, 2, "two"] * 3),
            f"{AT}[2]: 'two' is not a finite number",
        ),
        (changed("annotations.0.image_id", 12), "annotations[0].image_id: there is no image 12"),
        (changed("annotations.0.image_id", ...), "annotations[0].image_id: missing"),
        (changed("categories.0.id", [1]), "categories[0].id: [1] is not a whole number or a text"),
        (
            changed("categories.0.keypoints.2", "nose"),
            "categories[0].keypoints[2]: 'nose' occurs twice",
        ),
        (changed("images.1.id", 3), "images[1].id: the id 3 occurs twice; "),
        ([{"keypoints": {"x": [1, 2], "y": [1]}}], "[0].keypoints.y: 1 values, but x has 2"),
        ([{"keypoints": [[1, 2, 3]]}], "[0].keypoints[0]: [1, 2, 3] is not a finite number"),
        (
            [{"keypoints": {"x": [1], "y": [1], "visible": [1, 2]}}],
            "[0].keypoints: 2 scores for 1 keypoints",
        ),
        ([{"keypoints": [1, 2, -1]}], "[0]: scores: keypoint 0 has the value -1, which is nega"),
    ],
)
def test_malformed_json_is_refused_by_file_and_field(tmp_path: Path, data: Any, text: str) -> None:
    path = write_json(tmp_path / "keypoints.json", data)
    with pytest.raises(DataError) as caught:
        read_image_keypoints(path)
    assert str(caught.value).startswith(f"{path}: {text}")


# --- CSV --------------------------------------------------------------------------------------


def test_csv_columns_are_read(tmp_path: Path) -> None:
    (found,) = read(tmp_path, CSV, "keypoints.csv")
    assert found.names == ("nose", "left ear")
    assert found.points_2d.tolist() == POINTS[:2]
    assert found.scores is not None
    assert found.scores.tolist() == [0.9, 0.4]
    assert found.image == "a.jpg"


def test_csv_needs_pixels_only(tmp_path: Path) -> None:
    text = "\ufeffX, Y ,score,semantic_id,sigma\r\n1,2,1,4,0.5\r\n,,0,5,\r\n\r\n3,4,0.5,0,2\r\n"
    (found,) = read(tmp_path, text, "keypoints.csv")
    assert found.points_2d[[0, 2]].tolist() == [[1, 2], [3, 4]]
    assert found.is_found.tolist() == [True, False, True]
    assert found.ids == (4, 5, 0)
    assert found.scores is not None
    assert found.scores.tolist() == [1.0, 0.0, 0.5]
    assert found.sigma is not None
    assert found.sigma[[0, 2]].tolist() == [0.5, 2.0]
    (plain,) = read(tmp_path, "u,v\n1,2\n", "plain.CSV")
    assert plain.names is None
    assert plain.ids is None
    assert plain.scores is None


def test_csv_of_several_images_gives_an_object_each(tmp_path: Path) -> None:
    objects = read(tmp_path, CSV + "b.jpg,nose,1,2,1\n", "keypoints.csv")
    assert [(found.image, len(found)) for found in objects] == [("a.jpg", 2), ("b.jpg", 1)]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "{path}, line 1: the column 'u' is missing; the first line names the columns, "),
        ("1,2\n3,4\n", "{path}, line 1: unknown column '1'; known are u, v, image, name, "),
        ("name,u\na,1\n", "{path}, line 1: the column 'v' is missing; "),
        ("u,x,v\n", "{path}, line 1: the column 'u' occurs twice"),
        ("u,v\n", "{path}: there are no keypoints"),
        ("u,v\n1,2,3\n", "{path}, line 2: 3 values for 2 columns"),
        ("u,v\n1,2\n3,four\n", "{path}, line 3: v: 'four' is not a finite number"),
        ("u,v\n1,nan\n", "{path}, line 2: v: 'nan' is not a finite number"),
        ("u,v\n1,\n", "{path}, line 2: v: '' is not a finite number"),
        ("u,v,name\n1,2,\n", "{path}, line 2: name: the name is empty"),
        ("u,v,semantic_id\n1,2,3.5\n", "{path}, line 2: semantic_id: 3.5 is not a whole number"),
        ("u,v,score\n1,2,1\n1,2,null\n", "{path}, line 3: score: 'null' is not a finite number"),
        ("u,v,sigma\n1,2,0\n", "{path}: sigma: keypoint 0 has the value 0, which is not positive"),
        ("u,v,score\n1,2,-1\n", "{path}: scores: keypoint 0 has the value -1, which is negative"),
        ('u,v\n1,"2\n', "{path}: cannot be read (unexpected end of data)"),
    ],
)
def test_malformed_csv_is_refused_by_file_and_line(
    tmp_path: Path, text: str, expected: str
) -> None:
    path = write_json(tmp_path / "keypoints.csv", text)
    with pytest.raises(DataError) as caught:
        read_image_keypoints(path)
    assert str(caught.value).startswith(expected.format(path=path))


@pytest.mark.parametrize("name", ["nothing.csv", "nothing.json"])
def test_missing_and_binary_files_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(DataError) as caught:
        read_image_keypoints(tmp_path / name)
    assert str(caught.value) == f"{tmp_path / name}: no such file"
    (tmp_path / name).write_bytes(b"\xff\xfe\x00")
    with pytest.raises(DataError, match="cannot be read"):
        read_image_keypoints(tmp_path / name)


# --- which object -----------------------------------------------------------------------------


def seen(image: str | None, score: float | None = None) -> ImageKeypoints:
    return ImageKeypoints(np.zeros((1, 2)), image=image, score=score)


def test_object_is_chosen_by_image_number_and_score() -> None:
    objects = [seen("x/a.jpg", 0.5), seen("x/a.jpg", 0.9), seen("42", 0.1)]
    assert choose_object(objects, image="a.jpg") is objects[1]
    assert choose_object(objects, image="a.jpg", number=0) is objects[0]
    assert choose_object(objects, image="42.png") is objects[2]
    # A file about a single image may call it what it likes.
    assert choose_object(objects[:2], image="other.jpg") is objects[1]
    assert choose_object([seen(None)], image="other.jpg").image is None


def test_photos_of_one_name_in_several_folders_are_distinguished(tmp_path: Path) -> None:
    objects = [seen("left/1.jpg", 0.9), seen("right/1.jpg", 0.5)]
    assert choose_object(objects, image="photos/right/1.jpg") is objects[1]
    (tmp_path / "right").mkdir()
    for name in ("1.jpg", "right/1.jpg", "2.jpg"):
        (tmp_path / name).touch()
    assert find_photo(tmp_path, "right/1.jpg") == tmp_path / "right/1.jpg"
    assert find_photo(tmp_path, "data/right/1.jpg") == tmp_path / "right/1.jpg"
    assert find_photo(tmp_path, "data/right/2.jpg") == tmp_path / "2.jpg"
    assert find_photo(tmp_path, "3.jpg") is None
    assert find_photo(tmp_path, "2") == tmp_path / "2.jpg"  # results of detectors have ids
    assert find_photo(tmp_path, "3") is None
    coco, outside = tmp_path / "000000000139.jpg", tmp_path / "outside.jpg"
    for path in (coco, outside):
        path.touch()
    assert find_photo(tmp_path, "139") == coco
    assert find_photo(tmp_path / "right", str(outside)) is None
    assert find_photo(tmp_path / "right", "../outside.jpg") is None


@pytest.mark.parametrize(
    ("objects", "options", "text"),
    [
        (
            [seen("x/a.jpg", 0.5), seen("y/a.jpg", 0.9)],
            {"image": "a.jpg"},
            "image: 2 images are called 'a.jpg'; give a path that ends with one of "
            "x/a.jpg, y/a.jpg",
        ),
        ([seen("a"), seen("b")], {}, "image: the file has 2 images; choose one of a, b"),
        (
            [seen(name) for name in "abcde"],
            {},
            "image: the file has 5 images; choose one of a, b, c, d, e",
        ),
        (
            [seen(name) for name in "abcdefg"],
            {"image": "z"},
            "image: the file has 7 images, none is called 'z'; choose one of a, b, c, d, e, ...",
        ),
        ([seen("a"), seen("a")], {"number": 2}, "number: there is no object 2 of 2; count from 0"),
        (
            [seen("a"), seen("a", 0.5)],
            {},
            "number: the image has 2 objects, and no scores to choose by; choose one, 0 to 1",
        ),
    ],
)
def test_invalid_choices_are_refused(
    objects: list[ImageKeypoints], options: dict[str, Any], text: str
) -> None:
    with pytest.raises(InputError) as caught:
        choose_object(objects, **options)
    assert str(caught.value) == text


# --- pairing ----------------------------------------------------------------------------------


def test_names_pair_whatever_their_spelling() -> None:
    found = ImageKeypoints(
        np.array(POINTS), scores=np.array([0.9, 0.8, 0.0]), names=("NOSE", "Left-Ear", "right ear")
    )
    observation = join_keypoints(found, MODEL, CAMERA, image=Path("a.jpg"))
    assert observation.names == ("nose", "left ear")
    assert observation.points_3d.tolist() == [[0.5, 0.5, 1.0], [0.0, 1.0, 0.0]]
    assert observation.points_2d.tolist() == POINTS[:2]
    assert observation.ids is not None
    assert observation.ids.tolist() == [0, 4]
    assert observation.scores is not None
    assert observation.scores.tolist() == [0.9, 0.8]
    assert observation.sigma is None
    assert (observation.image, observation.model) == (Path("a.jpg"), MODEL.model)
    assert observation.camera == CAMERA


def test_ids_pair_where_there_are_no_names_and_order_where_there_is_neither() -> None:
    by_id = join_keypoints(ImageKeypoints(np.array(POINTS), ids=(0, 4, 5)), MODEL, CAMERA)
    assert by_id.names == ("nose", "left ear", "right ear")
    by_order = join_keypoints(ImageKeypoints(np.array(POINTS)), MODEL, CAMERA)
    assert by_order.names == MODEL.names
    assert by_order.scores is None


def test_low_scores_leave_keypoints_out() -> None:
    found = ImageKeypoints(np.array(POINTS), scores=np.array([0.25, 0.8, 1.0]))
    assert len(join_keypoints(found, MODEL, CAMERA, min_score=0.5).points_2d) == 2


def test_unknown_keypoints_can_be_left_out() -> None:
    found = ImageKeypoints(np.array(POINTS), names=("nose", "tail", "left ear"))
    observation = join_keypoints(found, MODEL, CAMERA, ignore_unknown=True)
    assert observation.names == ("nose", "left ear")


def test_model_keypoints_without_ids_give_none() -> None:
    nameless = ModelKeypoints(tuple(ModelKeypoint(n, (0.0, 0.0, 0.0)) for n in "abc"))
    assert join_keypoints(ImageKeypoints(np.array(POINTS)), nameless, CAMERA).ids is None


@pytest.mark.parametrize(
    ("fields", "options", "text"),
    [
        (
            {"names": ("nose", "tail", "left ear")},
            {},
            "photo.json: the model has no keypoint 'tail'; "
            "it has left ear, right ear, nose; ignore_unknown leaves out unknown keypoints",
        ),
        (
            {"ids": (0, 4, 9)},
            {},
            "photo.json: the model has no keypoint 9; "
            "it has left ear, right ear, nose; ignore_unknown leaves out unknown keypoints",
        ),
        (
            {"names": ("nose", "Nose", "left ear")},
            {},
            "photo.json: keypoints 0 and 1 are both 'nose'; leave one of them out",
        ),
        (
            {"names": ("a", "b", "c")},
            {"ignore_unknown": True},
            "photo.json: none of 3 keypoints is found in the image and on the model; "
            "the model has left ear, right ear, nose",
        ),
        (
            {"scores": np.zeros(3)},
            {},
            "photo.json: none of 3 keypoints is found in the image and on the model; "
            "the model has left ear, right ear, nose",
        ),
        (
            {"points_2d": np.zeros((4, 2))},
            {},
            "photo.json: 4 keypoints without names, but the model has 3; "
            "give names, or all of the model's keypoints in its order",
        ),
    ],
)
def test_keypoints_that_cannot_be_paired_are_refused(
    fields: dict[str, Any], options: dict[str, Any], text: str
) -> None:
    found = ImageKeypoints(**({"points_2d": np.array(POINTS), "source": "photo.json"} | fields))
    with pytest.raises(CadalignError) as caught:
        join_keypoints(found, MODEL, CAMERA, **options)
    assert str(caught.value) == text


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({"points_2d": np.zeros((3, 3))}, "keypoints: keypoints: shape (3, 3), expected (n, 2)"),
        ({"scores": np.ones(2)}, "keypoints: scores: shape (2,), expected (3)"),
        ({"names": ("a",)}, "keypoints: 3 keypoints but 1 names"),
        ({"ids": (1, 2)}, "keypoints: 3 keypoints but 2 ids"),
    ],
)
def test_fields_that_do_not_match_are_refused(fields: dict[str, Any], text: str) -> None:
    with pytest.raises(CadalignError) as caught:
        ImageKeypoints(**({"points_2d": np.array(POINTS)} | fields))
    assert str(caught.value) == text


# --- what does not belong together ------------------------------------------------------------


def test_photo_without_keypoints_does_not_get_keypoints_of_another(tmp_path: Path) -> None:
    data = changed("annotations.2", ...)
    with pytest.raises(InputError, match=r"2 images, but no keypoints in 'b\.jpg'.*cats/a\.jpg"):
        choose_object(read(tmp_path, data), image="b.jpg")


def test_integers_too_large_for_a_float_are_refused(tmp_path: Path) -> None:
    huge = changed("annotations.0.keypoints.0", 10**400)
    with pytest.raises(CadalignError, match=r"keypoints\[0\]: 10+\.\.\.0+ is not a finite"):
        read(tmp_path, huge)
    with pytest.raises(DataError, match="not valid JSON"):
        read(tmp_path, '{"annotations": ' + "1" * 5000 + "}")


def test_an_invalid_score_or_size_is_ignored(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    found = {"image_id": 1, "keypoints": [10, 20, 2, 30, 40, 2], "score": "high"}
    images = [{"id": 1, "file_name": "a.jpg", "width": -5, "height": 480}]
    path = write_json(tmp_path / "a.json", {"images": images, "annotations": [found]})
    (read,) = read_image_keypoints(path)
    assert read.points_2d.tolist() == [[10, 20], [30, 40]]
    assert (read.score, read.size) == (None, None)
    assert "annotations[0].score: 'high' is not a number; ignored" in caplog.text
    assert "images: -5 x 480 is not an image size; ignored" in caplog.text
