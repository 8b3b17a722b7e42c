"""Alignment of one observation by `cadalign.fit` or `cadalign.align`: options, model and views.

`cadalign fit` and runs over many observations use it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from cadalign.errors import DataError, InputError
from cadalign.estimation.options import SIMILAR_SCALE_SIGMA, FitOptions, RansacOptions, Sigma
from cadalign.estimation.result_parts import create_unchecked
from cadalign.io.documents import convert, name_file, name_part
from cadalign.io.evidence import ObservedImage
from cadalign.io.focal import USUAL, FocalPrior, PriorOption, prior_of_camera
from cadalign.io.observation import FitFields, Observation, ObservationChanges
from cadalign.io.pretrained import shape_path

if TYPE_CHECKING:
    from cadalign.estimation.model import Model
    from cadalign.estimation.result import Result
    from cadalign.estimation.view import View
    from cadalign.geometry.mesh import Mesh
    from cadalign.shapes.model import ShapeModel

_NOT_OF_FIT = ("shape_sigma", "image")  # stored options that `FitOptions` lacks
_STORED = ("sigma", "method", "loss", "stretch", "shape_sigma", "focal")
Note = Callable[[str], object]
"""Function called with notes on an estimate, such as the source of a focal length prior."""


@dataclass(frozen=True, kw_only=True)
class ObservationFit:
    """Settings of an alignment; they override the settings that the observation file stores."""

    sigma: float | Literal["none"] | None = None
    """Standard deviation of the keypoint noise [px], or none to estimate it from the residuals; by
    default the file's value, or 1."""
    similar: bool = False
    """The model is only similar to the object: estimate sigma unless it is given, and expect
    proportions within 20 % of the model's unless the file has a stretch_sigma."""
    robust: bool = False
    """Find outliers among the keypoints by RANSAC, and fit only the inliers."""
    shape: Path | None = None
    """Category of a shape that comes with cadalign, such as chair, or shape file: estimate the
    object's own shape within its category, instead of a stretch. Keypoints need the shape's
    semantic ids or names, but no xyz."""
    shape_sigma: float | None = None
    """Estimate the object's own shape as a deviation from the stretched model, with this standard
    deviation of each keypoint's position [model units]."""
    use_photo: bool = False
    """Use the photo itself as evidence: search it for the model's outline, starting at the estimate
    from all other evidence. The model needs a mesh."""
    focal: Literal["known", "estimate"] | None = None
    """Whether the focal length is known or to be estimated; by default known if all views have
    one."""
    method: str | None = None
    """Solver: optimal (maximum likelihood by global search; the default), aepnp (linear),
    aepnp-paper (linear, as published) or epnp (OpenCV, without stretch)."""
    loss: str | None = None
    """Loss on the length of a residual: linear (squared error; the default), or huber or cauchy,
    which tolerate outliers."""
    stretch: str | None = None
    """Axes whose scale is estimated: yz (the default), y, z or none."""

    @property
    def given(self) -> dict[str, Any]:
        """The options that are set, in the form of the field ``fit`` of an observation file."""
        values = {name: getattr(self, name) for name in _STORED}
        given = {name: value for name, value in values.items() if value is not None}
        if self.sigma == "none" or (self.similar and self.sigma is None):
            given["sigma"] = None
        return given | ({"image": True} if self.use_photo else {})

    def check(self) -> None:
        """Raise an InputError if an option is invalid by itself."""
        try:
            convert(self.given, FitFields)
        except DataError as error:
            raise InputError(error.what, where=error.where, fix=error.fix) from None
        checked = ("method", "loss", "stretch")
        FitOptions(**{name: each for name, each in self.given.items() if name in checked})

    def read(
        self, data: Any, where: str, *, folder: Path | None, changes: ObservationChanges
    ) -> Observation:
        """Build an observation from parsed JSON, and change its camera.

        ``where`` names it in messages. With a learned shape, keypoints need no ``xyz``.
        """
        needs_xyz = None if self.shape is None and self.shape_sigma is None else self.shape is None
        with name_file(where):
            seen = Observation.from_dict(data, folder=folder, needs_xyz=needs_xyz)
        return changes.apply(seen, where)  # outside of `name_file`: errors name options

    def override(self, seen: Observation) -> Observation:
        """Override the stored settings of an observation by the options that are set.

        Raises InputError if an option has no effect with a shape or with further evidence.
        """
        given, stored, shape = self.given, dict(seen.fit_options), seen.shape
        if self.shape is not None or self.shape_sigma is not None:
            if self.shape is not None and self.shape_sigma is not None:
                what = "has no effect together with a learned shape"
                raise InputError(what, where="shape_sigma", fix="give one of the two options")
            shape = shape if self.shape is None else shape_path(self.shape)
            stored.pop("shape_sigma", None)
        options = stored | given
        # Skips the checks of the observation, which take as long as a linear solver.
        fields = {"shape": shape and shape.absolute(), "fit_options": options}
        changed = create_unchecked(Observation, vars(seen) | fields)
        if not _is_plain(changed):
            self._refuse_without_effect(changed)
        has_prior = options.get("method", "optimal") == "optimal"
        if self.similar and has_prior and options.get("stretch") != "none":
            options.setdefault("stretch_sigma", SIMILAR_SCALE_SIGMA)
        return changed

    def _refuse_without_effect(self, seen: Observation) -> None:
        cause, refused = "evidence beyond the keypoints of one image", ["method"]
        if seen.shape is not None:
            cause, refused = "a learned shape", ["method", "similar", "stretch"]
        elif "shape_sigma" in seen.fit_options:
            cause, refused = "a similar shape", ["method", "similar"]
        for name in refused:
            if getattr(self, name):
                what, fix = f"has no effect together with {cause}", "leave out one of the two"
                raise InputError(what, where=name, fix=fix)

    def fit(self, seen: Observation, where: str, *, note: Note = lambda text: None) -> Result:
        """Align an observation that `override` has returned; ``where`` names it in messages.

        ``note`` is called with the keypoints that are left out, and the prior on a focal length.
        Raises CadalignError if an option or the observation is invalid, or if no alignment exists.
        """
        for view in seen.views:
            if view.text_of_not_found:
                note(view.text_of_not_found)
        options = self._options(seen, where, note)
        if seen.model is not None and seen.shape is None:
            from cadalign.io.meshes.files import check_keypoints

            with name_file(where):
                for view in seen.views:
                    check_keypoints(view.points_3d, seen.model, where="keypoints.xyz")
        if _is_plain(seen):
            return self._fit_keypoints(seen, options)
        return self._align(seen, where, options)

    def _options(self, seen: Observation, where: str, note: Note) -> FitOptions:
        """Build the options of the fit, with the standard deviation and the focal length prior."""
        given = {name: each for name, each in seen.fit_options.items() if name not in _NOT_OF_FIT}
        are_known = all(view.camera.focal_known for view in seen.views)
        focal = given.setdefault("focal", "known" if are_known else "estimate")
        if focal == "known" and not are_known:
            fix = "give `focal` estimate, or a calibrated camera"
            raise InputError("the focal length is unknown", where=f"{where}: camera", fix=fix)
        prior = _prior_for(seen, note) if focal == "estimate" else None
        if prior is not None:
            shown = prior_of_camera(prior, seen.camera)
            note(f"The focal length is estimated with the prior {shown}")
        given.setdefault("sigma", 1.0 if seen.sigma is None else seen.sigma)
        with self._locate_errors(where, "fit"):
            return FitOptions(**given | {"focal_prior": prior})

    def _fit_keypoints(self, seen: Observation, options: FitOptions) -> Result:
        from cadalign.estimation.fit import check_search, fit_one  # not for help of a command
        from cadalign.estimation.problems import pack_one

        start = time.perf_counter()
        problem = pack_one(seen.points_3d, seen.points_2d, seen.camera)
        ransac, scores = (RansacOptions(), seen.scores) if self.robust else (None, None)
        check_search(ransac, scores, seen.symmetry)
        with np.errstate(all="ignore"):
            search = (ransac, scores, seen.symmetry, start)
            return fit_one(problem, options, *search, seen.labels, seen.image)

    def _align(self, seen: Observation, where: str, options: FitOptions) -> Result:
        from cadalign.estimation.align import align

        model, given = self._model(seen, where, options), seen.fit_options
        has_photos = bool(given.get("image"))
        if has_photos and all(image.image is None for image in seen.views):
            fix = "add its path as the field image, or leave out the option"
            raise InputError("the observation names no photo", where="use_photo", fix=fix)
        with name_file(where):
            stated = {"sigma": given["sigma"]} if "sigma" in given else {}
            views = views_of(seen, model, with_photos=has_photos, **stated)
        with self._locate_errors(where):
            return align(
                model,
                views,
                size=seen.size,
                init=seen.init,
                loss=options.loss,
                loss_scale=options.loss_scale,
                focal=options.focal,
                focal_prior=options.focal_prior,
                ransac=RansacOptions() if self.robust else None,
            )

    def _model(self, seen: Observation, where: str, options: FitOptions) -> Model | ShapeModel:
        from cadalign.io.meshes.files import mesh_at

        if seen.shape is not None:
            if seen.symmetry is not None:
                what, place = "has no effect together with a learned shape", f"{where}: symmetry"
                raise InputError(what, where=place, fix="leave out one of the two")
            from cadalign.shapes.model import open_shape

            return open_shape(self.shape or seen.shape)  # errors name the option's path
        mesh = None if seen.model is None else mesh_at(seen.model)
        sigma = seen.fit_options.get("shape_sigma")
        with self._locate_errors(where):
            return model_of(seen, options=options, shape_sigma=sigma, mesh=mesh)

    @contextmanager
    def _locate_errors(self, where: str, part: str = "") -> Iterator[None]:
        """Locate errors about arguments: at an option that is set, otherwise in the observation."""
        try:
            yield
        except InputError as error:
            if error.where in self.given:
                raise
            with name_file(where), name_part(part) if part else nullcontext():
                raise


def _is_plain(seen: Observation) -> bool:
    """True if a stretched model is fitted only to the keypoints of one image."""
    given = seen.fit_options
    is_exact = seen.shape is None and given.get("shape_sigma") is None
    return seen.is_plain and is_exact and not given.get("image")


def model_of(
    observation: Observation,
    *,
    options: FitOptions,
    shape_sigma: float | None = None,
    mesh: Mesh | None = None,
) -> Model:
    """Build the model of the keypoints of all views of an observation.

    Uses the stretch of the options and its prior. Raises InputError if two views place a keypoint
    at different points of the model.
    """
    from cadalign.estimation.model import Model  # not for help of a command

    points: dict[Hashable, tuple[float, ...]] = {}
    labels = own_ids(observation.views)
    for number, (view, names) in enumerate(zip(observation.views, labels, strict=True)):
        for row, (name, xyz) in enumerate(zip(names, view.points_3d.tolist(), strict=True)):
            if points.setdefault(name, tuple(xyz)) != tuple(xyz):
                raise InputError(
                    f"differs from the xyz of keypoint {name!r} in an earlier view",
                    where=f"views[{number}].keypoints[{row}].xyz",
                    fix="give the same xyz in all views",
                )
    return Model(
        points_3d=list(points.values()),
        ids=list(points),
        mesh=mesh,
        shape_sigma=shape_sigma,
        stretch=options.stretch,
        stretch_sigma=options.stretch_sigma,
        symmetry=observation.symmetry,
        up_axis=observation.up_axis,
    )


def views_of(
    observation: Observation,
    model: Model | ShapeModel,
    *,
    with_photos: bool = False,
    **stated: Sigma | None,
) -> tuple[View, ...]:
    """Build the views of an observation for `cadalign.align`.

    The standard deviation is a stated ``sigma`` [px], otherwise the image's own, otherwise 1. The
    keypoints of a learned shape are found by `ShapeModel.resolve`. With ``with_photos``, the photos
    themselves are evidence.

    Raises InputError if the shape lacks a keypoint, the observation has no ids or names, an id
    occurs twice, or evidence of an image is invalid; DataError if a file cannot be read.
    """
    from cadalign.estimation.view import View
    from cadalign.shapes.model import ShapeModel

    labels = own_ids(observation.views)
    views = []
    for number, image in enumerate(observation.views):
        with name_part(f"views[{number}]") if observation.others else nullcontext():
            ids = labels[number]
            if isinstance(model, ShapeModel) and len(image.points_2d):
                ids = model.resolve(image.ids, image.names, where="keypoints")
            evidence = image.evidence.given
            if image.depths is not None:
                evidence["depth"] = image.depths
            own = {"sigma": 1.0 if image.sigma is None else image.sigma}
            view = View(
                image.camera,
                image.points_2d,
                ids=ids,
                scores=image.scores,
                image=image.image if with_photos else None,
                photo=image.image,
                **evidence | own | stated,
            )
            views.append(view)
    return tuple(views)


def own_ids(images: Sequence[ObservedImage]) -> tuple[tuple[Hashable, ...], ...]:
    """Label the keypoints of all images; a keypoint has the same label in every image.

    Labels are the ids or the names if they are unique in each image. Otherwise they are numbers,
    and keypoints of several images with equal ``xyz`` share a number.
    """
    for field in ("ids", "names"):
        columns = [getattr(each, field) if len(each.points_2d) else () for each in images]
        if all(column is not None and len(set(column)) == len(column) for column in columns):
            return tuple(
                tuple(each if isinstance(each, str) else int(each) for each in column)
                for column in columns
            )
    if len(images) < 2:
        return (tuple(range(len(images[0].points_2d))),)
    numbers: dict[tuple[float, ...], int] = {}
    return tuple(
        tuple(numbers.setdefault(tuple(xyz), len(numbers)) for xyz in image.points_3d.tolist())
        for image in images
    )


def _prior_for(seen: Observation, note: Note) -> PriorOption:
    """Return the focal length prior: the stored prior, or from EXIF data, or for usual lenses.

    EXIF data are not used if they differ between the photos.
    """
    if "focal_prior" in seen.fit_options:
        prior = seen.fit_options["focal_prior"]
        return FocalPrior(**prior) if isinstance(prior, dict) else prior
    images = [view.image for view in seen.views if view.image is not None]
    found = [prior for prior in map(FocalPrior.from_exif, images) if prior is not None]
    for other in found[1:]:
        if not found[0].is_like(other):
            focals = f"{found[0].focal:.4g} and {other.focal:.4g} px"
            note(f"The photos' EXIF focal lengths differ ({focals}): not used")
            return USUAL
    return found[0] if found else USUAL
