"""Options of `cadalign fit` about the estimate, and those of the observation file that hold."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, cast

import tyro

from cadalign.cli.options import ObservationCommand, OptionError, flag_of, named_as_flags, say
from cadalign.errors import InputError
from cadalign.estimation.focal import FocalPrior
from cadalign.estimation.options import SIMILAR_SCALE_SIGMA, FitOptions, RansacOptions, Sigma
from cadalign.io.documents import in_file, within

if TYPE_CHECKING:
    from cadalign.io.observation import Observation

_OF_THE_MODEL = ("stretch", "known_axis", "scale_prior_sigma")  # options that a learned shape lacks


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


@dataclass(frozen=True, kw_only=True)
class EstimateOptions(ObservationCommand):
    """Model, noise, focal length and robust search of a fit."""

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
    the file, sigma, loss and focal length count."""
    shape_sigma: float | None = None
    """Estimate the object's own shape from the model's: standard deviation of the keypoints'
    positions on the object about those on the stretched model [model units]."""
    focal: Literal["known", "estimate"] | None = None
    """Focal length: known (the file's) or estimate; by default known, if every view has one. Views
    of equal cameras share an estimated one."""
    exif: bool = True
    """Use the photo's EXIF data as a prior on an estimated focal length."""
    stored: bool = True
    """Take the options that the file stores, except for those that flags set to another value than
    their defaults; with --no-stored flags alone count."""
    # A group's own text: without it, tyro reads the documentation of all options for every fit.
    fitting: Annotated[
        _FitOptions, tyro.conf.OmitArgPrefixes, tyro.conf.arg(help=_FitOptions.__doc__)
    ] = _FitOptions()
    ransac: Annotated[
        _RansacOptions, tyro.conf.OmitArgPrefixes, tyro.conf.arg(help=_RansacOptions.__doc__)
    ] = _RansacOptions()

    @property
    def takes_stored_shape(self) -> bool:
        """True unless a flag says another shape than the file's."""
        return self.stored and self.shape is None and self.shape_sigma is None

    def shape_of(self, observation: Observation) -> Path | None:
        """File of the learned shape to fit: the flag's, or else the file's."""
        return observation.shape if self.takes_stored_shape else self.shape

    def shape_sigma_of(self, observation: Observation) -> float | None:
        """Deviation of a similar model's shape: the flag's, or else the file's."""
        if not self.takes_stored_shape:
            return self.shape_sigma
        return cast("float | None", observation.fit_options.get("shape_sigma"))

    def stated_sigma(self, observation: Observation) -> dict[str, Sigma | None]:
        """The deviation that takes the place of the keypoints' own, empty if there is none.

        None is to be estimated.
        """
        if self.similar:
            if self.sigma is not None:
                raise InputError(
                    "--similar estimates the standard deviation, which --sigma gives",
                    where="--sigma",
                    fix="give one of the two options",
                )
            return {"sigma": None}
        if self.sigma is not None:
            return {"sigma": self.sigma}
        if self.stored and "sigma" in observation.fit_options:
            return {"sigma": cast("Sigma | None", observation.fit_options["sigma"])}
        return {}

    def options_for(self, observation: Observation, path: Path) -> FitOptions:
        """Options of the fit: those of the flags, otherwise those of the file."""
        given = dict(observation.fit_options) if self.stored else {}
        given.pop("shape_sigma", None)  # which is the model's
        has_prior, stored_prior = "focal_prior" in given, given.pop("focal_prior", None)
        with in_file(path), within("fit"):
            stored = FitOptions(**given)
        set_by_flags = {
            field.name: getattr(self.fitting, field.name)
            for field in fields(self.fitting)
            if getattr(self.fitting, field.name) != field.default
        }
        are_known = all(view.camera.focal_known for view in observation.views)
        focal = self.focal or given.get("focal", "known" if are_known else "estimate")
        if focal == "known" and not are_known:
            raise InputError(
                "the focal length is unknown",
                where=f"{path}: camera",
                fix="give --focal estimate, or a calibrated camera",
            )
        prior = None
        if focal == "estimate":
            if has_prior:
                prior = None if stored_prior is None else FocalPrior(**stored_prior)
            elif self.exif:
                prior = _prior_of_photos(observation)
            if prior is not None:
                share = 100 * prior.relative_sigma
                source = "the file's prior" if has_prior else "the photo's EXIF data"
                say(f"Focal length from {source}: {prior.focal:.4g} px +-{share:.2g} %")
        sigma = self.stated_sigma(observation).get("sigma", self.sigma_of(observation))
        changes = {**set_by_flags, "sigma": sigma, "focal": focal, "focal_prior": prior}
        with named_as_flags(self.fitting):
            chosen = replace(stored, **changes)
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

    def check_for(self, observation: Observation) -> None:
        """Refuse options that have no effect together with a shape or further evidence."""
        if self.shape is not None and self.shape_sigma is not None:
            raise InputError(
                "--shape has learned how far objects of the category differ",
                where="--shape-sigma",
                fix="give one of the two options",
            )
        learned = self.shape_of(observation)
        is_shaped = learned is not None or self.shape_sigma_of(observation) is not None
        refused = {
            "--similar": is_shaped and self.similar,
            "--no-scale-prior": is_shaped and not self.scale_prior,
        }
        for name in ("method", *(_OF_THE_MODEL if learned is not None else ())):
            is_changed = getattr(self.fitting, name) != getattr(FitOptions, name)
            refused[flag_of(name)] = is_changed
        for flag, is_given in refused.items():
            if is_given:
                raise InputError(
                    f"has no effect together with {self._cause(observation)}",
                    where=flag,
                    fix="leave out one of the two",
                )

    def _cause(self, observation: Observation) -> str:
        """Name of what makes the fit more than one of a stretched model to keypoints."""
        if self.shape is not None:
            return "--shape"
        if self.shape_sigma is not None:
            return "--shape-sigma"
        if self.shape_of(observation) is not None:
            return "the file's shape"
        if self.shape_sigma_of(observation) is not None:
            return "the file's shape_sigma"
        return f"the file's {_evidence(observation)}"


def _evidence(observation: Observation) -> str:
    """Name of the first field of a file that `cadalign.fit` does not take."""
    if observation.others:
        return "views"
    if observation.depths is not None:
        return "depth"
    return next(iter(observation.evidence.given), "size" if observation.size else "init")


def _prior_of_photos(observation: Observation) -> FocalPrior | None:
    """The prior of the first photo's EXIF data, unless those of another photo differ from it."""
    if observation.image is None:
        return None
    first = FocalPrior.from_exif(observation.image)
    for view in observation.others:
        other = None if first is None or view.image is None else FocalPrior.from_exif(view.image)
        if first is None or other is None:
            continue
        if not first.is_like(other):
            say(
                f"The photos' EXIF data differ ({first.focal:.4g} and {other.focal:.4g} px): unused"
            )
            return None
    return first
