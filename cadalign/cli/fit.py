"""`cadalign fit`: align the models of observation files."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import tyro

from cadalign.cli.evidence import CameraOptions, EvidenceOptions
from cadalign.cli.options import ObservationCommand, OptionError, UsageError, named_as_flags
from cadalign.cli.output import make_folder, say, waiting
from cadalign.errors import InputError
from cadalign.estimation.focal import FocalPrior
from cadalign.estimation.options import SIMILAR_SCALE_SIGMA, FitOptions, RansacOptions, Sigma

if TYPE_CHECKING:
    from cadalign.estimation.result import Result
    from cadalign.io.observation import Observation
    from cadalign.render.drawing.color import ByteImage

_PHOTOS = (".bmp", ".gif", ".heic", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp")


@dataclass(frozen=True, eq=False)
class FittedFile:
    """Result of a fit of one file, its JSON form, a table, and pictures of each view.

    ``overlays`` are those of the model that were asked for.
    """

    result: Result
    data: dict[str, Any]
    table: str
    pictures: tuple[ByteImage, ...]
    overlays: tuple[ByteImage, ...] = ()

    @property
    def text(self) -> str:
        """The result as JSON text."""
        return json.dumps(self.data, indent=2) + "\n"

    def write(self, out: Path, *, overlay: Path | None = None) -> list[Path]:
        """Write fit.json and the pictures to a folder; returns the pictures' paths.

        The ``overlays`` go to ``overlay``, those of further views beside it.
        """
        from cadalign.io.files import write_text

        make_folder(out)
        write_text(out / "fit.json", self.text)
        paths = _write_pictures(out / "overlay.png", self.pictures)
        return paths if overlay is None else paths + _write_pictures(overlay, self.overlays)


def _write_pictures(path: Path, pictures: tuple[ByteImage, ...]) -> list[Path]:
    """Write the first picture to a path, further ones to NAME_1 and so on; returns their paths."""
    from cadalign.io.images import write_image

    paths = [
        path.with_name(f"{path.stem}_{row}{path.suffix}") if row else path
        for row in range(len(pictures))
    ]
    for each, picture in zip(paths, pictures, strict=True):
        write_image(each, picture)
    return paths


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
class Fit(ObservationCommand, CameraOptions, EvidenceOptions):
    """Align a model to what an observation file holds, and draw the result.

    Keypoints in one image, or in several views; masks, depth, gravity, the camera's height and
    known lengths. Prints the alignment and, where there is more than keypoints of one image, the
    deviations without each piece of evidence. Writes fit.json and overlay.png, overlay_1.png and so
    on for further views. Of several files, or a folder of them, a folder each, results.csv, and
    index.html with all pictures.
    """

    observations: Annotated[
        tuple[Path, ...],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="OBSERVATION ...", help_behavior_hint="(required)"),
    ]
    """JSON files with camera and keypoints, optionally image, model and further evidence; or a
    folder of such files."""
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
    picture: bool = True
    """Draw box and keypoints over each photo, as overlay.png; of several files, on one page."""
    overlay: Path | None = None
    """Draw the aligned model over the photo, too, and write it to this picture; further views to
    FILE_1 and so on. The observation names the model. Of several observations, to a picture of this
    name in the folder of each."""
    overlay_mode: Literal["shaded", "translucent", "lines", "box"] = "shaded"
    """Style of drawing: in its own colours, as a red veil, its outline and creases, or its box."""
    overlay_opacity: float = 0.6
    """Of the shaded or translucent model, 0 to 1."""
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

    def run(self) -> int:
        """Run the fit, or the fits; returns the exit code."""
        if not self.observations:
            fix = "give a JSON file with camera and keypoints, or a folder of such files"
            raise UsageError("no observation is given", where="OBSERVATION", fix=fix)
        if len(self.observations) > 1 or self.observation.is_dir():
            from cadalign.cli.fit_many import fit_many

            return fit_many(self)
        fitted = self.fit_file(waiting("fitting"))
        out = self.out or self.observation.with_name(f"{self.observation.stem}_fit")
        paths = fitted.write(out, overlay=self.overlay)
        if self.json:
            sys.stdout.write(fitted.text)
            return 0
        sys.stdout.write(f"{fitted.result}{fitted.table}\n")
        if paths:
            listed = ", ".join(str(path) for path in paths)
            say(f"{'Picture' if len(paths) == 1 else 'Pictures'}: {listed}")
        return 0

    @property
    def observation(self) -> Path:
        """The first file."""
        return self.observations[0]

    def fit_file(self, status: AbstractContextManager[Any]) -> FittedFile:
        """Fit what the first file holds; ``status`` is entered while a joint fit is computed."""
        observation = self._load()
        command = self._with_stored_sigma(observation)
        learned = command.shape_of(observation)
        style = None
        if self.overlay is not None:
            from cadalign.cli.overlays import draw_overlays, overlay_style

            style = overlay_style(self, observation, is_learned=learned is not None)
        if observation.is_plain and learned is None and command.shape_sigma is None:
            result = self._fit(observation)
            found = FittedFile(result, result.to_dict(), "", self._pictures(observation, result))
            mesh = None
        else:
            from cadalign.cli.contributions import list_contributions, tabulate_contributions
            from cadalign.cli.fit_joint import fit_joint

            result, pictures, mesh = fit_joint(command, observation, status)
            data = result.to_dict() | list_contributions(result)
            found = FittedFile(result, data, tabulate_contributions(result), tuple(pictures))
        if style is None:
            return found
        return replace(found, overlays=draw_overlays(observation, result, mesh, style))

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
        """Read the first file; camera and evidence of the options take the place of its own."""
        from cadalign.io.observation import Observation

        _refuse_photo(self.observation)
        observation = Observation.load(self.observation, needs_xyz=False)
        if self.shape_of(observation) is None:
            observation = Observation.load(self.observation)
        previous = observation.camera
        camera = self.read_camera((previous.width, previous.height))
        changed = self.add_to(
            observation if camera is None else replace(observation, camera=camera)
        )
        if observation.others and changed is not observation:
            raise InputError(
                f"the file has {len(observation.views)} views, the options are for one",
                where=str(self.observation),
                fix="write camera, masks and other evidence into its `views`",
            )
        return changed

    def _pictures(self, observation: Observation, result: Result) -> tuple[ByteImage, ...]:
        """The result over the photo, unless --no-picture is given."""
        if not self.picture:
            return ()
        from cadalign.render.drawing.result_overlay import draw_result

        bounds = None
        if observation.model is not None:
            from cadalign.io.meshes.load import load_mesh

            bounds = load_mesh(observation.model).bounds
        return (draw_result(observation.views[0], result, bounds=bounds),)

    def _fit(self, observation: Observation) -> Result:
        """Fit the stretched model."""
        from cadalign.estimation.fit import fit

        options = self.options_for(observation)
        prior = options.focal_prior
        if prior is not None:
            share = 100 * prior.relative_sigma
            is_stored = self.stored and "focal_prior" in observation.fit_options
            source = "the file's prior" if is_stored else "the photo's EXIF data"
            say(f"Focal length from {source}: {prior.focal:.4g} px +-{share:.2g} %")
        with named_as_flags(self, options):
            return fit(
                observation.points_3d,
                observation.points_2d,
                observation.camera,
                **vars(options),
                ransac=self.ransac if self.robust else None,
                confidences=observation.confidences if self.robust else None,
                symmetry=observation.symmetry,
            )

    def options_for(self, observation: Observation) -> FitOptions:
        """Options of the fit: those of the flags, otherwise those of the file."""
        from cadalign.io.documents import in_file, within

        given = dict(observation.fit_options) if self.stored else {}
        given.pop("shape_sigma", None)  # which is not an option of the plain fit
        has_prior, stored_prior = "focal_prior" in given, given.pop("focal_prior", None)
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
        if focal == "estimate" and has_prior:
            prior = None if stored_prior is None else FocalPrior(**stored_prior)
        elif focal == "estimate" and self.exif and observation.image is not None:
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


def _refuse_photo(path: Path) -> None:
    """Refuse an image in the place of an observation, and say what makes one."""
    if path.suffix.lower() in _PHOTOS:
        raise InputError(
            "a photo, not an observation, which is a JSON file with camera and keypoints",
            where=str(path),
            fix=f"mark keypoints with `cadalign annotate {path.name} MODEL`, which writes one, or "
            "use a detector's with `cadalign observe`",
        )
