"""`cadalign fit`: align the models of observation files."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from cadalign.batch.observation_fit import ObservationFit
from cadalign.cli.common import answer, beside, make_folder, say, waiting
from cadalign.cli.options import EvidenceOptions, ManyCommand, named_as_flags
from cadalign.errors import InputError, refuse_unused
from cadalign.estimation.options import FitOptions
from cadalign.geometry.camera import Camera
from cadalign.io.documents import read_json
from cadalign.io.files import keeping, write_text
from cadalign.io.kinds import OBSERVATION, is_of_many
from cadalign.io.observation import Observation


@dataclass(frozen=True, kw_only=True)
class Fit(ManyCommand, EvidenceOptions):
    """Align a model to what an observation file holds, and draw the result.

    Keypoints in one image, or in several views; masks, depth, gravity, the camera's height and
    known lengths. Prints the alignment and how well each piece of evidence agrees with it. Further
    options, such as priors, stand in the file. --mask, --model and --camera without any observation
    align the model to a mask alone, and write one, fit.observation.json. Writes fit.json and
    overlay.png, overlay_1.png and so on for further views. Many observations, as of several objects
    of one photo, are a run, which goes on where it was killed: it writes results.parquet and
    results.csv with a row for each, and report.html. Exit codes of a run: 0 all are aligned, 3 some
    failed, 1 all failed or refused, 2 a wrong command line.
    """

    out: Path | None = None
    """Folder to write to; by default <observation>_fit beside the file or folder."""
    overlay: Path | None = None
    """Draw the aligned model over the photo, too, and write it to this picture; further views to
    FILE_1 and so on. The observation names the model."""
    focal: Literal["known", "estimate"] | float | None = None  # type: ignore[assignment]
    """Focal length [px], in the place of the file's, or: known (the file's) or estimate; by default
    known, if every view has one. Views of equal cameras share an estimated one."""
    sigma: Literal["none"] | float | None = None
    """Standard deviation of the keypoints [px], by default the file's, or 1; none: estimated from
    the residuals."""
    similar: bool = False
    """For a model that is only similar to the object: --sigma is none unless it is given, and
    proportions are expected within 20 % of the model's, unless the file says otherwise."""
    robust: bool = False
    """Search for outliers among the keypoints (RANSAC) and fit to the inliers."""
    loss: str = FitOptions.loss
    """Loss on the length of a residual: linear (squared), huber or cauchy; the robust ones tolerate
    outliers."""
    shape: Path | None = None
    """File of `cadalign shape learn`: estimate the object's own shape, of that category, in place
    of a stretch. Keypoints need the shape's semantic ids or names, and no xyz."""
    shape_sigma: float | None = None
    """Estimate the object's own shape from the model's: standard deviation of the keypoints'
    positions on the object about those on the stretched model [model units]."""
    use_photo: bool = False
    """Take the photo itself as evidence: the model's outline is sought in it, from the estimate by
    everything else. The model needs a mesh."""
    method: str = FitOptions.method
    """Solver: optimal (maximum likelihood, searched globally), aepnp (linear), aepnp-paper (linear,
    as published) or epnp (OpenCV's, without stretch)."""
    stretch: str | None = None
    """Axes whose scale is estimated: yz by default; y, z or none."""

    @property
    def estimate(self) -> ObservationFit:
        """The options of the estimate."""
        return ObservationFit(
            sigma=self.sigma,
            similar=self.similar,
            robust=self.robust,
            shape=self.shape,
            shape_sigma=self.shape_sigma,
            use_photo=self.use_photo,
            focal=self.focal if isinstance(self.focal, str) else None,
            fitting=FitOptions(method=self.method, loss=self.loss, stretch=self.stretch),
        )

    def run(self) -> int:
        """Run the fit, or the fits; returns the exit code."""
        if not self.observations and self.mask is not None and self.model is not None:
            return self._fit_mask(self.mask, self.model)
        path = self.first()
        is_file = path.suffix.lower() == ".json" and os.path.isfile(path)
        data = read_json(path) if is_file else None
        if len(self.observations) > 1 or is_of_many(path, data):
            return self._fit_many()
        with named_as_flags(self):
            data = read_json(path, OBSERVATION) if data is None else data
            how = self.estimate
            seen = how.read(data, str(path), folder=path.parent, changes=self.changes)
            self.refuse_of_many()
        return self._fit(how, seen, path, {"observation": path})

    def _fit_mask(self, mask: Path, model: Path) -> int:
        """Align the model to a mask alone; returns the exit code."""
        from cadalign.datasets.models.model_keypoints import ModelKeypoints
        from cadalign.io.images import photo_size

        if model.suffix.lower() == ".json":
            mesh = ModelKeypoints.load(model).model
            if mesh is None:
                raise InputError(f"{model} names no mesh", where="--model", fix="give the mesh")
            model = mesh
        nothing, camera = np.empty((0, 3)), Camera.without_focal(*photo_size(mask))
        with named_as_flags(self):
            self.refuse_of_many("model")
            how, seen = self.estimate, Observation(nothing, nothing[:, :2], camera, model=model)
            seen = self.changes.applied_to(seen)
        path = (self.out or beside(mask, "_fit")) / "fit.observation.json"
        return self._fit(how, seen, mask, {"mask": mask, "observation": path})

    def _fit(
        self, how: ObservationFit, seen: Observation, path: Path, sources: dict[str, Path]
    ) -> int:
        """Fit an observation, which messages call ``path``, draw it and write what was found."""
        from cadalign.cli.fitted import drawn, fit_text, write_pictures

        shape = how.shape_of(seen)
        if shape is not None:
            sources = {**sources, "shape": shape}
        if self.overlay is not None and shape is None and seen.model is None:
            fix = "give the file's `model` a mesh, or leave out the option"
            raise InputError(f"{path} names no model to draw", where="--overlay", fix=fix)
        with named_as_flags(self), waiting("fitting"):
            result, views = how.fit(seen, str(path), note=say)
        pictures, overlays = drawn(
            seen, result, views, picture=self.picture, overlay=self.overlay is not None
        )
        out = self.out or beside(path, "_fit")
        make_folder(out)
        text, stated = fit_text(result, sources, out), sources["observation"]
        with keeping([*seen.files, *(each for each in sources.values() if each.exists())]):
            # First what somebody names, which may be refused.
            further = [] if self.overlay is None else write_pictures(self.overlay, overlays)
            if stated != path:  # of a mask alone: for the commands that go on from the fit
                seen.save(stated)
            write_text(out / "fit.json", text)
            paths = [*write_pictures(out / "overlay.png", pictures), *further]
        if self.json:
            sys.stdout.write(text)
            return 0
        answer(str(result))
        if paths:
            listed = ", ".join(map(str, paths))
            say(f"{'Picture' if len(paths) == 1 else 'Pictures'}: {listed}")
        return 0

    def _fit_many(self) -> int:
        """Align all observations; returns the exit code."""
        from cadalign.batch.experiment import FitRunOptions
        from cadalign.cli.runs import inputs_of, run_command

        with named_as_flags(self):
            refuse_unused(self, ["overlay"], "on many observations")
            options = FitRunOptions(estimate=self.estimate, **inputs_of(self))
            return run_command(self, options, done="aligned")
