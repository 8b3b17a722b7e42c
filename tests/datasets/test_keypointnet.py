"""KeypointNet: content of its files; a malformed model does not affect others."""

from __future__ import annotations

import logging
import os
import pickle
from pathlib import Path

import numpy as np
import pytest
from support.files import TETRAHEDRON, replaced, write_json

from cadalign.datasets import KeypointNet, load_mesh
from cadalign.errors import DataError, InputError
from cadalign.io.meshes.files import write_mesh

CHAIR, MUG = "03001627", "03797390"
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
FACES = [(0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3)]


def entry(model_id: str, class_id: str = CHAIR) -> dict:
    """An annotation of the tetrahedron with a keypoint on each face."""
    weights = [0.2, 0.3, 0.5]
    keypoints = [
        {
            "xyz": (np.array(weights) @ CORNERS[list(face)]).tolist(),
            "rgb": [255, 0, 51],
            "semantic_id": 2 * number,
            "pcd_info": {"point_index": number},
            "mesh_info": {"face_index": number, "face_uv": [w * 1.0005 for w in weights]},
        }
        for number, face in enumerate(FACES)
    ]
    circle = {"center": [0, 0, 0], "radius": 0.5, "normal": [0, -2, 0]}
    return {
        "class_id": class_id,
        "model_id": model_id,
        "keypoints": keypoints,
        "symmetries": {
            "reflection": [{"kp_indexes": [0, 1]}],
            "rotation": [
                {"kp_indexes": [0, 1, 2], "is_circle": True, "circle": circle},
                {"kp_indexes": [2, 3], "is_circle": False, "circle": {}},
            ],
        },
    }


def write_obj(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(TETRAHEDRON)
    return path


@pytest.fixture
def root(tmp_path):
    """Two chairs (one with a mesh) and a mug."""
    write_json(tmp_path / "annotations/mug.json", [entry("m", MUG)])
    write_json(tmp_path / "annotations/chair.json", [entry("z"), entry("a")])
    write_json(tmp_path / "annotations/all.json", "not to be read")
    write_obj(tmp_path / f"models/{CHAIR}/a/models/model_normalized.obj")
    (tmp_path / "splits").mkdir()
    (tmp_path / "splits/train.txt").write_text(f"{CHAIR}-a\n{MUG}-m\n\n{CHAIR}-elsewhere\n")
    (tmp_path / "splits/test.txt").write_text(f"{CHAIR}-z\n")
    return tmp_path


# --- what the files say


def test_models_come_sorted_by_category_and_in_file_order(root):
    dataset = KeypointNet(root)
    assert dataset.categories == ("chair", "mug")
    keys = [("chair", "z"), ("chair", "a"), ("mug", "m")]
    assert [model.key for model in dataset] == keys == list(dataset.ids())
    assert len(dataset) == 3
    assert dataset["chair", "a"] is dataset["chair"][1]
    assert dataset["03001627", "a"] is dataset["chair", "a"]


def test_keypoints_and_symmetries_are_read(root):
    model = KeypointNet(root)["chair", "a"]
    assert model.class_id == CHAIR
    keypoints = model.keypoints
    assert len(keypoints) == 4
    assert keypoints.ids.tolist() == [0, 2, 4, 6]
    assert [label for label, _ in keypoints] == [0, 2, 4, 6]
    np.testing.assert_array_equal([xyz for _, xyz in keypoints], keypoints.xyz)
    assert keypoints.face_index.tolist() == [0, 1, 2, 3]
    np.testing.assert_allclose(keypoints.barycentric.sum(axis=1), 1, atol=1e-15)
    assert model.symmetries.reflections == ((0, 1),)
    ring, pair = model.symmetries.rotations
    assert ring.circle.radius == 0.5
    np.testing.assert_allclose(ring.circle.normal, [0, -1, 0])
    assert (pair.keypoints, pair.circle) == ((2, 3), None)


def test_records_are_read_only_and_picklable(root):
    model = KeypointNet(root)["chair", "a"]
    with pytest.raises(ValueError, match="read-only"):
        model.keypoints.xyz[0, 0] = 1
    again = pickle.loads(pickle.dumps(model))
    np.testing.assert_array_equal(again.keypoints.xyz, model.keypoints.xyz)


def test_symmetries_may_be_absent(root):
    plain = entry("a")
    del plain["symmetries"]
    write_json(root / "annotations/chair.json", [plain])
    model = KeypointNet(root)["chair", "a"]
    assert model.symmetries.rotations == ()


def test_categories_are_read_when_asked_for(root):
    (root / "annotations/mug.json").write_text("[\n{broken")
    dataset = KeypointNet(root)
    assert len(dataset["chair"]) == 2
    with pytest.raises(DataError, match=r"mug\.json, line 2: not valid JSON"):
        dataset["mug"]


# --- splits and subsets


def test_splits(root):
    dataset = KeypointNet(root)
    assert dataset.splits == ("test", "train")
    assert dataset.split("test") == {("chair", "z")}
    assert [model.key for model in dataset.subset(split="train")] == [("chair", "a"), ("mug", "m")]
    with pytest.raises(InputError, match="unknown split 'val'; known are test, train"):
        KeypointNet(root).split("val")
    (root / "splits/test.txt").write_text(f"{CHAIR}-z\nchair\n")
    with pytest.raises(DataError, match=r"test\.txt, line 2"):
        dataset.split("test")


def test_subsets_narrow_each_other(root):
    dataset = KeypointNet(root)
    chairs = dataset.subset(categories=["chair"])
    assert chairs.categories == ("chair",)
    assert [model.model_id for model in chairs.subset(with_mesh=True)] == ["a"]
    assert len(chairs.subset(split="train").subset(split="test")) == 0
    assert len(dataset) == 3
    with pytest.raises(InputError, match="no model 'z' of 'chair'"):
        chairs.subset(split="train")["chair", "z"]
    with pytest.raises(InputError, match="known are chair"):
        chairs["mug"]


# --- meshes


def test_model_without_mesh_says_so(root):
    model = KeypointNet(root)["chair", "z"]
    assert model.mesh_path is None
    with pytest.raises(DataError, match="chair, model z: there is no mesh"):
        model.load_mesh()


def test_meshes_of_every_layout_are_found(root, tmp_path):
    ply = tmp_path / f"ShapeNetCore.v2.ply/{CHAIR}/a.ply"
    write_mesh(ply, load_mesh(KeypointNet(root)["chair", "a"].mesh_path), kind="ply")
    other = write_obj(tmp_path / f"elsewhere/{CHAIR}/a/model.obj")
    dataset = KeypointNet(root, shapenet_root=tmp_path / "elsewhere")
    assert dataset["chair", "a"].mesh_path == other
    assert KeypointNet(root)["chair", "a"].mesh_path == ply
    assert len(load_mesh(ply).faces) == 4
    ply.unlink()
    below = root / f"models/{CHAIR}/a/models/model_normalized.obj"
    assert KeypointNet(root)["chair", "a"].mesh_path == below


def test_mesh_that_does_not_belong_to_the_annotation_is_refused(root):
    path = root / f"models/{CHAIR}/a/models/model_normalized.obj"
    model = KeypointNet(root)["chair", "a"]
    path.write_text(TETRAHEDRON.replace("v 0 0 1", "v 0 0 2"))
    with pytest.raises(DataError, match=r"model a: keypoints\[\d\] lies 0\.5 from"):
        model.load_mesh()
    assert model.load_mesh(check=False).bounds[1, 2] == 2
    path.write_text("\n".join(TETRAHEDRON.splitlines()[:-1]))
    with pytest.raises(DataError, match="face 3 is not in"):
        model.load_mesh()


@pytest.mark.parametrize(("off", "is_refused"), [(1e-3, False), (3e-3, True)])
def test_annotations_may_be_a_thousandth_of_the_diagonal_off(tmp_path, off, is_refused):
    centered = entry("a")
    for number, keypoint in enumerate(centered["keypoints"]):
        keypoint["xyz"] = (np.array(keypoint["xyz"]) - 0.5 + [0, 0, off * (number == 2)]).tolist()
    write_json(tmp_path / "annotations/chair.json", [centered])
    path = write_obj(tmp_path / f"models/{CHAIR}/a/models/model_normalized.obj")
    rows = [f"v {x} {y} {z}" for x, y, z in CORNERS - 0.5]
    path.write_text("\n".join([*rows, *(r for r in TETRAHEDRON.splitlines() if r[0] == "f")]))
    model = KeypointNet(tmp_path)["chair", "a"]
    if is_refused:
        with pytest.raises(DataError, match=r"keypoints\[2\] lies 0\.003 from"):
            model.load_mesh()
    else:
        assert len(model.load_mesh().faces) == 4


# --- malformed annotations


@pytest.mark.parametrize(
    ("path", "value", "told"),
    [
        ("keypoints", [], "keypoints: [] is not a list of at least 1"),
        ("keypoints.1.xyz", [0, float("nan"), 0], "keypoints[1].xyz[1]: nan is not a finite"),
        ("keypoints.1.xyz", [0, -1e300, 0], "keypoints[1].xyz[1]: -1e+300 is not a"),
        ("keypoints.1.semantic_id", 0, "keypoints[1].semantic_id: 0 occurs twice"),
        ("keypoints.1.mesh_info", ..., "keypoints[1].mesh_info: missing"),
        ("keypoints.1.mesh_info.face_index", -1, "keypoints[1].mesh_info.face_index"),
        ("keypoints.1.mesh_info.face_uv", [0, 0, 0], "sum to 0, not to 1"),
        (
            "symmetries.reflection.0.kp_indexes",
            [0, 4],
            "reflection[0].kp_indexes: there is no row 4",
        ),
        ("symmetries.reflection.0.kp_indexes", [0], "[0].kp_indexes: [0] is not a list of 2"),
        ("symmetries.rotation.0.circle", {}, "rotation[0].circle.center: missing"),
        (
            "symmetries.rotation.0.circle.normal",
            [0, 0, 0],
            "circle.normal: the vector has length 0",
        ),
        ("class_id", "../../etc", "class_id: '../../etc' is not an id"),
    ],
)
def test_one_malformed_model_does_not_stop_the_others(root, caplog, path, value, told):
    bad = replaced(entry("bad"), path, value)
    write_json(root / "annotations/chair.json", [entry("z"), bad, entry("a")])
    dataset = KeypointNet(root)
    with caplog.at_level(logging.WARNING, logger="cadalign"):
        assert [model.model_id for model in dataset["chair"]] == ["z", "a"]
    assert told in caplog.text
    assert dataset.ids("chair") == (("chair", "z"), ("chair", "bad"), ("chair", "a"))
    assert list(dataset.problems) == [("chair", "bad")]
    with pytest.raises(DataError) as caught:
        dataset["chair", "bad"]
    assert str(caught.value).startswith("chair.json, model bad")
    assert told in str(caught.value)


@pytest.mark.parametrize("value", [None, 7, "text", {"class_id": CHAIR}, {"model_id": ["x"]}])
def test_entry_without_model_id_goes_by_its_position(root, value):
    write_json(root / "annotations/chair.json", [entry("z"), value, entry("a")])
    dataset = KeypointNet(root)
    assert list(dataset.problems) == [("chair", "#1")]
    assert len(dataset["chair"]) == 2


def test_model_that_occurs_twice_counts_once(root):
    write_json(root / "annotations/chair.json", [entry("z"), entry("a"), entry("z")])
    dataset = KeypointNet(root)
    assert [model.model_id for model in dataset["chair"]] == ["z", "a"]
    assert "occurs twice" in str(dataset.problems["chair", "z#2"])


@pytest.mark.parametrize("text", ["", "{}", "[{}", "\xff"])
def test_file_that_is_no_annotation_is_named(root, text):
    (root / "annotations/chair.json").write_text(text, encoding="latin-1")
    dataset = KeypointNet(root)
    with pytest.raises(DataError, match=r"chair\.json"):
        dataset["chair"]
    assert len(dataset["mug"]) == 1


def test_wrong_roots_are_refused(root, tmp_path):
    with pytest.raises(DataError, match="no such folder"):
        KeypointNet(tmp_path / "gone")
    with pytest.raises(DataError, match=r"no annotations/\*\.json"):
        KeypointNet(root / "models")
    with pytest.raises(DataError, match="no such folder"):
        KeypointNet(root, shapenet_root=tmp_path / "gone")
    with pytest.raises(InputError, match=r"did you mean 'mug'\?; known are chair, mug"):
        KeypointNet(root)["mugg"]


# --- real data


@pytest.fixture(scope="module")
def real():
    folder = os.environ.get("CADALIGN_DATA")
    if not folder:
        pytest.skip("CADALIGN_DATA is not set: no real data to test on")
    return KeypointNet(Path(folder) / "keypointnet")


@pytest.mark.long
def test_real_annotations_load_whole(real):
    count = len(real)
    assert count == 3234
    assert not real.problems
    assert len(real.subset(split="train")) + len(real.subset(split="val")) == count


@pytest.mark.long
def test_real_keypoints_lie_on_their_faces(real):
    checked = set()
    for root in (None, real.root / "models"):
        for model in KeypointNet(real.root, shapenet_root=root).subset(with_mesh=True):
            mesh, given = load_mesh(model.mesh_path), model.keypoints
            rebuilt = mesh.surface_points(given.face_index, given.barycentric)
            assert np.abs(rebuilt - given.xyz).max() < 1e-6, model.mesh_path
            checked.add(model.mesh_path)
    assert len(checked) >= 11
    assert {path.suffix for path in checked} == {".obj", ".ply"}


def test_real_textures_are_found(real):
    model = f"models/{CHAIR}/88382b877be91b2a572f8e1c1caad99e/models/model_normalized.obj"
    mesh = load_mesh(real.root / model)
    assert all(material.texture is not None for material in mesh.materials)
    assert mesh.corner_uv is not None
