"""`cadalign evaluate`, `simulate` and `demo`: runs of experiments; `cadalign report`."""

from __future__ import annotations

import sys
from contextlib import redirect_stdout
from dataclasses import dataclass, fields, make_dataclass
from inspect import getdoc
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
import tyro

from cadalign.cli.common import NOTHING_WORKED, SUCCESS, JsonOption, group_of, say
from cadalign.cli.options import name_flags
from cadalign.cli.runs import conclude, run_progress, write_run_report
from cadalign.evaluation.experiments.demo import DemoOptions
from cadalign.evaluation.experiments.simulation import SweepOptions
from cadalign.evaluation.options import ExperimentOptions, RunOptions
from cadalign.evaluation.registry import Spec, known_options, spec_named
from cadalign.evaluation.runs.folder import RunFolder

if TYPE_CHECKING:
    from cadalign.evaluation.runs.tables import Run


_COMMAND = "evaluate"
_EXIT_CODES = (
    "Exit codes: 0 all rows succeeded, 3 some rows failed, 1 all rows failed or the run was "
    "refused or interrupted, 2 wrong command line."
)


@dataclass(frozen=True, kw_only=True)
class RunCommand(JsonOption, RunOptions):
    """Command of an experiment; see `command_of`."""

    options_type: ClassVar[type[ExperimentOptions]]

    def __post_init__(self) -> None:
        """Skip the checks: `do_run` makes them, and reports an error in one line."""

    def run(self) -> int:
        """Do the run and print its results; returns the exit code."""
        spec, run = self.do_run()
        code = conclude(spec, run, json=self.json)
        write_run_report(run.folder)
        return code

    def do_run(self) -> tuple[Spec, Run]:
        """Do the run and show its progress; returns its specification and its tables."""
        from cadalign.evaluation.api import prepare
        from cadalign.evaluation.runs.engine import execute

        kind = self.options_type
        # Modules of users may print, which must not mix with the command's output.
        with redirect_stdout(sys.stderr), name_flags(self, sweep="SWEEP"):
            options = kind(**{field.name: getattr(self, field.name) for field in fields(kind)})
            folder = RunFolder(self.out or Path("runs") / options.run_name)
            plan, pool = prepare(options, folder, workers=self.workers, dask=self.dask)
        label = f"{kind.command.removesuffix('e')}ing"
        with redirect_stdout(sys.stderr), run_progress(label) as on_progress:
            execute(plan, folder, workers=pool, on_progress=on_progress)
        spec = spec_named(kind.experiment)
        return spec, spec.open(folder.path)


def command_of(
    options: type[ExperimentOptions],
    base: type[RunCommand] = RunCommand,
    *,
    about: str | None = None,
) -> Any:
    """Make the command of an experiment from its options and a ``base`` command.

    ``about`` is its help, by default the docstring of the options.
    """
    namespace = {"options_type": options, "__doc__": about or options.__doc__}
    return make_dataclass(
        options.__name__, [], bases=(base, options), namespace=namespace, frozen=True
    )


def _evaluations() -> dict[str, Any]:
    """Make the subcommands of `cadalign evaluate`, one per experiment."""
    return {
        options.experiment: command_of(options, about=f"{getdoc(options)}\n\n{_EXIT_CODES}")
        for options in known_options()
        if options.command == _COMMAND
    }


Evaluate = group_of("Evaluate methods on a dataset.", _evaluations)
Simulate: Any = command_of(SweepOptions)


@dataclass(frozen=True, kw_only=True)
class _DemoCommand(RunCommand):
    """The command `cadalign demo`; it writes index.html even if models failed."""

    out: Path = Path("demo")
    """Folder for the results and index.html."""
    files: Path | None = None
    """Only write the files of the README's example to this folder."""

    def run(self) -> int:
        """Run the demonstration; returns the exit code."""
        if self.files is not None:
            write_example(self.files)
            return SUCCESS
        # Renderers and solvers take a moment to import; `cadalign --help` should not wait for them.
        from cadalign.report import write_report

        spec, run = self.do_run()
        code = conclude(spec, run, json=self.json)
        write_report([self.out], self.out / "index.html")
        say(f"Pictures: {self.out / 'index.html'}")
        return NOTHING_WORKED if code == NOTHING_WORKED else SUCCESS


Demo: Any = command_of(DemoOptions, _DemoCommand)


@dataclass(frozen=True)
class ReportCommand:
    """Write a page with the results of one or more runs.

    The page holds the main table, plots, and a gallery of instances in 3D. It works without a
    network. Several runs of one kind are compared side by side. An unfinished run is shown as far
    as it got.
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Folders of runs that `cadalign demo`, `evaluate`, `simulate`, `fit` or `retrieve` wrote."""
    out: Path | None = None
    """Page to write; by default report.html, in the run's folder if there is a single run."""

    def run(self) -> int:
        """Write the report; returns the exit code."""
        from cadalign.report import write_report

        page = self.runs[0] / "report.html" if len(self.runs) == 1 else Path("report.html")
        say(f"Report: {write_report(self.runs, self.out or page)}")
        return 0


# Files of the README's example, of `cadalign demo --files` ---------------------------------------

NAMES = ("front left", "front right", "back right", "back left", "top right", "top left", "rest")
KEYPOINTS = (
    *((-0.2, 0.0, 0.2), (0.2, 0.0, 0.2), (0.2, 0.1, -0.2), (-0.2, 0.1, -0.2)),
    *((0.18, 0.5, -0.25), (-0.18, 0.55, -0.25), (0.0, 0.3, 0.1)),
)
FOUND = (
    *((233.8, 340.5), (346.7, 387.1), (407.7, 298.2), (294.3, 262.7)),
    *((416.0, 123.9), (308.3, 76.3), (302.1, 227.2)),
)
"""The keypoints in the photo [px], with 1 px of noise."""
_FEET = ((-0.2, -0.2, 0.2), (0.2, -0.2, 0.2), (0.2, -0.2, -0.2), (-0.2, -0.2, -0.2))
_FACES = (
    *((0, 1, 2), (0, 2, 3), (3, 2, 4), (3, 4, 5)),  # seat and back
    *((0, 7, 1), (1, 8, 2), (2, 9, 3), (3, 10, 0), (3, 0, 6)),  # legs and a rest
)
_TURN, _PLACE, _STRETCH = (-2.578, -0.193, 0.824), (0.0, 0.291, 2.735), (1.0, 1.3, 0.8)


def write_example(folder: Path) -> None:
    """Write the files of the README's example to a folder.

    The files are chair.obj, chair.keypoints.json, photo.jpg (another chair at a focal length of
    935 px) and found.json (a detector's keypoints in that photo).
    """
    from cadalign.datasets.model_keypoints import ModelKeypoint, ModelKeypoints
    from cadalign.geometry.alignment import Alignment
    from cadalign.geometry.camera import Camera
    from cadalign.geometry.mesh import Mesh
    from cadalign.geometry.rotations import rotation_from_vector
    from cadalign.io.files import create_folder, write_json
    from cadalign.io.images import write_image
    from cadalign.io.meshes.files import write_mesh
    from cadalign.render import RaycastRenderer, Scene

    create_folder(folder)
    mesh = Mesh(np.array(KEYPOINTS + _FEET), np.array(_FACES))
    write_mesh(folder / "chair.obj", mesh, kind="obj")
    named = tuple(map(ModelKeypoint, NAMES, KEYPOINTS))
    ModelKeypoints(named, folder / "chair.obj").save(folder / "chair.keypoints.json")
    camera = Camera(640, 480, 935.0, 935.0, 319.5, 239.5)
    turn, place, stretch = map(np.array, (_TURN, _PLACE, _STRETCH))
    pose = Alignment(rotation_from_vector(turn), place, stretch)
    frame = RaycastRenderer().render(Scene(mesh), camera, pose)
    write_image(folder / "photo.jpg", frame.composite())
    flat = [number for u, v in FOUND for number in (u, v, 2)]
    found = {
        "images": [{"id": 1, "file_name": "photo.jpg", "width": 640, "height": 480}],
        "annotations": [{"id": 1, "image_id": 1, "category_id": 1, "keypoints": flat}],
        "categories": [{"id": 1, "name": "chair", "keypoints": list(NAMES)}],
    }
    write_json(folder / "found.json", found)
    say(f"Written to {folder}: chair.obj, chair.keypoints.json, photo.jpg, found.json")
