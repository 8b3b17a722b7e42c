"""`cadalign fit`: align the model of one observation file."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import tyro

from cadalign.cli.options import ObservationCommand, OptionError, named_as_flags
from cadalign.cli.output import make_folder, new_console
from cadalign.errors import InputError
from cadalign.fitting.focal.prior import FocalPrior
from cadalign.fitting.options import SIMILAR_SCALE_SIGMA, FitOptions, RansacOptions, Sigma

if TYPE_CHECKING:
    from rich.console import Console
    from rich.status import Status

    from cadalign.fitting.joint.result import AlignResult
    from cadalign.fitting.result import FitResult
    from cadalign.io.observation import Observation
    from cadalign.render.drawing.color import ByteImage


@dataclass(frozen=True)
class _FitOptions(FitOptions):
    """Method and model; the observation file supplies the other options."""

    sigma: tyro.conf.Suppress[Sigma | None] = FitOptions.sigma
    focal: tyro.conf.Suppress[str] = FitOptions.focal
    focal_prior: tyro.conf.Suppress[FocalPrior | None] = FitOptions.focal_prior

    def __post_init__(self) -> None:
        with named_as_flags(self, kind=OptionError):
            super().__post_init__()


@dataclass(frozen=True)
class _RansacOptions(RansacOptions):
    """Search for outliers (LO-RANSAC), with --robust."""

    def __post_init__(self) -> None:
        with named_as_flags(self, kind=OptionError):
            super().__post_init__()


@dataclass(frozen=True)
class Fit(ObservationCommand):
    """Align a model to what an observation file holds, and draw the result.

    Keypoints in one image, or in several views; masks, depth, gravity, the camera's height and
    known lengths. Prints the alignment and, where there is more than keypoints of one image, the
    deviations without each piece of evidence. Writes fit.json and overlay.png, overlay_1.png and so
    on for further views.
    """

    observation: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OBSERVATION")]
    """JSON file with camera and keypoints, optionally image, model and further evidence."""
    similar: bool = False
    """Estimate sigma from the residuals: for a model that is only similar to the object. Its
    proportions are similar, too: --scale-prior-sigma is 0.2, unless the file or a flag says
    otherwise."""
    scale_prior: bool = True
    """Take a prior on the stretch: the flag's, the file's, or with --similar the default one; with
    --no-scale-prior none."""
    robust: bool = False
    """Search for outliers among the keypoints (RANSAC) and fit to the inliers."""
    shape: Path | None = None
    """File of `cadalign shape learn`: estimate the object's own shape, of that category, in place
    of a stretch. Keypoints need the shape's semantic ids or names, and no xyz; of options stored in
    the file, sigma and loss count."""
    shape_sigma: float | None = None
    """Estimate the object's own shape from the model's: standard deviation of the keypoints'
    positions on the object about those on the stretched model [model units]."""
    focal: Literal["known", "estimate"] | None = None
    """Focal length: known (the file's) or estimate; by default known, if the file has one."""
    exif: bool = True
    """Use the photo's EXIF data as a prior on an estimated focal length."""
    stored: bool = True
    """Take the options that the file stores, except for those that flags set to another value than
    their defaults; with --no-stored flags alone count."""
    fitting: tyro.conf.OmitArgPrefixes[_FitOptions] = _FitOptions()
    ransac: tyro.conf.OmitArgPrefixes[_RansacOptions] = _RansacOptions()

    def run(self) -> int:
        """Run the fit; returns the exit code."""
        from cadalign.io.files import write_text
        from cadalign.io.images import write_image

        console = new_console()
        status = console.status("fitting (the first time after an installation takes a minute)")
        result: FitResult | AlignResult
        observation = self._load()
        command = self._with_stored_sigma(observation)
        is_joint = command.shape_of(observation) is not None or command.shape_sigma is not None
        if observation.is_plain and not is_joint:
            result, picture = self._fit(observation, console, status)
            data, table, pictures = result.to_dict(), "", [picture]
        else:
            from cadalign.cli.contributions import list_contributions, tabulate_contributions
            from cadalign.cli.fit_joint import fit_joint

            result, pictures = fit_joint(command, observation, status)
            data = result.to_dict() | list_contributions(result)
            table = tabulate_contributions(result)
        out = self.out or self.observation.with_name(f"{self.observation.stem}_fit")
        make_folder(out)
        text = json.dumps(data, indent=2) + "\n"
        write_text(out / "fit.json", text)
        paths = [
            out / (f"overlay_{number}.png" if number else "overlay.png")
            for number in range(len(pictures))
        ]
        for path, picture in zip(paths, pictures, strict=True):
            write_image(path, picture)
        if self.json:
            sys.stdout.write(text)
        else:
            new_console(stderr=False).print(f"{result}{table}", markup=False)
            listed = ", ".join(str(path) for path in paths)
            label = "Picture" if len(paths) == 1 else "Pictures"
            console.print(f"{label}: {listed}", markup=False)
        return 0

    def shape_of(self, observation: Observation) -> Path | None:
        """File of the learned shape to fit: the flag's, or else the file's."""
        if self.shape is not None or self.shape_sigma is not None or not self.stored:
            return self.shape
        return observation.shape

    def _with_stored_sigma(self, observation: Observation) -> Fit:
        """The command with the file's ``shape_sigma``, unless flags say otherwise."""
        if not self.stored or self.shape is not None or self.shape_sigma is not None:
            return self
        return replace(self, shape_sigma=observation.fit_options.get("shape_sigma"))

    def sigma_for_all(self, observation: Observation) -> Sigma | None:
        """The given or stored deviation in place of the keypoints' own, if there is one."""
        if self.sigma is not None or not self.stored:
            return self.sigma
        return cast("Sigma | None", observation.fit_options.get("sigma"))

    def _load(self) -> Observation:
        from cadalign.io.observation import Observation

        observation = Observation.load(self.observation, needs_xyz=False)
        if self.shape_of(observation) is not None:
            return observation
        return Observation.load(self.observation)

    def _fit(
        self, observation: Observation, console: Console, status: Status
    ) -> tuple[FitResult, ByteImage]:
        """Fit the stretched model; returns the result and its picture."""
        from cadalign.fitting.fit import fit
        from cadalign.render.drawing.fit_overlay import draw_observation

        options = self.options_for(observation)
        prior = options.focal_prior
        if prior is not None:
            share = 100 * prior.relative_sigma
            text = f"Focal length from the photo's EXIF data: {prior.focal:.4g} px +-{share:.2g} %"
            console.print(text, markup=False)
        with status, named_as_flags(self, options):
            result = fit(
                observation.points_3d,
                observation.points_2d,
                observation.camera,
                **vars(options),
                ransac=self.ransac if self.robust else None,
                confidences=observation.confidences if self.robust else None,
            )
        return result, draw_observation(observation, result)

    def options_for(self, observation: Observation) -> FitOptions:
        """Options of the fit: those of the flags, otherwise those of the file."""
        from cadalign.io.documents import in_file, within

        given = dict(observation.fit_options) if self.stored else {}
        given.pop("shape_sigma", None)  # which is not an option of the plain fit
        with in_file(self.observation), within("fit"):
            stored = FitOptions(**given)
        set_by_flags = {
            field.name: getattr(self.fitting, field.name)
            for field in fields(self.fitting)
            if getattr(self.fitting, field.name) != field.default
        }
        known = "known" if observation.camera.focal_known else "estimate"
        focal = self.focal or given.get("focal", known)
        prior = None
        if focal == "estimate" and self.exif and observation.image is not None:
            prior = FocalPrior.from_exif(observation.image)
        options = {**set_by_flags, "sigma": self._sigma(observation, given), "focal": focal}
        with named_as_flags(self.fitting):
            chosen = replace(stored, **options, focal_prior=prior)
            return self._with_scale_prior(chosen, is_stored="scale_prior_sigma" in given)

    def _with_scale_prior(self, options: FitOptions, *, is_stored: bool) -> FitOptions:
        """The options with the default prior on a similar model's stretch, or without any."""
        if not self.scale_prior:
            if self.fitting.scale_prior_sigma is not None:
                raise InputError(
                    "--no-scale-prior leaves out the prior, which --scale-prior-sigma gives",
                    where="--no-scale-prior",
                    fix="give one of the two options",
                )
            return replace(options, scale_prior_sigma=None)
        chosen = is_stored or options.scale_prior_sigma is not None
        if chosen or not self.similar or options.method != "optimal" or not options.stretched_axes:
            return options
        return replace(options, scale_prior_sigma=SIMILAR_SCALE_SIGMA)

    def _sigma(self, observation: Observation, stored: Mapping[str, Any]) -> Sigma | None:
        """Choose the standard deviation: None to estimate it, the given one, the file's, or 1."""
        if self.similar:
            if self.sigma is not None:
                raise InputError(
                    "--similar estimates the standard deviation, which --sigma gives",
                    where="--sigma",
                    fix="give one of the two options",
                )
            return None
        if self.sigma is None and "sigma" in stored:
            return cast("Sigma | None", stored["sigma"])
        return self.sigma_of(observation)
