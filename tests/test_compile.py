"""Compiled kernels on disk, where several processes compile and read them at the same time."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

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


def use(folder: Path, values: str) -> subprocess.Popen[str]:
    code = USE.format(folder=str(folder), values=values)
    pipe = subprocess.PIPE
    return subprocess.Popen([sys.executable, "-c", code], stdout=pipe, stderr=pipe, text=True)


def hits(process: subprocess.Popen[str]) -> int:
    out, error = process.communicate(timeout=300)
    assert process.returncode == 0, error
    return int(out)


@pytest.mark.slow
def test_processes_that_compile_at_the_same_time_keep_each_others_code(tmp_path: Path) -> None:
    (tmp_path / "kernels.py").write_text(MODULE)
    values = ["1,", "1.5,", "1j,", "np.float32(2),"]
    for process in [use(tmp_path, value) for value in values]:
        hits(process)
    assert hits(use(tmp_path, "".join(values))) == len(values)
