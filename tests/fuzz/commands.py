"""Fuzz the command line: arguments of any kind, in one process, each from a seed."""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
from pathlib import Path

import numpy as np
from fuzz import mutations, readers

from cadalign.cli import main

EXIT_CODES = {0, 1, 2, 3}
_VALUES = [
    "0", "-1", "1", "2", "1e999", "nan", "200000", "99999999999999999999", "", "x", "none", "auto",
    "\u00e9\u4e2d", "-", "--", "/", "/dev/null", "/nonexistent/x", "../..", "a" * 300, "y", "huber",
]  # fmt: skip
_COMMANDS: dict[str, list[str]] = {
    "fit": ["--method", "--loss", "--stretch", "--focal", "--sigma", "--robust", "--similar",
            "--json", "--out", "--shape", "--shape-sigma", "--use-photo", "--model"],
    "observe": ["--image", "--out", "--object", "--min-score"],
    "retrieve": ["--library", "--out", "--top", "--category", "--json", "--loss"],
    "render": ["--out", "--width", "--height", "--view", "--keypoints"],
    "report": ["--out"],
    "library": ["build", "show", "--out", "--categories"],
    "evaluate": ["keypointnet", "correspondences", "retrieval", "unseen", "--methods",
                 "--noise-px", "--shape"],
}  # fmt: skip


def draw_command(seed: int, folder: Path) -> list[str]:
    """Draw the arguments of a seed; files that they name lie in ``folder``."""
    rng = np.random.default_rng([seed, 77])
    command = str(rng.choice(list(_COMMANDS)))
    files = [
        str(folder / name) for name in ("box.obj", "o.json", "broken.json", "photo.png", "pipe", "")
    ]
    words = [command]
    for _ in range(int(rng.integers(0, 5))):
        pool = (
            files if rng.random() < 0.5 else _COMMANDS[command] if rng.random() < 0.7 else _VALUES
        )
        words.append(pool[rng.integers(len(pool))])
    return words


def run_command(seed: int, folder: Path) -> int:
    """Run the command of a seed; anything but one of the exit codes passes through."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    readers.FORMATS["obj"].write(folder)
    readers.FORMATS["image"].write(folder)
    text = readers.FORMATS["observation"].write(folder).read_text()
    (folder / "broken.json").write_text(json.dumps(json.loads(text) | {"camera": None}))
    os.mkfifo(folder / "pipe")
    before = Path.cwd()
    os.chdir(folder)
    try:
        silent = io.StringIO()
        with (
            contextlib.redirect_stdout(silent),
            contextlib.redirect_stderr(silent),
            mutations.bounded(),
        ):
            code = main(draw_command(seed, folder))
    except SystemExit as error:
        code = int(error.code or 0)
    finally:
        os.chdir(before)
    assert code in EXIT_CODES, f"exit code {code}"
    return code
