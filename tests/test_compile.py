"""Compiled kernels on disk, where several processes compile and read them at the same time."""

from __future__ import annotations

import io
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support.forked import Program

from cadalign.compile import files, kernels_needed

pytestmark = pytest.mark.slow

inner: Any = None

MODULE = """
import os
from cadalign.compile import kernel

@kernel
def twice(x):
    return x + x

file = twice._cache._cache_file
save_index = file._save_index

def checked(names):
    assert all(os.path.exists(file._data_path(name)) for name in names.values())
    save_index(names)

file._save_index = checked
"""
USE = """
import sys
sys.path.insert(0, {folder!r})
import numpy as np, kernels
for value in ({values}):
    assert kernels.twice(value) == 2 * value
print(sum(kernels.twice.stats.cache_hits.values()))
"""


# Forked from a process that has compiled code loaded, and knows where it is kept.
ANEW = "from cadalign.compile import files; files._folder.cache_clear(); "


def use(folder: Path, values: str) -> Program:
    return Program(ANEW + USE.format(folder=str(folder), values=values))


def hits(process: Program) -> int:
    out, error = process.communicate()
    assert process.poll() == 0, error
    return int(out)


@pytest.mark.long
def test_processes_that_compile_at_the_same_time_keep_each_others_code(tmp_path: Path) -> None:
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
sys.dont_write_bytecode = True  # of sources that change more than once in a second
sys.path.insert(0, {folder!r})
import importlib
one = importlib.import_module({module!r}).one
assert one(1.0) == {value}
print(sum(one.stats.cache_hits.values()))
"""


def call(folder: Path, module: str, value: float, cache: Path) -> int:
    """Call a kernel in a process; gives how often code was found on disk."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("NUMBA_CACHE_DIR", str(cache))
        return hits(Program(ANEW + CALL.format(folder=str(folder), module=module, value=value)))


def write(folder: Path, term: str) -> None:
    folder.mkdir(exist_ok=True)
    (folder / "kernels.py").write_text(SOURCES.format(term=term))


@pytest.mark.long
def test_code_is_found_by_the_content_of_its_sources(tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    write(tmp_path / "a", "1.0")
    assert call(tmp_path / "a", "kernels", 2.0, cache) == 0
    assert call(tmp_path / "a", "kernels", 2.0, cache) == 1
    write(tmp_path / "b", "1.0")  # another checkout of the same
    assert call(tmp_path / "b", "kernels", 2.0, cache) == 1
    write(tmp_path / "a", "2.0")
    assert call(tmp_path / "a", "kernels", 3.0, cache) == 0
    write(tmp_path / "a", "1.0")  # back to the older version
    assert call(tmp_path / "a", "kernels", 2.0, cache) == 1


def test_a_hash_changes_with_whatever_is_imported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "_PACKAGE", tmp_path)
    texts = {
        "top.py": "from cadalign.inner.middle import (\n    f,\n)\n",
        "inner/__init__.py": "",
        "inner/middle.py": "from cadalign.inner import leaf\nfrom cadalign import inner\n",
        "inner/leaf.py": "import cadalign.last\nVALUE = 1\n",
        "last.py": "",
        "unused.py": "",
    }

    def hashed(**changed: str) -> str:
        for name, text in {**texts, **changed}.items():
            path = tmp_path / name
            path.parent.mkdir(exist_ok=True)
            path.write_text(text)
        files.source_hash.cache_clear()
        files._content.cache_clear()
        return files.source_hash(tmp_path / "top.py")

    before = hashed()
    assert hashed() == before
    assert hashed(**{"unused.py": "1"}) == before
    for name in ("inner/__init__.py", "inner/middle.py", "inner/leaf.py", "last.py"):
        assert hashed(**{name: texts[name] + "# changed"}) != before, name


@pytest.mark.long
def test_nothing_is_lost_where_nothing_can_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    write(tmp_path / "a", "1.0")
    assert call(tmp_path / "a", "kernels", 2.0, tmp_path / "file") == 0


def emptied(data: bytes) -> bytes:
    return b""


def cut(data: bytes) -> bytes:
    return data[: len(data) // 2]


def zeroed(data: bytes) -> bytes:
    """The last pages of a file that were not written when the power failed."""
    return data[: len(data) // 3] + bytes(len(data) - len(data) // 3)


@pytest.mark.long
@pytest.mark.parametrize(("damage", "ending"), [(emptied, ".nbi"), (zeroed, ".nbi"), (cut, ".nbc")])
def test_damaged_code_is_compiled_anew_and_told_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, damage: Callable[[bytes], bytes], ending: str
) -> None:
    (tmp_path / "a").mkdir()
    source = SOURCES.format(term="1.0")
    # What another kernel calls has files of its own.
    (tmp_path / "a" / "kernels.py").write_text(
        source.replace("one", "inner")
        + source.replace("x + 1.0", "inner(x)").split("import kernel")[1]
    )
    cache = tmp_path / "cache"
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(cache))
    code = CALL.format(folder=str(tmp_path / "a"), module="kernels", value=2.0)

    def run() -> tuple[str, list[str]]:
        out, err = Program(ANEW + code).communicate()
        return out, err.splitlines()

    assert (run(), run()) == (("0\n", []), ("1\n", []))
    files = sorted(cache.glob(f"*{ending}"))
    assert len(files) == 2
    for path in files:
        path.write_bytes(damage(path.read_bytes()))
    told = f"{cache}: some of the compiled code is damaged; it is compiled anew"
    assert run() == ("0\n", [told])
    assert run() == ("1\n", [])


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.long
@pytest.mark.parametrize("terminal", [True, False])
def test_a_terminal_is_told_how_far_compiling_is(
    terminal: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    import numba

    monkeypatch.setitem(globals(), "inner", numba.njit(lambda x: x + 1.0))
    outer = numba.njit(lambda x: inner(x) * 2.0)
    stream = Terminal() if terminal else io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    assert len(kernels_needed(outer)) == 2
    assert outer(1.0) == 4.0
    assert not kernels_needed(outer)
    lines = [line.rstrip() for line in stream.getvalue().split("\r")]
    if not terminal:
        assert lines == [""]
        return
    for count in ("0 of 2", "1 of 2"):
        assert any(f"Compiling solvers, once for this version: {count}," in line for line in lines)
    assert lines[-2:] == ["", ""]  # the line is left empty
