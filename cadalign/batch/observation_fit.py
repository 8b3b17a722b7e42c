"""Options of one observation's alignment, and those of the observation that hold.

`cadalign fit` and runs over many observations align each in this way.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro

from cadalign.errors import InputError
from cadalign.estimation.options import SIMILAR_SCALE_SIGMA, FitOptions, RansacOptions, Sigma
from cadalign.io.documents import in_file, within
from cadalign.io.files import once_per_file
from cadalign.io.focal import USUAL, FocalPrior, PriorOption, prior_of_camera
from cadalign.io.observation import Observation, ObservationChanges

if TYPE_CHECKING:
    from cadalign.estimation.model import Model
    from cadalign.estimation.result import Result
    from cadalign.shapes.model import ShapeModel

_NOT_OF_FIT = ("shape_sigma", "image", "focal_prior")  # stored options that are read apart
_OF_THE_MODEL = ("stretch", "stretch_sigma")  # options that a learned shape lacks
Note = Callable[[str], object]
"""What is told about an estimate, such as the source of its focal length."""


@dataclass(frozen=True, kw_only=True)
class ObservationFit:
    """Settings of an observation's alignment, in the place of those that its file stores."""

    sigma: float | Literal["none"] | None = None
    """Standard deviation of the keypoints [px], by default the file's, or 1; none: estimated from
    the residuals."""
    similar: bool = False
    """For a model that is only similar to the object: sigma is none unless it is given, and
    proportions are expected within 20 % of the model's, unless the file says otherwise."""
    robust: bool = False
    """Search for outliers among the keypoints (RANSAC) and fit to the inliers."""
    shape: Path | None = None
    """File of `cadalign shape learn`: estimate the object's own shape, of that category, in place
    of a stretch. Keypoints need the shape's semantic ids or names, and no xyz."""
    shape_sigma: float | None = None
    """Estimate the object's own shape from the model's: standard deviation of the keypoints'
    positions on the object about those on the stretched model [model units]."""
    use_photo: bool = False
    """Take the photo itself as evidence: the model's outline is sought in it, from the estimate by
    everything else. The model needs a mesh."""
    focal: Literal["known", "estimate"] | None = None
    """Focal length: known (the file's) or estimate; by default known, if every view has one."""
    focal_prior: Annotated[FocalPrior | Literal["usual", "none"] | None, tyro.conf.Suppress] = None
    """Prior on an estimated focal length; by default the file's, or that of the photo's EXIF data,
    or else that of usual lenses."""
    fitting: Annotated[FitOptions, tyro.conf.Suppress] = field(default_factory=FitOptions)
    """Method and model; of sigma and focal length, the options above hold."""
    ransac: Annotated[RansacOptions, tyro.conf.Suppress] = field(default_factory=RansacOptions)
    """The search for outliers, where it is asked for."""

    def shape_of(self, observation: Observation) -> Path | None:
        """File of the learned shape to fit: the given one, or else the file's."""
        takes_own = self.shape is None and self.shape_sigma is None
        return observation.shape if takes_own else self.shape

    def shape_sigma_of(self, observation: Observation) -> float | None:
        """Deviation of a similar model's shape: the given one, or else the file's."""
        if self.shape is not None or self.shape_sigma is not None:
            return self.shape_sigma
        return observation.fit_options.get("shape_sigma")

    def uses_photos(self, observation: Observation) -> bool:
        """True if the photos themselves are evidence."""
        return self.use_photo or bool(observation.fit_options.get("image"))

    def stated_sigma(self, observation: Observation) -> dict[str, Sigma | None]:
        """Standard deviation in the place of the keypoints' own, empty if there is none.

        None is to be estimated.
        """
        if self.sigma is not None or self.similar:
            return {"sigma": None if isinstance(self.sigma, str) else self.sigma}
        stored = observation.fit_options
        return {"sigma": stored["sigma"]} if "sigma" in stored else {}

    def options_for(self, observation: Observation, where: str, note: Note) -> FitOptions:
        """Options of the fit: those that are given, otherwise those of the file."""
        given = observation.fit_options
        with in_file(where), within("fit"):
            stored = FitOptions(**{name: given[name] for name in given if name not in _NOT_OF_FIT})
        are_known = all(view.camera.focal_known for view in observation.views)
        focal = self.focal or given.get("focal", "known" if are_known else "estimate")
        if focal == "known" and not are_known:
            fix = "give `focal` estimate, or a calibrated camera"
            raise InputError("the focal length is unknown", where=f"{where}: camera", fix=fix)
        if focal == "known" and self.focal_prior is not None:
            what, fix = "given for a known focal length", "give `focal` estimate with it"
            raise InputError(what, where="focal_prior", fix=fix)
        prior = self._prior_for(observation, note) if focal == "estimate" else None
        shown = prior_of_camera(prior, observation.camera)
        if shown is not None:
            note(f"Focal length is estimated, its prior: {shown}")
        own = 1.0 if observation.sigma is None else observation.sigma
        sigma = self.stated_sigma(observation).get("sigma", own)
        changes = {**self._set, "sigma": sigma, "focal": focal, "focal_prior": prior}
        options = replace(stored, **changes)
        is_chosen = "stretch_sigma" in given or options.stretch_sigma is not None
        has_prior = options.method == "optimal" and bool(options.stretched_axes)
        if self.similar and has_prior and not is_chosen:
            return replace(options, stretch_sigma=SIMILAR_SCALE_SIGMA)
        return options

    @property
    def _set(self) -> dict[str, Any]:
        """Options of the fit that are not at their defaults."""
        values = {each.name: getattr(self.fitting, each.name) for each in fields(self.fitting)}
        return {name: each for name, each in values.items() if each != getattr(FitOptions, name)}

    def _prior_for(self, observation: Observation, note: Note) -> PriorOption:
        """The prior on an estimated focal length: the given one, the file's, or the photos'."""
        stored = observation.fit_options
        if self.focal_prior is not None:
            return None if self.focal_prior == "none" else self.focal_prior
        if "focal_prior" in stored:
            prior = stored["focal_prior"]
            return FocalPrior(**prior) if isinstance(prior, dict) else prior
        return _prior_of_photos(observation, note) or USUAL

    def check_for(self, observation: Observation) -> None:
        """Refuse options that have no effect together with a shape or further evidence."""
        if self.shape is not None and self.shape_sigma is not None:
            what = "`shape` has learned how far objects of the category differ"
            raise InputError(what, where="shape_sigma", fix="give one of the two options")
        is_learned = self.shape_of(observation) is not None
        is_similar = self.shape_sigma_of(observation) is not None
        given, refused = {*self._set}, {"method"}
        cause = "evidence beyond the keypoints of one image"
        if is_learned or is_similar:
            cause = "a learned shape" if is_learned else "a similar shape"
            refused |= {"similar", *(_OF_THE_MODEL if is_learned else ())}
            given |= {"similar"} if self.similar else set()
        for name in sorted(given & refused):
            what, fix = f"has no effect together with {cause}", "leave out one of the two"
            raise InputError(what, where=name, fix=fix)

    def read(
        self, data: Any, where: str, *, folder: Path | None, changes: ObservationChanges
    ) -> Observation:
        """Read the parsed form of an observation, with changes; ``where`` is its name in messages.

        Its shape is the learned one that is fitted, without which keypoints need ``xyz``.
        """
        needs_xyz = None if self.shape_sigma is None else True
        if self.shape is not None:
            needs_xyz = False
        with in_file(where):
            seen = Observation.from_dict(data, folder=folder, needs_xyz=needs_xyz)
        seen = changes.applied_to(seen, where)  # whose errors name options
        shape = self.shape_of(seen)
        return replace(seen, shape=None if shape is None else shape.absolute())

    def fit(
        self, observation: Observation, where: str, *, note: Note = lambda text: None
    ) -> Result:
        """Align an observation, ``where`` is its name in messages.

        ``note`` is called with the source of a focal length. Raises CadalignError if options or
        observation are invalid, or there is no alignment.
        """
        notes = [text for view in observation.views if (text := view.text_of_not_found)]
        options = self.options_for(observation, where, notes.append)
        shape, shape_sigma = self.shape_of(observation), self.shape_sigma_of(observation)
        if observation.model is not None and shape is None:
            from cadalign.io.meshes.files import check_keypoints

            with in_file(where):
                for view in observation.views:
                    check_keypoints(view.points_3d, observation.model, where="keypoints.xyz")
        is_exact = shape is None and shape_sigma is None
        if observation.is_plain and is_exact and not self.uses_photos(observation):
            result = self._fit_keypoints(observation, options)
        else:
            self.check_for(observation)
            result = self._align(observation, where, options)
        for text in notes:
            note(text)
        return result

    def _fit_keypoints(self, seen: Observation, options: FitOptions) -> Result:
        """Fit a stretched model to the keypoints of one image."""
        from cadalign.estimation.fit import check_search, fit_one  # not for help of a command
        from cadalign.estimation.problems import pack_one

        start = time.perf_counter()
        problem = pack_one(seen.points_3d, seen.points_2d, seen.camera)
        ransac, scores = (self.ransac, seen.scores) if self.robust else (None, None)
        check_search(ransac, scores, seen.symmetry)
        with np.errstate(all="ignore"):
            search = (ransac, scores, seen.symmetry, start)
            return fit_one(problem, options, *search, seen.labels, seen.image)

    def _align(self, observation: Observation, where: str, options: FitOptions) -> Result:
        """Align all evidence of an observation."""
        from cadalign.batch.observed import views_of
        from cadalign.estimation.align import align

        model = self._model(observation, where, options)
        has_photos = self.uses_photos(observation)
        if has_photos and all(image.image is None for image in observation.views):
            fix = "write its path as image into the file, or leave the option away"
            raise InputError("the observation names no photo", where="use_photo", fix=fix)
        with in_file(where):
            stated = self.stated_sigma(observation)
            views = views_of(observation, model, with_photos=has_photos, **stated)
        with self._located(where):
            return align(
                model,
                views,
                size=observation.size,
                init=observation.init,
                loss=options.loss,
                loss_scale=options.loss_scale,
                focal=options.focal,
                focal_prior=options.focal_prior,
                ransac=self.ransac if self.robust else None,
            )

    def _model(
        self, observation: Observation, where: str, options: FitOptions
    ) -> Model | ShapeModel:
        from cadalign.batch.observed import model_of
        from cadalign.io.meshes.files import mesh_at

        if (shape := self.shape_of(observation)) is not None:
            if observation.symmetry is not None:
                what, place = "has no effect together with a learned shape", f"{where}: symmetry"
                raise InputError(what, where=place, fix="leave out one of the two")
            return opened_shape(shape)
        mesh = None if observation.model is None else mesh_at(observation.model)
        sigma = self.shape_sigma_of(observation)
        with self._located(where):
            return model_of(observation, options=options, shape_sigma=sigma, mesh=mesh)

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
def opened_shape(path: Path) -> ShapeModel:
    """Open a learned shape, which runs use again and again."""
    from cadalign.shapes.model import ShapeModel

    return ShapeModel.open(path)


def _prior_of_photos(observation: Observation, note: Note) -> FocalPrior | None:
    """The prior of the first photo's EXIF data, unless those of another photo differ from it."""
    images = [view.image for view in observation.views if view.image is not None]
    found = [prior for prior in map(FocalPrior.from_exif, images) if prior is not None]
    for other in found[1:]:
        if not found[0].is_like(other):
            focals = f"{found[0].focal:.4g} and {other.focal:.4g} px"
            note(f"The photos' EXIF data differ ({focals}): unused")
            return None
    return found[0] if found else None
