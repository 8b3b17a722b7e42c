"""Blind PnP's pickles arrive as correspondences, and no pickle runs code."""

from __future__ import annotations

import collections
import copy
import io
import os
import pickle
import struct
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from cadalign.datasets import BlindPnP
from cadalign.datasets.sfm.unpickling import load_pickle
from cadalign.errors import DataError, InputError

SAMPLES = 4


# --- writing files as Python 2 and Python 3 do


class Python2Pickler(pickle._Pickler):
    """Writes protocol 2 as Python 2 did: bytes and text as Python 2's str."""

    dispatch: ClassVar = dict(pickle._Pickler.dispatch)

    def save_string(self, obj):
        data = obj if isinstance(obj, bytes) else obj.encode("latin1")
        self.write(pickle.BINSTRING + struct.pack("<i", len(data)) + data)
        self.memoize(obj)

    dispatch[bytes] = save_string
    dispatch[str] = save_string


def python2_bytes(value) -> bytes:
    buffer = io.BytesIO()
    Python2Pickler(buffer, protocol=2, fix_imports=True).dump(value)
    # NumPy's modules had other names, and dtypes no booleans for align and copy.
    return buffer.getvalue().replace(b"cnumpy._core.multiarray\n", b"cnumpy.core.multiarray\n")


def write(path: Path, value) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(python2_bytes(value))


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
def test_matches_arrive(tmp_path, dtype):
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


def test_inlier_matches_say_what_belongs_together(tmp_path):
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


def test_focal_lengths_come_from_the_file_the_argument_or_the_default(tmp_path):
    samples = Samples()
    folder = samples.write(tmp_path)
    assert BlindPnP(folder)[0].camera.fx == 800
    write(folder / "focal.pkl", [np.float64(525.0), 300.0, np.array([500.0, 510.0]), [400]])
    cameras = [sample.camera for sample in BlindPnP(folder)]
    assert [(c.fx, c.fy) for c in cameras] == [(525, 525), (300, 300), (500, 510), (400, 400)]
    assert BlindPnP(folder, focal=100)[0].camera.fx == 100
    for focal in (0, -1, np.nan):
        with pytest.raises(InputError, match="focal"):
            BlindPnP(folder, focal=focal)


def test_the_virtual_image_just_holds_the_points(tmp_path):
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
        ("matches", np.zeros((0, 5)), "names row 0 of 0 in matches"),
        ("inlier_matches", np.zeros((0, 2)), "there are no correspondences"),
        ("matches", None, "matches: "),
        ("R", 2 * np.eye(3), "not a rotation matrix"),
        ("R", np.diag([1.0, 1.0, -1.0]), "not a rotation matrix"),
        ("t", np.zeros(2), "translation: shape"),
        ("t", [], "t: is empty"),
        ("focal", -5.0, r"focal: \[-5.0\] are no focal lengths"),
        ("inlier_matches", np.array([[0, 10]]), "names row 10 of 10 in matches"),
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
    with pytest.raises(DataError, match=r"under the true pose .* apart.*inlier_matches.pkl"):
        BlindPnP(samples.write(tmp_path, data))[0]


def test_files_of_different_length_are_refused(tmp_path):
    samples = Samples()
    folder = samples.write(tmp_path, samples.matches() | {"R": samples.R[:3]})
    with pytest.raises(DataError, match=r"R.pkl: holds 3 samples, t.pkl 4"):
        BlindPnP(folder)


def test_missing_files_are_named(tmp_path):
    with pytest.raises(DataError, match="no such folder"):
        BlindPnP(tmp_path / "nowhere")
    with pytest.raises(DataError, match="there are no correspondences"):
        BlindPnP(tmp_path)
    (Samples().write(tmp_path) / "matches.pkl").unlink()
    with pytest.raises(DataError, match=r"matches.pkl is missing"):
        BlindPnP(tmp_path)
    write(tmp_path / "matches.pkl", [])
    write(tmp_path / "t.pkl", np.float64(3))
    with pytest.raises(DataError, match=r"t.pkl: holds float64, not a list"):
        BlindPnP(tmp_path)


# --- pickles: what is allowed


VALUES = [
    np.arange(6.0).reshape(2, 3),
    np.asfortranarray(np.arange(6, dtype=np.int32).reshape(2, 3)),
    np.arange(24.0).reshape(2, 3, 4).transpose(1, 0, 2),
    np.arange(5, dtype=">u2"),
    np.array([True, False]),
    np.array(["a", "bc"]),
    np.array([1 + 2j]),
    np.zeros((0, 3)),
    np.array(7.5),
    np.float32(1.5),
    np.int64(-3),
    np.bool_(True),
]


@pytest.mark.parametrize("protocol", [0, 1, 2, 3, 4, 5])
def test_arrays_scalars_and_containers_survive_all_protocols(tmp_path, protocol):
    objects = np.empty(2, dtype=object)
    objects[:] = [np.arange(3.0), {"a": [1, "text", b"bytes", None]}]
    values = [*VALUES, objects, {1, 2}, frozenset([3]), collections.OrderedDict(a=(1, 2.5))]
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(values, protocol=protocol))
    loaded = load_pickle(tmp_path / "a.pkl")
    for value, back in zip(VALUES, loaded, strict=False):
        # NumPy gives some bytes back in the machine's own order.
        assert back.dtype.newbyteorder("=") == value.dtype.newbyteorder("=")
        assert back.shape == value.shape
        np.testing.assert_array_equal(back, value)
    assert loaded[len(VALUES)][0].tolist() == [0, 1, 2]
    assert loaded[len(VALUES)][1] == objects[1]
    assert loaded[-3:] == values[-3:]


def test_python_2_pickles_are_understood(tmp_path):
    values = [value for value in VALUES if value.dtype.kind != "U"]
    data = python2_bytes(values)
    assert b"numpy._core" not in data
    assert b"_codecs" not in data
    (tmp_path / "a.pkl").write_bytes(data)
    for value, back in zip(values, load_pickle(tmp_path / "a.pkl"), strict=True):
        assert back.dtype.newbyteorder("=") == value.dtype.newbyteorder("=")
        np.testing.assert_array_equal(back, value)


# --- pickles: what is refused


class Call:
    """Pickles as a call."""

    def __init__(self, function, *args) -> None:
        self.call = function, args

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_a_pickle_that_would_run_a_command_is_refused_and_does_not(tmp_path, protocol):
    proof = tmp_path / "it ran"
    folder = Samples().write(tmp_path / "split")
    trap = pickle.dumps([Call(os.system, f"touch '{proof}'")] * SAMPLES, protocol=protocol)
    (folder / "matches.pkl").write_bytes(trap)
    with pytest.raises(DataError) as caught:
        BlindPnP(folder)
    assert not proof.exists()
    assert "the pickle asks for posix.system, which is refused" in str(caught.value)
    assert caught.value.where == str(folder / "matches.pkl")
    # The trap works where nothing guards against it.
    pickle.loads(trap)
    assert proof.exists()


@pytest.mark.parametrize(
    "name",
    [
        "builtins.eval",
        "builtins.getattr",
        "builtins.__import__",
        "__builtin__.eval",
        "numpy.load",
        "numpy.f2py.compile",
        "numpy.core.multiarray.fromfile",
        "numpy._core.multiarray.add_docstring",
        "numpy.testing.run_module_suite",
        "numpy.matrix",
        "numpy.ndarray.tofile",
        "collections.defaultdict",
        "copyreg._reconstructor",
        "subprocess.Popen",
        "functools.partial",
        "operator.attrgetter",
        "torch._utils._rebuild_tensor",
        "no_such_module.anything",
    ],
)
def test_everything_else_is_refused_by_name(tmp_path, name):
    module, _, attribute = name.rpartition(".")
    if name == "numpy.ndarray.tofile":
        module, attribute = "numpy", "ndarray.tofile"  # protocol 4 looks attributes up by dots
    named = b"\x80\x04" + b"".join(
        pickle.BINUNICODE + struct.pack("<I", len(part)) + part.encode()
        for part in (module, attribute)
    )
    (tmp_path / "a.pkl").write_bytes(named + pickle.STACK_GLOBAL + b".")
    with pytest.raises(DataError) as caught:
        load_pickle(tmp_path / "a.pkl")
    assert f"asks for {module}.{attribute}, which is refused" in str(caught.value)


def test_traps_inside_containers_and_object_arrays_are_refused(tmp_path):
    proof = tmp_path / "it ran"
    trap = Call(eval, f"open({str(proof)!r}, 'w')")
    array = np.empty(1, dtype=object)
    array[0] = {"x": (1, [trap])}
    for value in ([{"a": {"b": trap}}], array, (np.zeros(2), [array])):
        (tmp_path / "a.pkl").write_bytes(pickle.dumps(value))
        with pytest.raises(DataError, match=r"asks for builtins.eval"):
            load_pickle(tmp_path / "a.pkl")
    assert not proof.exists()


def array_pickle(code: bytes, dtype_state: bytes, array_state: bytes) -> bytes:
    """An array in protocol 0's text, its parts free to contradict each other."""
    return (
        b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(I0\ntS'b'\ntR"
        b"(I1\n(" + array_state.split(b"|")[0] + b"tcnumpy\ndtype\n(S'" + code + b"'\nI0\nI1\ntR"
        b"(" + dtype_state + b"tbI00\n" + array_state.split(b"|")[1] + b"tb."
    )


PLAIN = b"I3\nS'<'\nNNNI-1\nI-1\nI0\n"


def test_arrays_that_contradict_themselves_are_refused(tmp_path):
    whole = array_pickle(b"f8", PLAIN, b"I2\n|S'" + b"a" * 16 + b"'\n")
    (tmp_path / "a.pkl").write_bytes(whole)
    assert load_pickle(tmp_path / "a.pkl").shape == (2,)
    pointers = b"S'" + b"A" * 8 + b"'\n"
    objects = b"I3\nS'|'\nNNNI-1\nI-1\nI63\n"
    traps = {
        "less data than its shape": array_pickle(b"f8", PLAIN, b"I3\n|S'" + b"a" * 16 + b"'\n"),
        "a negative shape": array_pickle(b"f8", PLAIN, b"I-1\nI-2\n|S'" + b"a" * 16 + b"'\n"),
        "a shape that overflows": array_pickle(
            b"f8", PLAIN, b"I4294967296\nI4294967296\n|S'" + b"a" * 16 + b"'\n"
        ),
        "objects given as bytes": array_pickle(
            b"O8", objects.replace(b"63", b"0"), b"I1\n|" + pointers
        ),
        "fewer objects than its shape": array_pickle(b"O8", objects, b"I5\n|(l"),
        "a record": array_pickle(b"V8", objects, b"I1\n|" + pointers),
        "several fields": array_pickle(b"O,O", objects, b"I1\n|" + pointers),
    }
    for name, trap in traps.items():
        (tmp_path / "a.pkl").write_bytes(trap)
        with pytest.raises(DataError, match="not a whole pickle of arrays"):
            pytest.fail(f"{name} gave {load_pickle(tmp_path / 'a.pkl')!r}")


def test_a_pickle_cannot_change_what_the_next_one_is_given(tmp_path):
    # BUILD sets attributes of what it finds on the stack, here of the function itself.
    spoiled = b"cnumpy.core.multiarray\n_reconstruct\n(N(dS'__defaults__'\n(I1\ntstb."
    (tmp_path / "a.pkl").write_bytes(spoiled)
    load_pickle(tmp_path / "a.pkl")
    (tmp_path / "b.pkl").write_bytes(b"cnumpy.core.multiarray\n_reconstruct\n.")
    assert load_pickle(tmp_path / "b.pkl").__defaults__ is None


def test_a_pickle_cut_anywhere_is_refused(tmp_path):
    data = python2_bytes([np.arange(4.0), {"a": 1}])
    for length in range(len(data)):
        (tmp_path / "a.pkl").write_bytes(data[:length])
        with pytest.raises(DataError, match=r"a.pkl: not a whole pickle of arrays"):
            load_pickle(tmp_path / "a.pkl")


def test_a_pickle_that_is_not_there_is_named(tmp_path):
    with pytest.raises(DataError, match=r"a.pkl: no such file"):
        load_pickle(tmp_path / "a.pkl")
