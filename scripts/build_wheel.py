"""Build a wheel that brings its compiled solvers along, so that nothing is compiled on first use.

    python scripts/build_wheel.py --out dist

Takes minutes. The wheel fits one version of Python and of Numba on one operating system, and any
processor of level x86-64-v3 (on arm64: the processors that LLVM calls generic); elsewhere the
solvers in it are left alone and compiled on first use, as with a plain wheel.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
X86_NEEDS = ["avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe"]


def main() -> None:
    """Read the command line and build."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("dist"))
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        source, kernels = Path(folder) / "source", Path(folder) / "kernels"
        copy_source(source)
        compile_kernels(source, kernels)
        pack(kernels, source / "cadalign" / "compile" / "kernels")
        wheel = build(source, Path(folder) / "dist")
        shutil.copy(wheel, out)
    size = (out / wheel.name).stat().st_size / 1e6
    count = sum(name.endswith(".nbi") for name in zipfile.ZipFile(out / wheel.name).namelist())
    sys.stdout.write(f"{out / wheel.name}: {size:.0f} MB, {count} compiled functions\n")


def copy_source(folder: Path) -> None:
    """Copy what a wheel is built from, so that nothing old in `build/` gets into it."""
    folder.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, folder)
    ignored = shutil.ignore_patterns("__pycache__", "node_modules")
    for name in ("cadalign", "datasets", "render"):
        shutil.copytree(ROOT / name, folder / name, symlinks=True, ignore=ignored)


def processor() -> tuple[str, list[str]]:
    """Name of the processors to compile for, and the features that they must have."""
    if platform.machine().lower() in ("x86_64", "amd64"):
        return "x86-64-v3", X86_NEEDS
    return "generic", []


def compile_kernels(source: Path, kernels: Path) -> None:
    """Compile all solvers of a checkout into a folder, for the usual processors."""
    name, _ = processor()
    chosen = {"NUMBA_CACHE_DIR": str(kernels), "NUMBA_CPU_NAME": name, "NUMBA_CPU_FEATURES": ""}
    environment = {**os.environ, **chosen, "PYTHONPATH": str(source)}
    code = "from cadalign.cli import main; raise SystemExit(main(['doctor', '--compile']))"
    subprocess.run([sys.executable, "-c", code], cwd=kernels.parent, env=environment, check=True)


def pack(kernels: Path, folder: Path) -> None:
    """Put compiled solvers into the package, with what they were compiled for."""
    from llvmlite import binding

    folder.mkdir()
    for path in kernels.glob("*.nb[ic]"):
        shutil.copy(path, folder)
    name, needs = processor()
    target = {"triple": binding.get_process_triple(), "cpu": name, "features": "", "needs": needs}
    (folder / "target.json").write_text(json.dumps(target))


def build(source: Path, folder: Path) -> Path:
    """The wheel of a checkout, named for this Python and this operating system."""
    python = f"cp{sys.version_info.major}{sys.version_info.minor}"
    system = f"{platform.system().lower()}_{platform.machine().lower()}"
    options = [f"--python-tag={python}", f"--plat-name={system}"]
    settings = [f"--config-settings=--build-option={option}" for option in options]
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", *settings]
    subprocess.run([*command, "-w", str(folder), "."], cwd=source, check=True)
    (wheel,) = folder.glob("*.whl")
    return wheel


if __name__ == "__main__":
    main()
