"""The package as it is installed: what a wheel holds, and what importing it costs."""

from __future__ import annotations

import json
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from support.timing import ratio, timed_process
from support.wheels import build_wheel, source_files

import cadalign

ROOT = Path(__file__).resolve().parents[1]
HEAVY = {
    "OpenGL",
    "PIL",
    "cv2",
    "dask",
    "embreex",
    "matplotlib",
    "numba",
    "open3d",
    "pandas",
    "pyarrow",
    "pyrender",
    "rich",
    "scipy",
    "starlette",
    "trimesh",
    "tyro",
    "uvicorn",
}
SHARED = "../" + "shared"


def python(code: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_version_is_the_same_everywhere() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    citation = (ROOT / "CITATION.cff").read_text()
    assert project["version"] == cadalign.__version__
    assert f"\nversion: {cadalign.__version__}\n" in citation
    assert project["urls"]


def test_dir_lists_public_names_and_nothing_else() -> None:
    names = dir(cadalign)
    assert names == sorted({*cadalign.__all__, "__version__"})
    assert {"fit", "align", "Library", "Observation", "View", "Model", "ShapeModel"} <= set(names)
    values = [getattr(cadalign, name) for name in set(names) - {"__version__"}]
    origins = [getattr(value, "__module__", None) or value.__name__ for value in values]
    assert {origin.split(".")[0] for origin in origins} == {"cadalign"}


# --- the wheel -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    return zipfile.ZipFile(build_wheel(tmp_path_factory.mktemp("wheel")))


@pytest.mark.long
def test_only_top_level_name_of_the_wheel_is_cadalign(wheel: zipfile.ZipFile) -> None:
    names = {name.split("/")[0] for name in wheel.namelist()}
    assert {name for name in names if not name.endswith(".dist-info")} == {"cadalign"}


@pytest.mark.long
def test_wheel_holds_every_module_and_nothing_twice(wheel: zipfile.ZipFile) -> None:
    names = [name for name in wheel.namelist() if name.endswith(".py")]
    assert len(names) == len(set(names))
    assert set(names) == set(source_files())
    packages = {"", "cli/", "datasets/", "datasets/sample/", "evaluation/", "render/", "solvers/"}
    assert {f"cadalign/{package}__init__.py" for package in packages} <= set(names)


@pytest.mark.long
def test_wheel_holds_the_scripts_and_styles_of_the_pages(wheel: zipfile.ZipFile) -> None:
    bundled = {path.name for path in (ROOT / "cadalign" / "web" / "dist").iterdir()}
    assert {"annotate.html", "report.js"} <= bundled
    assert {f"cadalign/web/dist/{name}" for name in bundled} <= set(wheel.namelist())


@pytest.mark.long
def test_wheel_is_typed_and_brings_the_command(wheel: zipfile.ZipFile) -> None:
    names = wheel.namelist()
    assert "cadalign/py.typed" in names
    (entry_points,) = [name for name in names if name.endswith("entry_points.txt")]
    assert "cadalign = cadalign.cli:main" in wheel.read(entry_points).decode()


# --- imports ---------------------------------------------------------------------------------


def test_import_brings_nothing_heavy() -> None:
    code = "import json, sys, cadalign; print(json.dumps(sorted(sys.modules)))"
    loaded = json.loads(python(code))
    assert HEAVY & {name.split(".")[0] for name in loaded} == set()
    assert not any(name.startswith("cadalign.shapes") for name in loaded)


def test_command_line_brings_nothing_heavy_before_it_runs() -> None:
    code = "import json, sys, cadalign.cli; print(json.dumps(sorted(sys.modules)))"
    loaded = {name.split(".")[0] for name in json.loads(python(code))}
    assert (HEAVY - {"rich", "tyro"}) & loaded == set()


def test_align_brings_none_of_scipys_large_packages() -> None:
    code = (
        "import json, sys, cadalign; cadalign.align, cadalign.Model, cadalign.ShapeModel, "
        "cadalign.View; print(json.dumps(sorted(sys.modules)))"
    )
    loaded = {".".join(name.split(".")[:2]) for name in json.loads(python(code))}
    large = ("interpolate", "linalg", "optimize", "sparse", "spatial", "special", "stats")
    assert loaded & {f"scipy.{name}" for name in large} == set()


@pytest.mark.timing
def test_import_is_quick() -> None:
    # NumPy is two thirds of it; SciPy would make it 5 times NumPy.
    ours, theirs = timed_process("import cadalign"), timed_process("import numpy")
    assert ratio(ours, theirs, below=2.0) < 2.0


FIRST_FIT = (
    "import numpy as np, cadalign; r = np.random.default_rng(0); p = r.uniform(-1, 1, (10, 3)); "
    "c = cadalign.Camera(640, 480, 500, 500, 319.5, 239.5); "
    "a = cadalign.Alignment(np.eye(3), [0, 0, 6], [1, 1.2, 0.8]); "
    "cadalign.fit(p, c.project(a.apply(p)), c)"
)


@pytest.mark.long
@pytest.mark.timing
def test_first_fit_of_a_new_process_is_quick_once_kernels_are_compiled(tmp_path: Path) -> None:
    # What no code with a compiled function can avoid: to import Numba and to read one from disk.
    (tmp_path / "plain.py").write_text(
        "import numba\n\n@numba.njit(cache=True)\ndef twice(x):\n    return 2 * x\n"
    )
    plain = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import plain; plain.twice(1.0)"
    for code in (FIRST_FIT, plain):  # compiles what is not yet on disk
        python(code)
    # The fit reads more kernels and takes 1.25 times as long. Compiling a single small one would
    # add 0.6 to that, importing trimesh the same, pandas 0.35.
    assert ratio(timed_process(FIRST_FIT), timed_process(plain), below=1.5) < 1.5


@pytest.mark.long
def test_names_resolve_after_a_bare_import() -> None:
    rooms = {"datasets": "KeypointNet", "solvers": "aepnp", "render": "RaycastRenderer"}
    for room, name in rooms.items():
        assert python(f"import cadalign; print(cadalign.{room}.{name}.__name__)").strip() == name
    assert "function fit" in python("from cadalign import *; print(fit, Camera)")


def test_unknown_name_is_an_attribute_error() -> None:
    import cadalign

    with pytest.raises(AttributeError, match="has no attribute 'nonsense'"):
        cadalign.nonsense  # noqa: B018


# --- the source ------------------------------------------------------------------------------


def test_nothing_points_out_of_the_repository() -> None:
    patterns = ("cadalign/**/*.py", "datasets/**/*.py", "render/**/*.py", "scripts/**/*.py")
    patterns += ("tests/**/*.py", "*.md", "*.toml", "Makefile")
    offenders = [
        path.relative_to(ROOT).as_posix()
        for pattern in patterns
        for path in ROOT.glob(pattern)
        if SHARED in path.read_text(encoding="utf-8")
    ]
    assert offenders == []


def test_links_lead_to_the_packages_at_the_top() -> None:
    for name in ("datasets", "render"):
        link = ROOT / "cadalign" / name
        assert link.is_symlink()
        assert link.readlink() == Path("..") / name
