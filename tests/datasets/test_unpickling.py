"""Pickles of arrays, lists and tuples are loaded, and no pickle runs code."""

from __future__ import annotations

import io
import os
import pickle
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from cadalign.datasets.unpickling import load_pickle
from cadalign.errors import DataError

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


class Python2Pickler(pickle._Pickler):
    """Writes protocol 2 as Python 2 did: bytes and text as Python 2's str."""

    dispatch: ClassVar = dict(pickle._Pickler.dispatch)

    def save_string(self, obj):
        data = obj if isinstance(obj, bytes) else obj.encode("latin1")
        self.write(pickle.BINSTRING + struct.pack("<i", len(data)) + data)
        self.memoize(obj)

    dispatch[bytes] = save_string
    dispatch[str] = save_string


def python2_bytes(value: Any) -> bytes:
    buffer = io.BytesIO()
    Python2Pickler(buffer, protocol=2, fix_imports=True).dump(value)
    # NumPy's modules had other names.
    return buffer.getvalue().replace(b"cnumpy._core.multiarray\n", b"cnumpy.core.multiarray\n")


def loaded(folder: Path, data: bytes) -> Any:
    (folder / "a.pkl").write_bytes(data)
    return load_pickle(folder / "a.pkl")


def assert_same(found: Any, expected: Any) -> None:
    # NumPy gives some bytes back in the machine's own order.
    assert found.dtype.newbyteorder("=") == expected.dtype.newbyteorder("=")
    assert found.shape == expected.shape
    np.testing.assert_array_equal(found, expected)


# --- what is allowed


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_arrays_scalars_and_containers_survive_all_protocols(tmp_path, protocol):
    objects = np.empty(2, dtype=object)
    objects[:] = [np.arange(3.0), [1, "text", None, -(10**30)]]
    shared = [1.5, (True, ())]
    values = [*VALUES, objects, shared, shared]
    found = loaded(tmp_path, pickle.dumps(values, protocol=protocol))
    for each, value in zip(found, VALUES, strict=False):
        assert_same(each, value)
    assert found[len(VALUES)][0].tolist() == [0, 1, 2]
    assert found[len(VALUES)][1] == objects[1]
    assert found[-2:] == values[-2:]
    assert all(type(each) is np.ndarray for each in found[:9])


def test_python_2_pickles_are_understood(tmp_path):
    values = [value for value in VALUES if value.dtype.kind != "U"]
    data = python2_bytes([values, ["\xe9", b"\xff"]])
    assert b"numpy._core" not in data
    assert b"_codecs" not in data
    found, texts = loaded(tmp_path, data)
    for each, value in zip(found, values, strict=True):
        assert_same(each, value)
    assert texts == ["\xe9", "\xff"]


# --- what is refused


class Call:
    """Pickles as a call."""

    def __init__(self, function, *args) -> None:
        self.call = function, args

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_a_pickle_that_would_run_a_command_is_refused_and_does_not(tmp_path, protocol):
    proof = tmp_path / "it ran"
    objects = np.empty(1, dtype=object)
    objects[0] = (1, [Call(os.system, f"touch '{proof}'")])
    for value in (objects[0][1], objects, (np.zeros(2), [objects])):
        trap = pickle.dumps(value, protocol=protocol)
        with pytest.raises(DataError) as caught:
            loaded(tmp_path, trap)
        assert "the pickle imports posix.system, which is not allowed" in str(caught.value)
        assert caught.value.where == str(tmp_path / "a.pkl")
    assert not proof.exists()
    pickle.loads(trap)  # the trap works where nothing guards against it
    assert proof.exists()


@pytest.mark.parametrize(
    "name",
    [
        *("builtins.eval", "builtins.getattr", "__builtin__.eval", "numpy.load", "numpy.matrix"),
        *("numpy.core.multiarray.fromfile", "numpy.ndarray.tofile", "collections.defaultdict"),
        *("copyreg._reconstructor", "subprocess.Popen", "operator.attrgetter", "no_such.anything"),
    ],
)
def test_other_imports_are_refused_by_name(tmp_path, name):
    module, _, attribute = name.rpartition(".")
    if name == "numpy.ndarray.tofile":
        module, attribute = "numpy", "ndarray.tofile"  # protocol 4 looks attributes up by dots
    named = b"\x80\x04" + b"".join(
        pickle.BINUNICODE + struct.pack("<I", len(part)) + part.encode()
        for part in (module, attribute)
    )
    with pytest.raises(DataError, match=rf"imports {name}, which is not allowed"):
        loaded(tmp_path, named + pickle.STACK_GLOBAL + b".")


def array_pickle(code: bytes, dtype_state: bytes, shape: bytes, data: bytes) -> bytes:
    """An array in protocol 0's text, its parts free to contradict each other."""
    return (
        b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(I0\ntS'b'\ntR"
        b"(I1\n(" + shape + b"tcnumpy\ndtype\n(S'" + code + b"'\nI0\nI1\ntR"
        b"(" + dtype_state + b"tbI00\n" + data + b"tb."
    )


PLAIN = b"I3\nS'<'\nNNNI-1\nI-1\nI0\n"
OBJECTS = b"I3\nS'|'\nNNNI-1\nI-1\nI63\n"
TWO, POINTER = b"S'" + b"a" * 16 + b"'\n", b"S'" + b"A" * 8 + b"'\n"


@pytest.mark.parametrize(
    "arguments",
    [
        (b"f8", PLAIN, b"I3\n", TWO),  # less data than its shape
        (b"f8", PLAIN, b"I-1\nI-2\n", TWO),
        (b"f8", PLAIN, b"I4294967296\nI4294967296\n", TWO),  # overflows
        (b"f8", PLAIN, b"N", TWO),
        (b"O8", OBJECTS.replace(b"63", b"0"), b"I1\n", POINTER),  # bytes as addresses of objects
        (b"O8", OBJECTS, b"I5\n", b"(l"),  # fewer objects than its shape
        (b"V8", OBJECTS, b"I1\n", POINTER),
        (b"O,O", OBJECTS, b"I1\n", POINTER),
    ],
)
def test_arrays_that_contradict_themselves_are_refused(tmp_path, arguments):
    assert loaded(tmp_path, array_pickle(b"f8", PLAIN, b"I2\n", TWO)).shape == (2,)
    with pytest.raises(DataError, match="not a whole pickle of arrays"):
        loaded(tmp_path, array_pickle(*arguments))


def test_a_pickle_cut_anywhere_is_refused(tmp_path):
    data = python2_bytes([np.arange(4.0), (1,)])
    for length in range(len(data)):
        with pytest.raises(DataError, match=r"a.pkl: not a whole pickle of arrays"):
            loaded(tmp_path, data[:length])


def doubled(levels: int) -> list[Any]:
    """Lists that each hold the next one twice: 2^levels values in a few bytes."""
    value: list[Any] = [0.0]
    for _ in range(levels):
        value = [value, value]
    return value


PICKLES = {
    "itself": b"\x80\x02]q\x00(h\x00h\x00e.",
    "doubled": pickle.dumps(doubled(40), protocol=2),
    "tuples": b"\x80\x02" + b"(" * 1_000_000 + b"t" * 1_000_000 + b".",
    "key": b"\x80\x02})" + b"\x85" * 1_000_000 + b"K\x01s.",
    "integer": b"\x80\x02\x8b\xff\xff\xff\x7f.",
    "bytes": b"\x80\x04\x8e\xff\xff\xff\xff\xff\xff\xff\x0f.",
    "array": b"\x80\x05\x96\xff\xff\xff\xff\xff\xff\xff\x0f.",
    "stack": b"\x80\x02" + b"0" * 10 + b".",
    "build": b"cnumpy.core.multiarray\n_reconstruct\n(N(dS'__defaults__'\n(I1\ntstb.",
    "text": b"\x80\x02X\x01\x00\x00\x00a)b.",
    "memory": b"\x80\x02Nr\xff\xff\xff\x7f.",
    "set": b"\x80\x04\x8f(K\x01\x90.",
    "dictionary": b"\x80\x02}K\x01K\x02s.",
    "nothing": b"",
}


# One text in 3,000 arrays, which are of 3 GB together if each copies it.
TEXT = b"S'" + b"a" * 1_000_000 + b"'\n"
SHARED = array_pickle(b"f8", PLAIN, b"I125000\n", TEXT + b"p0\n")[:-1]
PICKLES["copies"] = b"(" + SHARED + 2999 * SHARED.replace(TEXT + b"p0", b"g0") + b"l."


@pytest.mark.long
@pytest.mark.parametrize("name", PICKLES)
def test_hostile_pickles_are_refused_quickly_or_read_without_copies(tmp_path, name):
    (tmp_path / "a.pkl").write_bytes(PICKLES[name])
    # In its own process, which may neither crash nor take more than 300 MB on top.
    code = (
        "import resource, sys\n"
        "from cadalign.datasets.unpickling import load_pickle\n"
        "from cadalign.errors import DataError\n"
        "size = int(open('/proc/self/statm').read().split()[0]) * resource.getpagesize()\n"
        "resource.setrlimit(resource.RLIMIT_AS, (size + 300_000_000,) * 2)\n"
        "try:\n"
        "    load_pickle(sys.argv[1])\n"
        "except DataError as error:\n"
        "    sys.exit(7 if len(str(error)) < 500 + len(sys.argv[1]) else 8)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, tmp_path / "a.pkl"], timeout=60, check=False)
    assert done.returncode == (0 if name == "copies" else 7)
