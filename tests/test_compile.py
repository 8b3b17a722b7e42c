"""Disk cache of compiled kernels, used by several processes at the same time."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from support.forked import Program

from cadalign.compile import folder, kernel, once
from cadalign.compile.folder import kernel_folder

pytestmark = pytest.mark.slow

MODULE = """
import os
from cadalign.compile import kernel

@kernel
def twice(x):
    return x + x
"""
USE = """
import sys
sys.path.insert(0, {folder!r})
import numpy as np, kernels
for value in ({values}):
    assert kernels.twice(value) == 2 * value
print(sum(kernels.twice.stats.cache_hits.values()))
"""


def use(folder: Path, values: str) -> Program:
    return Program(USE.format(folder=str(folder), values=values))


def hits(process: Program) -> int:
    out, error = process.communicate()
    assert process.poll() == 0, error
    return int(out)


@pytest.mark.long
def test_processes_that_compile_at_the_same_time_keep_each_others_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    (tmp_path / "kernels.py").write_text(MODULE)
    values = ["1,", "1.5,", "1j,", "np.float32(2),"]
    for process in [use(tmp_path, value) for value in values]:
        hits(process)
    assert hits(use(tmp_path, "".join(values))) == len(values)


SOURCES = """
from cadalign.compile import kernel

@kernel
def one(x):
    return x + {term}
"""
CALL = """
import sys
sys.dont_write_bytecode = True  # the sources change more than once per second
sys.path.insert(0, {folder!r})
import importlib
one = importlib.import_module({module!r}).one
assert one(1.0) == {value}
print(sum(one.stats.cache_hits.values()))
"""


def call(folder: Path, module: str, value: float, cache: Path) -> int:
    """Call a kernel in a new process; returns the number of cache hits."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("NUMBA_CACHE_DIR", str(cache))
        return hits(Program(CALL.format(folder=str(folder), module=module, value=value)))


def write(place: Path, term: str) -> None:
    place.mkdir(exist_ok=True)
    (place / "kernels.py").write_text(SOURCES.format(term=term))


@pytest.mark.long
def test_code_is_found_by_another_process_and_from_another_checkout(tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    write(tmp_path / "a", "1.0")
    assert call(tmp_path / "a", "kernels", 2.0, cache) == 0
    assert call(tmp_path / "a", "kernels", 2.0, cache) == 1
    write(tmp_path / "b", "1.0")
    assert call(tmp_path / "b", "kernels", 2.0, cache) == 1


def test_the_folder_is_named_by_versions_and_every_module_with_kernels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = Path(folder.__file__).parents[1]
    users = [
        path.relative_to(package)
        for path in package.rglob("*.py")
        if "from cadalign.compile import" in path.read_text()
    ]
    assert Path("solvers/optimal.py") in users
    for path in users:
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text("1")
    (tmp_path / "compile").mkdir()
    monkeypatch.setattr(folder, "_PACKAGE", tmp_path)

    def named() -> Path:
        folder._version.cache_clear()
        return kernel_folder()

    before = named()
    assert named() == before
    for version in ((folder.numba, "__version__"), (folder.sys.implementation, "cache_tag")):
        with monkeypatch.context() as patched:
            patched.setattr(*version, "another")
            assert named() != before
    for path in users:
        (tmp_path / path).write_text("2")
        assert named() != before, f"{path} is not among the sources of kernels"
        (tmp_path / path).write_text("1")


@pytest.mark.long
def test_kernels_do_without_private_names_of_numba(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Small kernels and a family stand for a fit, which would take a minute."""
    code = """
import numba.core.codegen, numpy as np, typing
del numba.core.codegen.JITCodeLibrary
from cadalign import compile
from cadalign.compile import fast_sums, kernel, kernel_family
from cadalign.solvers.linalg import cross
from cadalign.solvers.unknowns import orthonormalize
assert compile.KernelDispatcher is None
class Square(typing.NamedTuple):
    side: float
size_of = kernel_family("size_of")
@size_of.of(Square)
@kernel
def size_of_square(square): return square.side ** 2
@fast_sums
def doubled(square): return 2.0 * size_of(square)
assert doubled(Square(3.0)) == 18.0 == 2 * size_of(Square(3.0))
assert cross((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)) == (0.0, 0.0, 1.0)
pose = np.append(np.eye(3).ravel() + 1e-5, np.ones(6))
orthonormalize(pose)
rotation = pose[:9].reshape(3, 3)
assert np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-9
"""
    program = tmp_path / "program.py"
    program.write_text(code)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    command = [sys.executable, str(program)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr


@pytest.mark.long
def test_kernels_compile_without_write_access(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    write(tmp_path / "a", "1.0")
    assert call(tmp_path / "a", "kernels", 2.0, tmp_path / "file") == 0


def emptied(data: bytes) -> bytes:
    return b""


def cut(data: bytes) -> bytes:
    return data[: len(data) // 2]


def zeroed(data: bytes) -> bytes:
    """A file whose last pages a power failure left unwritten."""
    return data[: len(data) // 3] + bytes(len(data) - len(data) // 3)


@pytest.mark.long
@pytest.mark.parametrize("damage", [emptied, zeroed, cut])
def test_damaged_code_is_compiled_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, damage: Callable[[bytes], bytes]
) -> None:
    (tmp_path / "a").mkdir()
    source = SOURCES.format(term="1.0")
    # A kernel that another one calls has its own file.
    (tmp_path / "a" / "kernels.py").write_text(
        source.replace("one", "inner")
        + source.replace("x + 1.0", "inner(x)").split("import kernel")[1]
    )
    cache = tmp_path / "cache"
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(cache))
    code = CALL.format(folder=str(tmp_path / "a"), module="kernels", value=2.0)
    assert [hits(Program(code)) for _ in range(2)] == [0, 1]
    files = sorted(cache.rglob("*.nbc"))
    assert len(files) == 2
    for path in files:
        path.write_bytes(damage(path.read_bytes()))
    assert [hits(Program(code)) for _ in range(2)] == [0, 1]


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("stream", [Terminal(), io.StringIO()])
def test_compilation_is_announced_once_on_a_terminal(
    stream: io.StringIO, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))

    @kernel
    def doubled(x: float) -> float:
        return 2.0 * x

    monkeypatch.setattr(sys, "stderr", stream)
    once.announce_compiling.cache_clear()
    assert (doubled(1.0), doubled(1)) == (2.0, 2.0)
    message = "Compiling cadalign's solvers (once per version, up to a minute)\n"
    assert stream.getvalue() == (message if stream.isatty() else "")
