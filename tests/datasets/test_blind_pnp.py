"""Correspondences from blind PnP's pickles."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path

import numpy as np
import pytest

from cadalign.datasets import BlindPnP
from cadalign.errors import DataError

SAMPLES = 4


def write(path: Path, value) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps(value, protocol=2))


def random_rotation(rng) -> np.ndarray:
    matrix, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return matrix * np.sign(np.linalg.det(matrix))


class Samples:
    """Scenes with poses."""

    def __init__(self, dtype: type = np.float64) -> None:
        rng = np.random.default_rng(7)
        self.rng = rng
        self.R = [random_rotation(rng).astype(dtype) for _ in range(SAMPLES)]
        self.t = [np.array([0.1, 0.2, 6.0], dtype=dtype) for _ in range(SAMPLES)]
        self.p3d = [rng.uniform(-1, 1, (9 + i, 3)).astype(dtype) for i in range(SAMPLES)]
        self.p2d = []
        for rotation, translation, points in zip(self.R, self.t, self.p3d, strict=True):
            points_cam = points @ rotation.T + translation
            self.p2d.append((points_cam[:, :2] / points_cam[:, 2:]).astype(dtype))

    def matches(self) -> dict:
        rows = [np.hstack(pair) for pair in zip(self.p2d, self.p3d, strict=True)]
        return {"matches": rows, "R": self.R, "t": self.t}

    def write(self, folder: Path, data: dict | None = None) -> Path:
        for name, value in (self.matches() if data is None else data).items():
            write(folder / f"{name}.pkl", value)
        return folder


# --- what the files say


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_matches_are_read(tmp_path, dtype):
    samples = Samples(dtype)
    loaded = BlindPnP(samples.write(tmp_path / "nyu_train"))
    assert loaded.names == ("0", "1", "2", "3")
    for i, sample in enumerate(loaded):
        assert sample.id == str(i)
        np.testing.assert_array_equal(sample.points_3d, samples.p3d[i])
        np.testing.assert_allclose(sample.cam_from_world.rotation, samples.R[i], atol=1e-6)
        np.testing.assert_allclose(
            sample.residuals(), 0, atol=1e-3 if dtype is np.float32 else 1e-9
        )
        np.testing.assert_allclose(sample.camera.normalize(sample.points_2d), samples.p2d[i])
    assert not loaded.problems
    assert loaded["2"].id == loaded[2].id == "2"


def test_inlier_matches_pair_points(tmp_path):
    samples = Samples()
    data = samples.matches()
    data["inlier_matches"] = []
    for i, rows in enumerate(data["matches"]):
        order = samples.rng.permutation(len(rows))
        data["matches"][i] = np.hstack([rows[:, :2], rows[order, 2:]])
        # (row of the scene point, row of the image point); the last one has no partner.
        data["inlier_matches"].append(np.stack([np.arange(len(rows)), order], axis=1)[:-1])
    loaded = list(BlindPnP(samples.write(tmp_path, data)))
    assert [len(sample) for sample in loaded] == [8, 9, 10, 11]
    for sample in loaded:
        np.testing.assert_allclose(sample.residuals(), 0, atol=1e-9)


def test_arrays_of_objects_and_stacked_arrays_are_lists_too(tmp_path):
    samples = Samples()
    data = samples.matches()
    ragged = np.empty(SAMPLES, dtype=object)
    ragged[:] = data["matches"]
    data |= {"matches": ragged, "R": np.stack(samples.R), "t": np.stack(samples.t)[:, :, None]}
    for i, sample in enumerate(BlindPnP(samples.write(tmp_path, data))):
        np.testing.assert_array_equal(sample.points_3d, samples.p3d[i])
        np.testing.assert_allclose(sample.residuals(), 0, atol=1e-9)


def test_samples_can_be_sent_to_worker_processes(tmp_path):
    loaded = BlindPnP(Samples().write(tmp_path))
    first = loaded[0]
    again = pickle.loads(pickle.dumps(loaded))
    assert type(again._data["matches"][0]) is np.ndarray
    for sample in (again[0], pickle.loads(pickle.dumps(first)), copy.deepcopy(loaded)[0]):
        np.testing.assert_array_equal(sample.points_2d, first.points_2d)
        assert (sample.id, sample.cam_from_world) == (first.id, first.cam_from_world)


# --- the virtual camera


def test_focal_lengths_come_from_the_file_or_the_default(tmp_path):
    samples = Samples()
    folder = samples.write(tmp_path)
    assert BlindPnP(folder)[0].camera.fx == 800
    write(folder / "focal.pkl", [np.float64(525.0), 300.0, np.array([500.0, 510.0]), [400]])
    cameras = [sample.camera for sample in BlindPnP(folder)]
    assert [(c.fx, c.fy) for c in cameras] == [(525, 525), (300, 300), (500, 510), (400, 400)]


def test_the_virtual_image_has_the_smallest_size_that_holds_the_points(tmp_path):
    for sample in BlindPnP(Samples().write(tmp_path)):
        assert sample.camera.contains(sample.points_2d).all()
        centred = np.abs(sample.points_2d - (sample.camera.cx, sample.camera.cy)).max(axis=0)
        assert (centred > np.array([sample.camera.width, sample.camera.height]) / 2 - 1.5).all()


# --- bad input


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("matches", np.zeros((9, 4)), r"matches: shape \(9, 4\), expected \(n, 5\)"),
        ("matches", np.full((9, 5), np.nan), "matches: NaN or infinite"),
        ("matches", np.zeros((0, 5)), "names row 0, but matches has 0"),
        ("inlier_matches", np.zeros((0, 2)), "there are no correspondences"),
        ("matches", None, "matches: "),
        ("t", [[1], [1, 2]], "t: not an array of numbers"),
        ("R", 2 * np.eye(3), "not a rotation matrix"),
        ("R", np.diag([1.0, 1.0, -1.0]), "not a rotation matrix"),
        ("t", np.zeros(2), "translation: shape"),
        ("t", [], "translation: shape"),
        ("focal", -5.0, r"focal: \[-5.0\] are not focal lengths"),
        ("inlier_matches", np.array([[0, 10]]), "names row 10, but matches has 10"),
    ],
)
def test_a_bad_sample_is_named_and_spoils_no_other(tmp_path, name, value, message):
    samples = Samples()
    data = samples.matches()
    data["focal"] = [500.0] * SAMPLES
    data["inlier_matches"] = [np.tile(np.arange(len(p))[:, None], 2) for p in samples.p3d]
    data[name] = [*data[name]]
    data[name][1] = value
    loaded = BlindPnP(samples.write(tmp_path, data))
    assert [sample.id for sample in loaded] == ["0", "2", "3"]
    assert list(loaded.problems) == ["1"]
    with pytest.raises(DataError, match=message) as caught:
        loaded[1]
    assert caught.value.where.startswith(f"{tmp_path}, 1: ")


def test_shuffled_points_are_refused(tmp_path):
    samples = Samples()
    data = samples.matches()
    data["matches"][0] = np.hstack([samples.p2d[0][::-1], samples.p3d[0]])
    with pytest.raises(DataError, match=r"apart under the true pose.*inlier_matches.pkl"):
        BlindPnP(samples.write(tmp_path, data))[0]


def test_files_of_different_length_are_refused(tmp_path):
    samples = Samples()
    folder = samples.write(tmp_path, samples.matches() | {"R": samples.R[:3]})
    with pytest.raises(DataError, match=r"R.pkl: holds 3 samples, but t.pkl has 4"):
        BlindPnP(folder)


def test_missing_files_are_named(tmp_path):
    with pytest.raises(DataError, match="no such folder"):
        BlindPnP(tmp_path / "nowhere")
    with pytest.raises(DataError, match=r"matches.pkl, R.pkl, t.pkl are missing"):
        BlindPnP(tmp_path)
    (Samples().write(tmp_path) / "matches.pkl").unlink()
    with pytest.raises(DataError, match=r"matches.pkl is missing"):
        BlindPnP(tmp_path)
    write(tmp_path / "matches.pkl", [])
    write(tmp_path / "t.pkl", np.float64(3))
    with pytest.raises(DataError, match=r"t.pkl: holds float64, not a list"):
        BlindPnP(tmp_path)
