"""The data set that cadalign makes itself: what is on disk, and that the models are sound."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from cadalign.arrays import FloatArray
from cadalign.datasets.sample import SampleModel, sample_models, write_sample_dataset
from cadalign.datasets.sample.model import box, lathe
from cadalign.datasets.sample.writer import MAKERS
from cadalign.errors import CadalignError, DataError, InputError
from cadalign.geometry.mesh import Mesh, join

CATEGORIES = {"bottle": "02876657", "car": "02958343", "chair": "03001627", "vessel": "04530566"}
MOMENTS = Path(__file__).parents[1] / "fixtures" / "sample_models.json"
FEWEST_KEYPOINTS = {"bottle": 8, "car": 12, "chair": 10, "vessel": 8}


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sample_dataset(tmp_path_factory.mktemp("sample") / "data")


@pytest.fixture(scope="module")
def models() -> tuple[SampleModel, ...]:
    return tuple(sample_models())


@pytest.fixture(scope="module")
def records(root: Path) -> list[dict[str, Any]]:
    paths = [root / "annotations" / f"{name}.json" for name in CATEGORIES]
    return [record for path in paths for record in json.loads(path.read_text())]


def ply_path(root: Path, record: dict[str, Any]) -> Path:
    return root / "ShapeNetCore.v2.ply" / record["class_id"] / f"{record['model_id']}.ply"


def contents(root: Path) -> dict[str, bytes]:
    files = (path for path in root.rglob("*") if path.is_file())
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in files}


def positions(model: SampleModel) -> FloatArray:
    return np.array([keypoint.xyz for keypoint in model.keypoints])


# What is written ---------------------------------------------------------------------------------


@pytest.mark.long
def test_layout_is_that_of_keypointnet(root: Path, records: list[dict[str, Any]]) -> None:
    counts = Counter(record["class_id"] for record in records)
    assert counts == dict.fromkeys(CATEGORIES.values(), 12)
    assert all(ply_path(root, record).is_file() for record in records)
    assert len(list(root.glob("ShapeNetCore.v2.ply/*/*.ply"))) == len(records)
    for record in records:
        assert set(record) == {"class_id", "model_id", "keypoints", "symmetries"}
        assert set(record["symmetries"]) == {"reflection", "rotation"}
        for keypoint in record["keypoints"]:
            assert set(keypoint) == {"xyz", "semantic_id", "mesh_info"}
            assert set(keypoint["mesh_info"]) == {"face_index", "face_uv"}


@pytest.mark.slow
def test_every_model_is_in_exactly_one_split(root: Path, records: list[dict[str, Any]]) -> None:
    lines = [
        line
        for split in ("train", "val", "test")
        for line in (root / "splits" / f"{split}.txt").read_text().splitlines()
    ]
    assert sorted(lines) == sorted(f"{r['class_id']}-{r['model_id']}" for r in records)
    assert all((root / "splits" / f"{split}.txt").read_text() for split in ("train", "val", "test"))


@pytest.mark.long
def test_keypoints_rebuilt_from_the_file_are_where_they_say(
    root: Path, records: list[dict[str, Any]]
) -> None:
    for record in records:
        mesh = trimesh.load(ply_path(root, record), process=False)
        for keypoint in record["keypoints"]:
            weights = np.array(keypoint["mesh_info"]["face_uv"])
            face = mesh.faces[keypoint["mesh_info"]["face_index"]]
            assert weights.min() >= 0
            assert weights.sum() == pytest.approx(1.0, abs=1e-12)
            np.testing.assert_allclose(weights @ mesh.vertices[face], keypoint["xyz"], atol=1e-9)


@pytest.mark.long
def test_file_holds_the_mesh_and_its_colours(root: Path, models: tuple[SampleModel, ...]) -> None:
    for model in models[::5]:
        path = root / "ShapeNetCore.v2.ply" / CATEGORIES[model.category] / f"{model.model_id}.ply"
        loaded = trimesh.load(path, process=False)
        np.testing.assert_array_equal(loaded.vertices, model.mesh.vertices)
        np.testing.assert_array_equal(loaded.faces, model.mesh.faces)
        assert model.mesh.vertex_colors is not None
        np.testing.assert_allclose(
            loaded.visual.vertex_colors / 255, model.mesh.vertex_colors, atol=1e-9
        )
        assert len(np.unique(model.mesh.vertex_colors, axis=0)) >= 2


def test_symmetries_name_keypoints_by_their_place_in_the_list(
    records: list[dict[str, Any]],
) -> None:
    for record in records:
        xyz = np.array([keypoint["xyz"] for keypoint in record["keypoints"]])
        if record["class_id"] != CATEGORIES["bottle"]:
            assert record["symmetries"]["reflection"]
            for pair in record["symmetries"]["reflection"]:
                a, b = pair["kp_indexes"]
                assert abs(xyz[a, 0]) > 1e-3
                np.testing.assert_allclose(xyz[a] * (-1, 1, 1), xyz[b], atol=1e-6)
        for group in record["symmetries"]["rotation"]:
            assert group["is_circle"] == bool(group["circle"])
            if group["is_circle"]:
                circle = group["circle"]
                offset = xyz[group["kp_indexes"]] - circle["center"]
                np.testing.assert_allclose(offset @ circle["normal"], 0, atol=1e-6)
                np.testing.assert_allclose(
                    np.linalg.norm(offset, axis=1), circle["radius"], rtol=2e-3
                )


def test_round_bottles_and_swivel_chairs_have_a_rotation(records: list[dict[str, Any]]) -> None:
    circles = {
        record["class_id"]
        for record in records
        if any(group["is_circle"] for group in record["symmetries"]["rotation"])
    }
    assert circles == {CATEGORIES["bottle"]}
    sizes = {
        len(group["kp_indexes"])
        for record in records
        for group in record["symmetries"]["rotation"]
        if record["class_id"] == CATEGORIES["chair"]
    }
    assert sizes == {5}


# Repeatable and safe -----------------------------------------------------------------------------


@pytest.mark.long
def test_same_seed_gives_same_bytes_and_another_seed_others(tmp_path: Path) -> None:
    first, again, other = (
        contents(write_sample_dataset(tmp_path / name, per_category=1, seed=seed))
        for name, seed in (("a", 0), ("b", 0), ("c", 1))
    )
    assert first == again
    assert set(first) == set(other)
    meshes = [name for name in first if name.endswith(".ply")]
    assert len(meshes) == 4
    assert all(first[name] != other[name] for name in meshes)


@pytest.mark.long
def test_a_model_depends_neither_on_the_count_nor_on_the_categories(
    models: tuple[SampleModel, ...],
) -> None:
    by_id = {model.model_id: model for model in models}
    for model in sample_models(per_category=2, categories=["vessel", "chair"]):
        np.testing.assert_array_equal(model.mesh.vertices, by_id[model.model_id].mesh.vertices)
        np.testing.assert_array_equal(positions(model), positions(by_id[model.model_id]))


def test_one_model_of_one_category_is_a_data_set(tmp_path: Path) -> None:
    root = write_sample_dataset(tmp_path / "new" / "data", per_category=1, categories=["bottle"])
    assert [path.name for path in root.glob("annotations/*")] == ["bottle.json"]
    assert len(json.loads((root / "annotations" / "bottle.json").read_text())) == 1
    assert (root / "splits" / "test.txt").read_text() == ""


@pytest.mark.parametrize(
    ("error", "told"),
    [(OSError(28, "No space left"), DataError), (KeyboardInterrupt(), KeyboardInterrupt)],
)
def test_what_stops_the_writing_leaves_nothing_behind(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    error: BaseException,
    told: type[BaseException],
) -> None:
    def fail(path: Path, data: bytes) -> int:
        raise error

    monkeypatch.setattr(Path, "write_bytes", fail)
    with pytest.raises(told, match=str(error.args[-1]) if error.args else None):
        write_sample_dataset(tmp_path / "data", per_category=1)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_an_earlier_sample_data_set_is_replaced(tmp_path: Path) -> None:
    write_sample_dataset(tmp_path / "data", per_category=2, categories=["bottle"])
    root = write_sample_dataset(tmp_path / "data", per_category=1, categories=["chair"])
    assert [path.name for path in root.glob("annotations/*")] == ["chair.json"]
    assert [path.name for path in tmp_path.iterdir()] == ["data"]


def test_other_files_are_never_overwritten(tmp_path: Path) -> None:
    (tmp_path / "annotations").mkdir()
    mine = tmp_path / "annotations" / "chair.json"
    mine.write_text("[]")
    with pytest.raises(DataError, match=r"chair\.json"):
        write_sample_dataset(tmp_path, per_category=1)
    assert mine.read_text() == "[]"
    with pytest.raises(DataError, match="is a file"):
        write_sample_dataset(mine, per_category=1)


def test_a_file_added_to_a_sample_data_set_is_kept(tmp_path: Path) -> None:
    root = write_sample_dataset(tmp_path / "data", per_category=1, categories=["bottle"])
    (root / "notes.txt").write_text("mine")
    with pytest.raises(DataError, match=r"notes\.txt"):
        write_sample_dataset(root, per_category=1)
    assert (root / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize(
    ("arguments", "where"),
    [
        ({"per_category": 0}, "per_category"),
        ({"per_category": 2.0}, "per_category"),
        ({"seed": -1}, "seed"),
        ({"categories": ["sofa"]}, "categories"),
        ({"categories": "chair"}, "categories"),
        ({"categories": []}, "categories"),
        ({"categories": ["car", "car"]}, "categories"),
    ],
)
def test_impossible_arguments_are_refused(
    tmp_path: Path, arguments: dict[str, Any], where: str
) -> None:
    for call in (sample_models, lambda **kw: write_sample_dataset(tmp_path / "data", **kw)):
        with pytest.raises(InputError) as caught:
            call(**arguments)
        assert isinstance(caught.value, CadalignError)
        assert caught.value.where == where
        assert caught.value.fix
    assert list(tmp_path.iterdir()) == []


# The models --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_models_have_diagonal_one_and_are_not_quite_centred(
    models: tuple[SampleModel, ...],
) -> None:
    for model in models:
        low, high = model.mesh.bounds
        assert np.linalg.norm(high - low) == pytest.approx(1.0, abs=1e-6)
        middle = (low + high) / 2
        assert middle[0] == pytest.approx(0.0, abs=1e-6)
        assert 0 < np.linalg.norm(middle) < 0.15


def test_faces_have_an_area_and_their_number_is_moderate(models: tuple[SampleModel, ...]) -> None:
    for model in models:
        corners = model.mesh.triangles
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert np.linalg.norm(cross, axis=1).min() > 1e-12, model.model_id
        assert 500 <= len(model.mesh.faces) <= 9000, model.model_id
        assert len(np.unique(model.mesh.faces)) == len(model.mesh.vertices)


@pytest.mark.long
@pytest.mark.parametrize("category", CATEGORIES)
def test_parts_are_closed_and_face_outward(category: str) -> None:
    for index in range(12):
        rng = np.random.default_rng(index)
        for part in MAKERS[category](rng, index).parts:
            edges = np.concatenate([part.faces[:, [i, (i + 1) % 3]] for i in range(3)])
            count = len(part.vertices)
            forward, backward = np.sort(edges @ [count, 1]), np.sort(edges @ [1, count])
            assert (forward == backward).all(), (category, index)
            assert _volume(part) > 0, (category, index)


@pytest.mark.parametrize("category", ["car", "vessel"])
def test_keypoints_are_placed_on_the_surface_or_close_to_it(category: str) -> None:
    for index in range(12):
        draft = MAKERS[category](np.random.default_rng(index), index)
        whole, places = join(draft.parts, category), np.array([*draft.places.values()])
        found = whole.surface_points(*whole.closest(places))
        size = np.linalg.norm(np.ptp(whole.bounds, axis=0))
        assert np.linalg.norm(found - places, axis=1).max() < 0.02 * size


def test_axes_are_those_of_keypointnet(models: tuple[SampleModel, ...]) -> None:
    """y up; cars and vessels are longest along z, but for sails; chairs face -z."""
    for model in models:
        x, y, z = np.ptp(model.mesh.bounds, axis=0)
        at = {keypoint.semantic_id: keypoint.xyz for keypoint in model.keypoints}
        if model.category == "bottle":
            assert y > max(x, z)
            assert at[8][1] > at[4][1] > at[0][1]
        elif model.category == "car":
            assert z > 1.5 * max(x, y)
            assert at[8][2] < at[10][2]  # head lamps before tail lamps
        elif model.category == "vessel":
            assert z > 2.5 * x
            assert at[0][2] < at[2][2]  # bow before stern
        else:
            assert at[4][2] < at[2][2]  # front of the seat before its rear
            assert at[0][1] > at[2][1] + 0.1
        right, left = model.mirrored[0]
        if model.category != "bottle":
            assert at[right][0] > 0 > at[left][0]


def test_semantic_ids_are_ordered_unique_and_shared(models: tuple[SampleModel, ...]) -> None:
    for category, fewest in FEWEST_KEYPOINTS.items():
        ids = [
            [keypoint.semantic_id for keypoint in model.keypoints]
            for model in models
            if model.category == category
        ]
        assert all(row == sorted(set(row)) for row in ids)
        assert min(len(row) for row in ids) >= fewest
        assert len(set.intersection(*(set(row) for row in ids))) >= 6


def test_a_semantic_id_means_the_same_place_in_every_model(
    models: tuple[SampleModel, ...],
) -> None:
    """In the bounding box, a point stays in its half of every axis that it is far out on."""
    for category in CATEGORIES:
        places: dict[int, list[FloatArray]] = {}
        for model in models:
            if model.category == category:
                low, high = model.mesh.bounds
                for keypoint in model.keypoints:
                    share = 2 * (keypoint.xyz - low) / (high - low) - 1
                    places.setdefault(keypoint.semantic_id, []).append(share)
        for semantic_id, rows in places.items():
            shares = np.array(rows)
            far = np.abs(np.median(shares, axis=0)) > 0.6
            same = np.sign(shares[:, far]) == np.sign(np.median(shares, axis=0)[far])
            assert same.all(), (category, semantic_id)


def test_keypoints_are_not_in_one_plane_and_apart(models: tuple[SampleModel, ...]) -> None:
    for model in models:
        points = positions(model)
        values = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        assert values[2] / values[0] > 0.05, model.model_id
        distances = np.linalg.norm(points[:, None] - points[None], axis=2)
        assert distances[np.triu_indices(len(points), 1)].min() > 0.005, model.model_id


@pytest.mark.long
def test_models_are_mirror_symmetric(models: tuple[SampleModel, ...]) -> None:
    for model in models:
        mesh = model.mesh
        tree = cKDTree(mesh.vertices)
        assert tree.query(mesh.vertices * (-1, 1, 1))[0].max() < 1e-6, model.model_id
        colors = np.round(255 * np.asarray(mesh.vertex_colors)[mesh.faces[:, 0], :3])
        centers = np.concatenate([mesh.triangles.mean(axis=1), colors], axis=1)
        # Flat quads may be cut along either diagonal, so most, not all, faces have a partner.
        partner = cKDTree(centers).query(centers * (-1, 1, 1, 1, 1, 1))[0]
        assert np.mean(partner < 1e-5) > 0.8, model.model_id
        at = {keypoint.semantic_id: keypoint.xyz for keypoint in model.keypoints}
        if model.category != "bottle":
            for right, left in model.mirrored:
                np.testing.assert_allclose(at[right] * (-1, 1, 1), at[left], atol=1e-6)


def _volume(mesh: Mesh) -> float:
    return float(trimesh.Trimesh(mesh.vertices, mesh.faces).volume)


# Geometry ----------------------------------------------------------------------------------------


def test_parts_have_the_size_and_volume_they_should() -> None:
    block = box((1, 2, 3), (2, 4, 6), (1, 2, 3))
    assert _volume(block) == pytest.approx(48.0)
    assert len(block.faces) == 12
    soft = box((0, 0, 0), (2, 4, 6), (1, 2, 3), radius=0.2, steps=6)
    np.testing.assert_allclose(np.ptp(soft.vertices, axis=0), (2, 4, 6))
    assert 0.95 * 48 < _volume(soft) < 48
    angle = np.linspace(0, np.pi, 33)
    ball = lathe(np.stack([np.sin(angle), -2 * np.cos(angle)], axis=1), (1, 2, 3), count=64)
    assert _volume(ball) == pytest.approx(4 * np.pi * 2 / 3, rel=0.01)


def moments(model: SampleModel) -> list[float]:
    """Numbers of vertices and faces; weighted means of places, squares and colours."""
    vertices = model.mesh.vertices
    colors = np.asarray(model.mesh.vertex_colors, dtype=float)
    weights = 1 + np.arange(len(vertices)) % 7  # exchanged vertices differ
    parts = [vertices, vertices**2, colors[:, :3]]
    means = [np.average(part, axis=0, weights=weights[: len(part)]) for part in parts]
    return [len(vertices), len(model.mesh.faces), *np.concatenate(means)]


def test_models_are_those_that_results_were_measured_on(models: tuple[SampleModel, ...]) -> None:
    """`python tests/datasets/test_sample_dataset.py` stores them anew where they are to change."""
    stored = json.loads(MOMENTS.read_text())
    assert len(stored) == len(models)
    for model in models:
        assert moments(model) == pytest.approx(stored[model.model_id], rel=1e-6, abs=1e-9)


if __name__ == "__main__":
    MOMENTS.write_text(
        json.dumps({model.model_id: moments(model) for model in sample_models()}) + "\n"
    )
