"""The sample data set: its files and the validity of its models."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from cadalign.datasets import AnnotatedModel, KeypointNet, write_sample_dataset
from cadalign.datasets.sample import MAKERS
from cadalign.errors import DataError, InputError
from cadalign.geometry.mesh import Mesh, join

CATEGORIES = {"bottle": "02876657", "car": "02958343", "chair": "03001627", "vessel": "04530566"}
MOMENTS = Path(__file__).parents[1] / "fixtures" / "sample_models.json"
FEWEST_KEYPOINTS = {"bottle": 8, "car": 12, "chair": 10, "vessel": 8}
Models = tuple[tuple[AnnotatedModel, Mesh], ...]


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sample_dataset(tmp_path_factory.mktemp("sample") / "data")


def models_in(root: Path) -> Models:
    return tuple((model, model.load_mesh()) for model in KeypointNet(root))


@pytest.fixture(scope="module")
def models(root: Path) -> Models:
    """The models with their meshes, which loading compares with the annotation."""
    return models_in(root)


def contents(root: Path) -> dict[str, bytes]:
    files = (path for path in root.rglob("*") if path.is_file())
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in files}


# What is written ---------------------------------------------------------------------------------


def test_layout_is_that_of_keypointnet(root: Path, models: Models) -> None:
    dataset = KeypointNet(root)
    assert {model.category: model.class_id for model, _ in models} == CATEGORIES
    assert [len(dataset[name]) for name in CATEGORIES] == [12] * 4
    assert not dataset.problems
    splits = [dataset.split(name) for name in ("train", "val", "test")]
    assert sum(map(len, splits)) == len(frozenset().union(*splits)) == len(models)
    assert all(splits)


def test_keypoints_lie_where_their_faces_say(models: Models) -> None:
    for model, mesh in models:
        assert model.keypoints.barycentric.min() >= 0
        rebuilt = mesh.surface_points(model.keypoints.face_index, model.keypoints.barycentric)
        np.testing.assert_allclose(rebuilt, model.keypoints.xyz, atol=1e-9)
        assert len(np.unique(mesh.vertex_colors, axis=0)) >= 2


def test_symmetries_name_keypoints_by_their_rows(models: Models) -> None:
    for model, _ in models:
        xyz = model.keypoints.xyz
        if model.category != "bottle":
            assert model.symmetries.reflections
            for right, left in model.symmetries.reflections:
                assert xyz[right, 0] > 1e-3
                np.testing.assert_allclose(xyz[right] * (-1, 1, 1), xyz[left], atol=1e-6)
        for group in model.symmetries.rotations:
            assert (group.circle is not None) == (model.category == "bottle")
            if group.circle is None:  # the feet of an office chair
                assert (model.category, len(group.keypoints)) == ("chair", 5)
                continue
            offset = xyz[list(group.keypoints)] - group.circle.center
            np.testing.assert_allclose(offset @ group.circle.normal, 0, atol=1e-6)
            distance = np.linalg.norm(offset, axis=1)
            np.testing.assert_allclose(distance, group.circle.radius, rtol=2e-3)


# Repeatable and safe -----------------------------------------------------------------------------


def test_a_model_depends_neither_on_the_count_nor_on_the_categories(
    root: Path, tmp_path: Path
) -> None:
    whole = contents(root)
    some = write_sample_dataset(tmp_path / "new/data", per_category=2, categories=["car", "chair"])
    meshes = {name: data for name, data in contents(some).items() if name.endswith(".ply")}
    assert len(meshes) == 4
    assert meshes.items() <= whole.items()
    assert [path.name for path in sorted(some.glob("annotations/*"))] == ["car.json", "chair.json"]
    assert (some / "splits" / "test.txt").read_text() == ""


def test_the_same_data_set_is_kept_and_another_one_refused(tmp_path: Path) -> None:
    root = write_sample_dataset(tmp_path / "data", per_category=1, categories=["bottle"])
    (path,) = root.glob("*/*/*.ply")
    written = path.stat().st_mtime_ns
    write_sample_dataset(root, per_category=1, categories=["bottle"])
    assert path.stat().st_mtime_ns == written
    for arguments in ({"per_category": 2, "categories": ["bottle"]}, {"per_category": 1}):
        with pytest.raises(DataError, match="neither empty nor a sample data set of the same"):
            write_sample_dataset(root, **arguments)
    assert path.stat().st_mtime_ns == written


@pytest.mark.parametrize(
    ("error", "told"),
    [(OSError(28, "No space left"), DataError), (KeyboardInterrupt(), KeyboardInterrupt)],
)
def test_an_interrupted_write_leaves_no_files(
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


def test_other_files_are_never_overwritten(tmp_path: Path) -> None:
    mine = tmp_path / "mine" / "annotations" / "chair.json"
    mine.parent.mkdir(parents=True)
    mine.write_text("[]")
    for place in (tmp_path / "mine", mine):
        with pytest.raises(DataError, match="give a new or an empty folder"):
            write_sample_dataset(place, per_category=1)
    assert mine.read_text() == "[]"


@pytest.mark.parametrize(
    ("arguments", "where"),
    [
        ({"per_category": 0}, "per_category"),
        ({"per_category": 2.0}, "per_category"),
        ({"categories": ["sofa"]}, "categories"),
        ({"categories": "chair"}, "categories"),
    ],
)
def test_impossible_arguments_are_refused(
    tmp_path: Path, arguments: dict[str, Any], where: str
) -> None:
    with pytest.raises(InputError) as caught:
        write_sample_dataset(tmp_path / "data", **arguments)
    assert caught.value.where == where
    assert list(tmp_path.iterdir()) == []


# The models --------------------------------------------------------------------------------------


def test_models_have_diagonal_one_and_a_moderate_number_of_faces(models: Models) -> None:
    for model, mesh in models:
        low, high = mesh.bounds
        assert np.linalg.norm(high - low) == pytest.approx(1.0, abs=1e-6)
        middle = (low + high) / 2
        assert middle[0] == pytest.approx(0.0, abs=1e-6)
        assert 0 < np.linalg.norm(middle) < 0.15
        corners = mesh.triangles
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert np.linalg.norm(cross, axis=1).min() > 1e-12, model.model_id
        assert 500 <= len(mesh.faces) <= 9000, model.model_id
        assert len(np.unique(mesh.faces)) == len(mesh.vertices)


@pytest.mark.long
@pytest.mark.parametrize("category", CATEGORIES)
def test_parts_are_closed_and_face_outward(category: str) -> None:
    for index in range(12):
        draft = MAKERS[category](np.random.default_rng(index), index)
        for part in draft.parts:
            edges = np.concatenate([part.faces[:, [i, (i + 1) % 3]] for i in range(3)])
            count = len(part.vertices)
            forward, backward = np.sort(edges @ [count, 1]), np.sort(edges @ [1, count])
            assert (forward == backward).all(), (category, index)
            assert _volume(part) > 0, (category, index)
        if category in ("car", "vessel"):  # keypoints are placed on the surface or close to it
            whole, places = join(draft.parts, category), np.array([*draft.places.values()])
            found = whole.surface_points(*whole.closest(places))
            size = np.linalg.norm(np.ptp(whole.bounds, axis=0))
            assert np.linalg.norm(found - places, axis=1).max() < 0.02 * size


def test_axes_are_those_of_keypointnet(models: Models) -> None:
    """y up; cars and vessels are longest along z, but for sails; chairs face -z."""
    for model, mesh in models:
        x, y, z = np.ptp(mesh.bounds, axis=0)
        at = dict(zip(model.keypoints.ids.tolist(), model.keypoints.xyz, strict=True))
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


def test_semantic_ids_are_ordered_unique_and_mean_the_same_place(models: Models) -> None:
    """In the bounding box, a point stays in its half of every axis that it is far out on."""
    for category, fewest in FEWEST_KEYPOINTS.items():
        places: dict[int, list[np.ndarray]] = {}
        for model, mesh in models:
            if model.category == category:
                ids = model.keypoints.ids.tolist()
                assert ids == sorted(set(ids))
                assert len(ids) >= fewest
                low, high = mesh.bounds
                for number, share in zip(
                    ids, 2 * (model.keypoints.xyz - low) / (high - low) - 1, strict=True
                ):
                    places.setdefault(number, []).append(share)
        assert sum(len(rows) == 12 for rows in places.values()) >= 6
        for semantic_id, rows in places.items():
            shares = np.array(rows)
            far = np.abs(np.median(shares, axis=0)) > 0.6
            same = np.sign(shares[:, far]) == np.sign(np.median(shares, axis=0)[far])
            assert same.all(), (category, semantic_id)


def test_keypoints_are_not_in_one_plane_and_apart(models: Models) -> None:
    for model, _ in models:
        points = model.keypoints.xyz
        values = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        assert values[2] / values[0] > 0.05, model.model_id
        distances = np.linalg.norm(points[:, None] - points[None], axis=2)
        assert distances[np.triu_indices(len(points), 1)].min() > 0.005, model.model_id


@pytest.mark.long
def test_models_are_mirror_symmetric(models: Models) -> None:
    for model, mesh in models:
        tree = cKDTree(mesh.vertices)
        assert tree.query(mesh.vertices * (-1, 1, 1))[0].max() < 1e-6, model.model_id
        colors = np.round(255 * np.asarray(mesh.vertex_colors)[mesh.faces[:, 0], :3])
        centers = np.concatenate([mesh.triangles.mean(axis=1), colors], axis=1)
        # Flat quads may be cut along either diagonal, so most, not all, faces have a partner.
        partner = cKDTree(centers).query(centers * (-1, 1, 1, 1, 1, 1))[0]
        assert np.mean(partner < 1e-5) > 0.8, model.model_id


def _volume(mesh: Mesh) -> float:
    return float(trimesh.Trimesh(mesh.vertices, mesh.faces).volume)


def moments(mesh: Mesh) -> list[float]:
    """Numbers of vertices and faces; weighted means of places, squares and colours."""
    colors = np.asarray(mesh.vertex_colors, dtype=float)[:, :3]
    weights = 1 + np.arange(len(mesh.vertices)) % 7  # exchanged vertices differ
    parts = [mesh.vertices, mesh.vertices**2, colors]
    means = [np.average(part, axis=0, weights=weights[: len(part)]) for part in parts]
    return [len(mesh.vertices), len(mesh.faces), *np.concatenate(means)]


def test_models_are_those_that_results_were_measured_on(models: Models) -> None:
    """`python tests/datasets/test_sample_dataset.py` stores them anew where they are to change."""
    stored = json.loads(MOMENTS.read_text())
    assert len(stored) == len(models)
    for model, mesh in models:
        assert moments(mesh) == pytest.approx(stored[model.model_id], rel=1e-6, abs=1e-9)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        found = models_in(write_sample_dataset(Path(folder, "data")))
    MOMENTS.write_text(json.dumps({model.model_id: moments(mesh) for model, mesh in found}) + "\n")
