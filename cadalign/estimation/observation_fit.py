"""One observation aligned: the options of an estimate, and those of the observation that hold.

`cadalign fit` and runs over many observations align each in this way.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NoReturn, cast

from cadalign.errors import InputError
from cadalign.estimation.focal import USUAL, FocalPrior, PriorOption, prior_of_camera
from cadalign.estimation.options import SIMILAR_SCALE_SIGMA, FitOptions, RansacOptions, Sigma
from cadalign.io.documents import in_file, within
from cadalign.io.files import once_per_file

if TYPE_CHECKING:
    from cadalign.estimation.model import Model
    from cadalign.estimation.result import Result
    from cadalign.estimation.view import View
    from cadalign.io.observation import Observation, ObservationChanges
    from cadalign.shapes.model import ShapeModel

_OF_THE_MODEL = ("stretch", "known_axis", "stretch_sigma")  # options that a learned shape lacks
Note = Callable[[str], object]
"""What is told about an estimate, such as the source of its focal length."""


@dataclass(frozen=True, kw_only=True)
class ObservationFit:
    """Settings of an observation's alignment: model, noise, focal length and robust search."""

    sigma: float | None = None
    """Standard deviation of the keypoints [px]; by default the file's, or 1."""
    similar: bool = False
    """Estimate sigma from the residuals: for a model that is only similar to the object. Its
    proportions are similar, too: --stretch-sigma is 0.2, unless the file or a flag says
    otherwise."""
    stretch_prior: bool = True
    """Take a prior on the stretch: the flag's, the file's, or with --similar the default one; with
    --no-stretch-prior none."""
    robust: bool = False
    """Search for outliers among the keypoints (RANSAC) and fit to the inliers."""
    shape: Path | None = None
    """File of `cadalign shape learn`: estimate the object's own shape, of that category, in place
    of a stretch. Keypoints need the shape's semantic ids or names, and no xyz; of options stored in
    the file, sigma, loss and focal length count."""
    shape_sigma: float | None = None
    """Estimate the object's own shape from the model's: standard deviation of the keypoints'
    positions on the object about those on the stretched model [model units]."""
    image: bool = False
    """Take the photo itself as evidence: the model's outline is sought in it, from the estimate by
    everything else. The model needs a mesh."""
    focal: Literal["known", "estimate"] | None = None
    """Focal length: known (the file's) or estimate; by default known, if every view has one. Views
    of equal cameras share an estimated one."""
    focal_prior: Literal["usual", "none"] | float | None = None
    """Mean [px] of the prior on an estimated focal length, or: usual (usual lenses) or none; by
    default the file's, or that of the photo's EXIF data, or else usual."""
    focal_prior_sigma: float = FocalPrior.relative_sigma
    """Relative standard deviation of --focal-prior."""
    exif: bool = True
    """Use the photo's EXIF data as a prior on an estimated focal length."""
    stored: bool = True
    """Take the options that the file stores, except for those that flags set to another value than
    their defaults; with --no-stored flags alone count."""
    up_axis: Literal["x", "y", "z"] | None = None
    """The model's axis that points up, for evidence of gravity and heights; y, unless the file says
    otherwise."""
    fitting: FitOptions = field(default_factory=FitOptions)
    """Method and model; of sigma and focal length, the options above hold."""
    ransac: RansacOptions = field(default_factory=RansacOptions)
    """The search for outliers, where it is asked for."""

    @staticmethod
    def named(name: str) -> str:
        """Name of an option in messages."""
        return name

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

    def uses_photos(self, observation: Observation) -> bool:
        """True if the photos themselves are evidence: by the flag, or else by the file."""
        return self.image or (self.stored and bool(observation.fit_options.get("image", False)))

    def stated_sigma(self, observation: Observation) -> dict[str, Sigma | None]:
        """Standard deviation in the place of the keypoints' own, empty if there is none.

        None is to be estimated.
        """
        if self.similar:
            if self.sigma is not None:
                similar, sigma = self.named("similar"), self.named("sigma")
                what = f"{similar} estimates the standard deviation, which {sigma} gives"
                self._refuse_both(what, "sigma")
            return {"sigma": None}
        if self.sigma is not None:
            return {"sigma": self.sigma}
        if self.stored and "sigma" in observation.fit_options:
            return {"sigma": cast("Sigma | None", observation.fit_options["sigma"])}
        return {}

    def _refuse_both(self, what: str, name: str) -> NoReturn:
        raise InputError(what, where=self.named(name), fix="give one of the two options")

    def options_for(
        self, observation: Observation, where: str, note: Note = lambda text: None
    ) -> FitOptions:
        """Options of the fit: those that are given, otherwise those of the file."""
        given = dict(observation.fit_options) if self.stored else {}
        for name in ("shape_sigma", "image"):  # which are of the model and of the views
            given.pop(name, None)
        with in_file(where), within("fit"):
            stored = FitOptions(**{key: given[key] for key in given if key != "focal_prior"})
        set_by_flags = {
            field.name: getattr(self.fitting, field.name)
            for field in fields(self.fitting)
            if getattr(self.fitting, field.name) != field.default
        }
        are_known = all(view.camera.focal_known for view in observation.views)
        word = self.focal if isinstance(self.focal, str) else None  # a number is the camera's
        focal = word or given.get("focal", "known" if are_known else "estimate")
        if focal == "known" and not are_known:
            raise InputError(
                "the focal length is unknown",
                where=f"{where}: camera",
                fix=f"give {self.named('focal')} estimate, or a calibrated camera",
            )
        if focal == "estimate":
            prior = self._prior_for(observation, given, note)
            shown = prior_of_camera(prior, observation.camera)
            if shown is not None:
                note(f"Focal length is estimated, its prior: {shown}")
        elif self.focal_prior is not None:
            raise InputError(
                "given for a known focal length",
                where=self.named("focal_prior"),
                fix=f"give {self.named('focal')} estimate with it",
            )
        else:
            prior = None
        own = 1.0 if observation.sigma is None else observation.sigma
        sigma = self.stated_sigma(observation).get("sigma", own)
        changes = {**set_by_flags, "sigma": sigma, "focal": focal, "focal_prior": prior}
        chosen = replace(stored, **changes)
        return self._with_stretch_prior(chosen, is_stored="stretch_sigma" in given)

    def _prior_for(
        self, observation: Observation, stored: Mapping[str, Any], note: Note
    ) -> PriorOption:
        """The prior on an estimated focal length: the flag's, the file's, or the photos'."""
        given = self.focal_prior
        if given is not None and not isinstance(given, str):
            return FocalPrior(given, self.focal_prior_sigma)
        if given is not None:
            return USUAL if given == "usual" else None
        if "focal_prior" in stored:
            prior = stored["focal_prior"]
            return FocalPrior(**prior) if isinstance(prior, dict) else prior
        return (_prior_of_photos(observation, note) if self.exif else None) or USUAL

    def _with_stretch_prior(self, options: FitOptions, *, is_stored: bool) -> FitOptions:
        """The options with the default prior on a similar model's stretch, or without any."""
        if not self.stretch_prior:
            if self.fitting.stretch_sigma is not None:
                left_out, given = map(self.named, ("no_stretch_prior", "stretch_sigma"))
                what = f"{left_out} leaves out the prior, which {given} gives"
                self._refuse_both(what, "no_stretch_prior")
            return replace(options, stretch_sigma=None)
        chosen = is_stored or options.stretch_sigma is not None
        if chosen or not self.similar or options.method != "optimal" or not options.stretched_axes:
            return options
        return replace(options, stretch_sigma=SIMILAR_SCALE_SIGMA)

    def check_for(self, observation: Observation) -> None:
        """Refuse options that have no effect together with a shape or further evidence."""
        if self.shape is not None and self.shape_sigma is not None:
            what = f"{self.named('shape')} has learned how far objects of the category differ"
            self._refuse_both(what, "shape_sigma")
        learned = self.shape_of(observation)
        is_shaped = learned is not None or self.shape_sigma_of(observation) is not None
        refused = {
            "similar": is_shaped and self.similar,
            "no_stretch_prior": is_shaped and not self.stretch_prior,
        }
        for name in ("method", *(_OF_THE_MODEL if learned is not None else ())):
            refused[name] = getattr(self.fitting, name) != getattr(FitOptions, name)
        for name in [each for each, is_given in refused.items() if is_given]:
            raise InputError(
                f"has no effect together with {self._cause(observation)}",
                where=self.named(name),
                fix="leave out one of the two",
            )

    def _cause(self, observation: Observation) -> str:
        """Name of what makes the fit more than one of a stretched model to keypoints."""
        if self.shape is not None:
            return self.named("shape")
        if self.shape_sigma is not None:
            return self.named("shape_sigma")
        if self.shape_of(observation) is not None:
            return "the file's shape"
        if self.shape_sigma_of(observation) is not None:
            return "the file's shape_sigma"
        if self.uses_photos(observation):
            return self.named("image") if self.image else "the file's image"
        if observation.others:
            return "the file's views"
        if observation.depths is not None:
            return "the file's depth"
        rest = "size" if observation.size else "init"
        return f"the file's {next(iter(observation.evidence.given), rest)}"

    def read(
        self, data: Any, where: str, *, folder: Path | None, changes: ObservationChanges
    ) -> Observation:
        """Read the parsed form of an observation, with changes; ``where`` is its name in messages.

        Keypoints need no ``xyz`` where a learned shape is fitted.
        """
        from cadalign.io.observation import Observation
        from cadalign.io.observation_file import fill_xyz

        has_shape = isinstance(data, dict) and data.get("shape") is not None
        if self.shape is not None or (has_shape and self.takes_stored_shape):
            data = fill_xyz(data)
        with in_file(where):
            seen = Observation.from_dict(data, folder=folder)
        return changes.applied_to(seen, where)  # whose errors name options

    def fit(
        self,
        observation: Observation,
        where: str,
        *,
        note: Note = lambda text: None,
        status: AbstractContextManager[Any] | None = None,
    ) -> tuple[Result, tuple[View, ...] | None]:
        """Align an observation, ``where`` is its name in messages.

        ``note`` is called with the source of a focal length, ``status`` entered while
        `cadalign.align` works. Returns the views that were aligned, too; None for a stretched
        model's keypoints in one image. Raises CadalignError if options or observation are invalid,
        or there is no alignment.
        """
        notes: list[str] = []
        is_plain = observation.is_plain and self.shape_of(observation) is None
        is_plain &= not self.uses_photos(observation)
        ransac = self.ransac if self.robust else None
        result: Result
        views: tuple[View, ...] | None = None
        if is_plain and self.shape_sigma_of(observation) is None:
            from cadalign.estimation.fit import fit

            options = self.options_for(observation, where, notes.append)
            result = fit(
                observation.points_3d,
                observation.points_2d,
                observation.camera,
                **vars(options),
                ransac=ransac,
                scores=observation.scores if self.robust else None,
                symmetry=observation.symmetry,
            )
        else:
            from cadalign.estimation.align import align

            model, views, options = self._problem(observation, where, notes.append)
            with status or nullcontext(), self._located(where):
                result = align(
                    model,
                    views,
                    size=observation.size,
                    init=observation.init,
                    loss=options.loss,
                    loss_scale=options.loss_scale,
                    focal=options.focal,
                    focal_prior=options.focal_prior,
                    ransac=ransac,
                )
        for text in notes:
            note(text)
        return result, views

    def _problem(
        self, observation: Observation, where: str, note: Note
    ) -> tuple[Model | ShapeModel, tuple[View, ...], FitOptions]:
        """Model, views and options of an observation for `cadalign.align`."""
        from cadalign.estimation.observed import views_of

        self.check_for(observation)
        options = self.options_for(observation, where, note)
        model = self._model(observation, where, options)
        stated = self.stated_sigma(observation)
        has_photos = self.uses_photos(observation)
        if has_photos and all(image.image is None for image in observation.views):
            raise InputError(
                "the observation names no photo",
                where=self.named("image"),
                fix="write its path as `image` into the file, or leave the option away",
            )
        with in_file(where):
            given = stated.get("sigma")
            views = views_of(observation, model, sigma=given, with_photos=has_photos)
        if "sigma" in stated and stated["sigma"] is None:
            views = tuple(replace(view, sigma=None) for view in views)
        return model, views, options

    def _model(
        self, observation: Observation, where: str, options: FitOptions
    ) -> Model | ShapeModel:
        shape = self.shape_of(observation)
        if shape is not None:
            if observation.symmetry is not None:
                raise InputError(
                    "has no effect together with a learned shape",
                    where=f"{where}: symmetry",
                    fix="leave out one of the two",
                )
            return _opened(shape)
        from cadalign.estimation.observed import model_of
        from cadalign.io.meshes.files import load_mesh

        mesh = None if observation.model is None else load_mesh(observation.model)
        sigma = self.shape_sigma_of(observation)
        with self._located(where):
            found = model_of(observation, options=options, shape_sigma=sigma, mesh=mesh)
            return found if self.up_axis is None else replace(found, up_axis=self.up_axis)

    @contextmanager
    def _located(self, where: str) -> Iterator[None]:
        """Let errors about arguments name the option, or else the observation."""
        try:
            yield
        except InputError as error:
            if error.where in {field.name for field in (*fields(self), *fields(self.ransac))}:
                raise
            with in_file(where):
                raise


@once_per_file(4)
def _opened(path: Path) -> ShapeModel:
    """Open a learned shape, which runs use again and again."""
    from cadalign.shapes.model import ShapeModel

    return ShapeModel.open(path)


def _prior_of_photos(observation: Observation, note: Note) -> FocalPrior | None:
    """The prior of the first photo's EXIF data, unless those of another photo differ from it."""
    if observation.image is None:
        return None
    first = FocalPrior.from_exif(observation.image)
    photos = [view.image for view in observation.others if view.image is not None]
    for other in map(FocalPrior.from_exif, photos if first is not None else ()):
        if first is not None and other is not None and not first.is_like(other):
            note(
                f"The photos' EXIF data differ ({first.focal:.4g} and {other.focal:.4g} px): unused"
            )
            return None
    return first
