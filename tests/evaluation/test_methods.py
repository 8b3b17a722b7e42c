"""User methods, as functions or import paths ``module:function``."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.refusals import refusal_line
from support.solving import BAD, linear, weighted

import cadalign
from cadalign import Alignment, Camera
from cadalign.cli import main
from cadalign.errors import InputError
from cadalign.evaluation.experiments.photos import PhotosOptions


def simulate(methods: Any, **options: Any) -> Any:
    options = {"values": [20], "runs": 3, "workers": 0, **options}
    return cadalign.evaluate(experiment="simulate", sweep="points", methods=methods, **options)


# --- functions as methods ----------------------------------------------------------------------


@pytest.mark.parametrize("given", [linear, "support.solving:linear"])
def test_a_function_stands_beside_built_in_methods(given: Any) -> None:
    table = simulate([given, "aepnp"])
    assert table.method.tolist() == ["linear", "aepnp"] * 3
    mine, built_in = (table[table.method == name] for name in ("linear", "aepnp"))
    np.testing.assert_allclose(mine.rotation_error_deg, built_in.rotation_error_deg, rtol=1e-6)


def test_a_function_with_a_parameter_sigma_gets_the_noise() -> None:
    sweep = {"sweep": "noise", "values": [1, 2], "runs": 1, "methods": [weighted]}
    table = cadalign.evaluate(experiment="simulate", **sweep, workers=0)
    assert table.status.tolist() == ["failed", "ok"]


@pytest.mark.parametrize("bad", BAD, ids=lambda bad: bad.__name__)
def test_a_bad_function_fails_without_stopping_the_run(bad: Any) -> None:
    table = simulate([bad, "aepnp"])
    failed = table[table.method == bad.__name__]
    assert set(failed.status) == {"failed"}
    assert set(failed.reason) == {BAD[bad]}
    good = table[table.method == "aepnp"].drop(columns="seconds").reset_index(drop=True)
    alone = simulate(["aepnp"]).drop(columns="seconds")
    assert good.equals(alone)


def test_functions_without_a_unique_name_are_refused() -> None:
    with pytest.raises(InputError, match="a function named <lambda> cannot head a column"):
        simulate([lambda a, b, c: None])
    with pytest.raises(InputError, match="the name 'linear' is already in use"):
        simulate([linear, partial(linear)])


def test_a_method_of_an_experiment_is_not_hidden(tmp_path: Path) -> None:
    def shape(model: Any, views: Any) -> Any: ...

    def rigid(model: Any, views: Any) -> Any: ...

    with pytest.raises(InputError, match="the name 'shape' is already in use; rename"):
        cadalign.evaluate(tmp_path, "unseen", methods=[shape])
    with pytest.raises(InputError, match="the name 'rigid' is already in use; rename"):
        PhotosOptions(tmp_path, methods=(rigid,))  # type: ignore[arg-type]


# --- every experiment --------------------------------------------------------------------------


# --- processes and clusters --------------------------------------------------------------------


def run_bytes(out: Path, **options: Any) -> bytes:
    simulate([linear, *BAD, "aepnp"], out=out, runs=130, **options)
    return (out / "results.parquet").read_bytes()


@pytest.mark.long
def test_worker_processes_import_functions(tmp_path: Path) -> None:
    alone = run_bytes(tmp_path / "alone")
    assert run_bytes(tmp_path / "processes", workers=1) == alone


@pytest.mark.long
def test_a_local_function_runs_only_without_workers() -> None:
    def local(points_3d: Any, points_2d: Any, camera: Camera) -> Alignment:
        return linear(points_3d, points_2d, camera)

    assert (simulate([local]).status == "ok").all()
    with pytest.raises(InputError, match="workers: a function cannot be sent to worker") as caught:
        simulate([local], workers=1)
    assert "define it in an importable module, give module:f" in str(caught.value)


_SCRIPT = """
import cadalign
def mine(points_3d, points_2d, camera):
    return cadalign.fit(points_3d, points_2d, camera, method="aepnp")
def simulate(methods):
    sweep = {"sweep": "points", "values": [20], "runs": 2}
    return cadalign.evaluate(experiment="simulate", **sweep, workers=1, methods=methods)
print((simulate(["aepnp"]).status == "ok").all())
try:
    simulate([mine])
except cadalign.CadalignError as error:
    print(error)
"""


@pytest.mark.long
def test_a_script_needs_no_guard_and_its_functions_are_refused(tmp_path: Path) -> None:
    (tmp_path / "script.py").write_text(_SCRIPT)
    done = subprocess.run(
        [sys.executable, str(tmp_path / "script.py")], capture_output=True, text=True, check=True
    )
    good, refused = done.stdout.splitlines()
    assert good == "True"
    assert "(it is defined in a script or a notebook); define it in an importable" in refused


def test_a_run_names_its_functions(tmp_path: Path) -> None:
    simulate([linear, "aepnp"], out=tmp_path / "run")
    simulate(["support.solving:linear", "aepnp"], out=tmp_path / "run")
    config = json.loads((tmp_path / "run" / "run.json").read_text())
    assert config["methods"] == ["support.solving:linear", "aepnp"]


# --- on the command line -----------------------------------------------------------------------


@pytest.fixture
def plugin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A module in the working directory."""
    (tmp_path / "my_plugin.py").write_text(
        "import cadalign\n"
        "def solve(points_3d, points_2d, camera):\n"
        "    return cadalign.fit(points_3d, points_2d, camera, method='aepnp')\n"
        "number = 3\n"
    )
    (tmp_path / "broken.py").write_text("import no_such_module\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def command(*options: str) -> list[str]:
    return ["simulate", "points", "--values", "8", "--runs", "2", "--workers", "0", *options]


@pytest.mark.slow
@pytest.mark.parametrize("workers", ["0", "1"])
@pytest.mark.usefixtures("no_figures")
def test_a_function_of_a_module_is_a_method(
    plugin: Path, capsys: pytest.CaptureFixture[str], workers: str
) -> None:
    methods = ["--methods", "epnp", "my_plugin:solve"]
    assert main([*command(*methods, "--json"), "--workers", workers]) == 0
    found = json.loads(capsys.readouterr().out)["summary"]
    assert {each["method"] for each in found} == {"epnp", "solve"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("my_plugin:nothing", "the module 'my_plugin' has no function 'nothing'; "),
        ("my_plugin:number", "the module 'my_plugin' has no function 'number'; "),
        ("none_such:solve", "'none_such' cannot be imported (ModuleNotFoundError: No module "),
        ("broken:solve", "'broken' cannot be imported (ModuleNotFoundError: No module named "),
    ],
)
def test_functions_that_cannot_be_used_are_refused(
    plugin: Path, capsys: pytest.CaptureFixture[str], text: str, message: str
) -> None:
    line = refusal_line(capsys, *command("--methods", text))
    assert line.startswith(f"--methods: {message}")


# --- the examples ------------------------------------------------------------------------------


@pytest.mark.long
def test_the_how_to_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = Path(__file__).parents[2] / "docs" / "how_to" / "own_method.md"
    block, _ = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.S)
    monkeypatch.chdir(tmp_path)
    exec(block, {})
    assert "refined_twice" in capsys.readouterr().out
