"""`cadalign fit`: align the models of observation files."""

from __future__ import annotations

import sys
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import tyro

from cadalign.batch.observation_fit import ObservationFit
from cadalign.cli.common import (
    answer,
    beside,
    make_folder,
    say,
    waiting,
)
from cadalign.cli.fitted import FittedFile
from cadalign.cli.options import (
    CameraOptions,
    EvidenceOptions,
    FlaggedOptions,
    ManyCommand,
    flag_of,
    named_as_flags,
)
from cadalign.errors import InputError, refuse_unused
from cadalign.estimation.focal import PriorOption
from cadalign.estimation.options import FitOptions, RansacOptions, Sigma
from cadalign.geometry.camera import Camera
from cadalign.io.documents import read_json
from cadalign.io.files import keeping
from cadalign.io.kinds import OBSERVATION, is_of_many
from cadalign.io.observation import Observation, ObservationChanges

if TYPE_CHECKING:
    pass


@dataclass(frozen=True)
class _FitOptions(FlaggedOptions, FitOptions):
    """Method and model; the observation file supplies the other options."""

    sigma: tyro.conf.Suppress[Sigma | None] = FitOptions.sigma
    focal: tyro.conf.Suppress[str] = FitOptions.focal
    focal_prior: tyro.conf.Suppress[PriorOption] = FitOptions.focal_prior


@dataclass(frozen=True)
class _RansacOptions(FlaggedOptions, RansacOptions):
    """Search for outliers (LO-RANSAC), with --robust."""


@dataclass(frozen=True, kw_only=True)
class Fit(ManyCommand, ObservationFit, CameraOptions, EvidenceOptions):
    """Align a model to what an observation file holds, and draw the result.

    Keypoints in one image, or in several views; masks, depth, gravity, the camera's height and
    known lengths. Prints the alignment and how well each piece of evidence agrees with it. --mask,
    --model and --camera without any observation align the model to a mask alone, and write one,
    fit.observation.json. Writes
    fit.json and overlay.png, overlay_1.png and so on for further views. Many observations, as of
    several objects of one photo, are a run, which goes on where it was killed: it writes
    results.parquet and results.csv with a row for each, and report.html. Exit codes of a run: 0 all
    are aligned, 3 some failed, 1 all failed or refused, 2 a wrong command line.
    """

    out: Path | None = None
    """Folder to write to; by default <observation>_fit beside the file or folder."""
    overlay: Path | None = None
    """Draw the aligned model over the photo, too, and write it to this picture; further views to
    FILE_1 and so on. The observation names the model."""
    # A group's own text: without it, tyro reads the documentation of all options for every fit.
    fitting: Annotated[
        _FitOptions, tyro.conf.OmitArgPrefixes, tyro.conf.arg(help=_FitOptions.__doc__)
    ] = _FitOptions()
    ransac: Annotated[
        _RansacOptions, tyro.conf.OmitArgPrefixes, tyro.conf.arg(help=_RansacOptions.__doc__)
    ] = _RansacOptions()

    focal: Literal["known", "estimate"] | float | None = None  # type: ignore[assignment]
    """Focal length [px], in the place of the file's, or: known (the file's) or estimate; by default
    known, if every view has one. Views of equal cameras share an estimated one."""
    named = staticmethod(flag_of)

    @property
    def estimate(self) -> ObservationFit:
        """The options of the estimate alone, without those of the command."""
        given = {field.name: getattr(self, field.name) for field in fields(ObservationFit)}
        if not isinstance(self.focal, str):  # a number is the camera's, see `CameraOptions`
            given["focal"] = None
        given["fitting"] = FitOptions(**vars(self.fitting))
        given["ransac"] = RansacOptions(**vars(self.ransac))
        return ObservationFit(**given)

    def run(self) -> int:
        """Run the fit, or the fits; returns the exit code."""
        if not self.robust:
            with named_as_flags(self.ransac):
                names = [each.name for each in fields(RansacOptions)]
                refuse_unused(self.ransac, names, "without --robust")
        if not self.observations and "mask" in self.given and self.model is not None:
            return self._fit_mask(self.given["mask"])
        path = self.first()
        is_read = len(self.observations) == 1 and path.suffix.lower() == ".json" and path.is_file()
        data = read_json(path) if is_read else None
        if len(self.observations) > 1 or is_of_many(path, data):
            return self._fit_many()
        with named_as_flags(self, self.fitting, self.ransac):
            data = read_json(path, OBSERVATION) if data is None else data
            observation = self.read(data, str(path), folder=path.parent, changes=self.changes)
            self.refuse_of_many()
        return self._write(self._fitted(observation, path, {"observation": path}), path)

    def _write(self, fitted: FittedFile, path: Path) -> int:
        """Write and print what was fitted of a file; returns the exit code."""
        out = self.out or beside(path, "_fit")
        paths = fitted.write(out, overlay=self.overlay)
        if self.json:
            sys.stdout.write(fitted.text(out))
            return 0
        answer(str(fitted.result))
        if paths:
            listed = ", ".join(str(path) for path in paths)
            say(f"{'Picture' if len(paths) == 1 else 'Pictures'}: {listed}")
        return 0

    def _fit_mask(self, mask: Path) -> int:
        """Align the model to a mask alone; returns the exit code."""
        from cadalign.io.images import photo_size

        width, height = photo_size(mask)
        nothing, camera = np.empty((0, 3)), Camera.without_focal(width, height)
        seen = Observation(nothing, nothing[:, :2], camera, model=self.model)
        with named_as_flags(self, self.fitting, self.ransac):
            self.refuse_of_many("model")
            observation = self.changes.applied_to(seen)
        path = (self.out or beside(mask, "_fit")) / "fit.observation.json"
        fitted = self._fitted(observation, mask, {"mask": mask, "observation": path})
        # What was fitted, for the commands that go on from the fit.
        with keeping(observation.files):
            make_folder(path.parent)
            observation.save(path)
        return self._write(fitted, mask)

    def _fit_many(self) -> int:
        """Align all observations; returns the exit code."""
        from cadalign.batch.experiment import FitRunOptions
        from cadalign.cli.runs import inputs_of, run_command

        with named_as_flags(self, self.fitting, self.ransac):
            refuse_unused(self, ["overlay"], "on many observations")
            options = FitRunOptions(estimate=self.estimate, **inputs_of(self, self.changes))
            return run_command(self, options, done="aligned")

    @property
    def changes(self) -> ObservationChanges:
        """Values of the options in the place of an observation's own."""
        return replace(self.of_camera, evidence=self.given, size=self.known_size)

    def _fitted(self, observation: Observation, path: Path, sources: dict[str, Path]) -> FittedFile:
        """Fit an observation, which messages call ``path``, and draw it; see `FittedFile`."""
        shape = self.shape_of(observation)
        if shape is not None:
            sources = {**sources, "shape": shape}
        if self.overlay is not None and shape is None and observation.model is None:
            fix = "give the file's `model` a mesh, or leave out the option"
            raise InputError(f"{path} names no model to draw", where="--overlay", fix=fix)
        with named_as_flags(self, self.fitting, self.ransac):
            status = waiting("fitting")
            result, views = self.fit(observation, str(path), note=say, status=status)
        found = FittedFile(result, sources, inputs=(*observation.files, *sources.values()))
        has_overlay = self.overlay is not None
        return found.drawn(observation, views=views, picture=self.picture, overlay=has_overlay)
