"""Imports and start-up cost of commands: a call imports only what it uses."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from support.timing import Measure, ratio, timed_process

from cadalign.cli import COMMANDS, class_of
from cadalign.evaluation.simulation import simulate_problem
from cadalign.io.images import write_image
from cadalign.io.observation import Observation

pytestmark = pytest.mark.long

HEAVY = {
    *("IPython", "OpenGL", "PIL", "cv2", "dask", "embreex", "matplotlib"),
    *("numba", "numpy", "open3d", "pandas", "pyarrow", "pycocotools", "pyrender", "rich"),
    *("scipy.linalg", "scipy.optimize", "scipy.sparse", "scipy.spatial", "scipy.special"),
    *("starlette", "torch", "trimesh", "uvicorn"),
}
MODULES_OF_A_FIT = 74  # of cadalign; its mesh is read to compare units
IN_EVERY_FIT = {"numba", "numpy"}
OTHERS = (["--similar"], ["--robust"])


PROGRAM = """
import json, sys
from cadalign.cli import main
found = []
for arguments in json.loads(sys.argv[1]):
    try:
        code = main(arguments)
    except SystemExit as stop:
        code = stop.code
    found.append([code or 0, sorted(sys.modules)])
print("\\n" + json.dumps(found))
"""


def modules_after(*commands: Sequence[str]) -> list[tuple[int, set[str]]]:
    """Run commands in one process; returns the exit code and all imported modules after each."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, json.dumps(commands)],
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    return [(code, set(modules)) for code, modules in json.loads(done.stdout.splitlines()[-1])]


@pytest.fixture(scope="module")
def observation(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An observation file that names a photo and an OBJ model with a material library."""
    folder = tmp_path_factory.mktemp("observed")
    problem = simulate_problem(np.random.default_rng(0), points=10, noise_px=0.5)
    camera = problem.camera
    photo, model = folder / "photo.jpg", folder / "model.obj"
    write_image(photo, np.full((camera.height, camera.width, 3), 180, dtype=np.uint8))
    vertices = "".join(f"v {x} {y} {z}\n" for x, y, z in problem.points_3d)
    model.write_text(f"mtllib model.mtl\n{vertices}usemtl red\nf 1 2 3\nf 2 3 4\nf 5 6 7 8\n")
    (folder / "model.mtl").write_text("newmtl red\nKd 1 0 0\n")
    Observation(problem.points_3d, problem.points_2d, camera, image=photo, model=model).save(
        folder / "seen.json"
    )
    command = ["fit", str(folder / "seen.json")]
    modules_after(command, *([*command, *each] for each in OTHERS))  # compiling imports more
    return folder / "seen.json"


def test_the_list_of_commands_imports_nothing_heavy() -> None:
    found = modules_after(["--help"], ["--version"], ["fti"])
    assert [(code, HEAVY & modules) for code, modules in found] == [(0, set())] * 2 + [(2, set())]


def test_help_of_a_command_imports_no_more_than_numpy() -> None:
    """All commands run in one process: the first failure names the culprit."""
    found = modules_after(*([command, "--help"] for command in sorted(COMMANDS)))
    for command, (code, modules) in zip(sorted(COMMANDS), found, strict=True):
        assert (code, HEAVY & modules - {"numpy", "rich"}) == (0, set()), command


def test_the_list_of_commands_has_the_first_sentence_of_each() -> None:
    for name, (_, summary) in COMMANDS.items():
        paragraph = str(class_of(name).__doc__).split("\n\n")[0]
        assert " ".join(paragraph.split()) == summary


@pytest.fixture(scope="module")
def fits(observation: Path) -> list[set[str]]:
    """The modules after fits without picture, with one, and with two more options."""
    fit, more = ["fit", str(observation)], (["--json", "--no-picture"], [], *OTHERS)
    found = modules_after(*([*fit, *options] for options in more))
    assert [code for code, _ in found] == [0] * 4
    return [modules for _, modules in found]


def test_a_fit_without_picture_imports_the_solvers_alone(fits: list[set[str]]) -> None:
    assert HEAVY & fits[0] == IN_EVERY_FIT


def test_following_a_fit_takes_few_modules(fits: list[set[str]]) -> None:
    own = {name for name in fits[0] if name.split(".")[0] == "cadalign"}
    assert len(own) <= MODULES_OF_A_FIT, sorted(own)


def test_a_fit_imports_what_draws_its_picture_besides(fits: list[set[str]]) -> None:
    assert HEAVY & fits[1] - {"embreex"} == {*IN_EVERY_FIT, "PIL", "cv2"}


def test_other_fits_import_no_mesh_library(fits: list[set[str]]) -> None:
    assert ["trimesh" in modules for modules in fits[2:]] == [False, False]


# --- times -----------------------------------------------------------------------------------


def command_line(*arguments: str) -> Measure:
    """Measure a command in its own process, without the start of Python."""
    program = (
        "import contextlib, io\nfrom cadalign.cli import main\n"
        "with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):\n"
        f"    main({list(arguments)!r})\n"
    )
    return timed_process(f"exec({program!r})")


# What no fit can do without, and what the limits below are ratios to.
LIBRARIES = timed_process("import numpy, numba")


@pytest.mark.timing
@pytest.mark.parametrize(
    ("arguments", "limit"),
    [(["--help"], 0.8), (["fit", "--json", "--no-picture"], 2.6), (["fit"], 3.2)],
)
def test_warm_commands_are_quick(observation: Path, arguments: list[str], limit: float) -> None:
    files = [str(observation)] if arguments[0] == "fit" else []
    measure = command_line(*arguments, *files)
    measure()  # compiles what is not yet on disk
    assert ratio(measure, LIBRARIES, below=limit) < limit
