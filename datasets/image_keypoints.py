"""Keypoints of detectors and annotation tools in an image, and their pairing with a model's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, as_floats
from cadalign.datasets.model_keypoints import ModelKeypoints
from cadalign.errors import DataError, InputError, quote
from cadalign.geometry.camera import Camera
from cadalign.geometry.pixels import check_pixels, missing_pixels
from cadalign.io.images import photo_size, require_one_size
from cadalign.io.kinds import PHOTO_ENDINGS
from cadalign.io.observation import Observation, ObservationChanges
from cadalign.shapes.parts import plain_name

_COCO_DIGITS = 12


@dataclass(frozen=True, eq=False)
class ImageKeypoints:
    """The keypoints of one object in one image."""

    points_2d: FloatArray
    """(k, 2), pixels; integers are pixel centres. NaN for a keypoint that was not found."""
    scores: FloatArray | None = None
    """(k,), the detector's confidence in each keypoint, 0 for a keypoint that was not found.
    Visibility flags become 0 (not labelled), 0.5 (hidden) and 1 (visible)."""
    names: tuple[str, ...] | None = None
    """(k,), name of each keypoint."""
    ids: tuple[int, ...] | None = None
    """(k,), semantic id of each keypoint."""
    sigma: FloatArray | None = None
    """(k,), standard deviation of each [px]."""
    image: str | None = None
    """Name or id of the image."""
    size: tuple[int, int] | None = None
    """The image's width and height [px]."""
    images: int = 1
    """Number of images that the file lists, with or without keypoints."""
    score: float | None = None
    """The detector's confidence in the whole object."""
    source: str = "keypoints"
    """The file and the place in it, for messages."""
    measured: BoolArray = field(init=False, repr=False)
    """Mask (k,) of the keypoints whose pixel is a measurement, whatever their score; see
    `cadalign.geometry.pixels.missing_pixels`."""
    segmentation: Any = field(default=None, kw_only=True)
    """The object's mask in COCO's form, unchecked; see
    `cadalign.datasets.coco.decode_segmentation`."""

    def __post_init__(self) -> None:
        where = f"{self.source}: keypoints"
        points = as_floats(self.points_2d, name=where, shape=(None, 2), finite=False)
        bad = np.isinf(points).any(axis=1) | (np.isnan(points).sum(axis=1) == 1)
        if bad.any():
            row = int(bad.argmax())
            what = f"keypoint {row} has the invalid pixel {quote(points[row].tolist())}"
            fix = "give two finite numbers, or two NaN if it was not found"
            raise DataError(what, where=where, fix=fix)
        object.__setattr__(self, "points_2d", points)
        measured = ~missing_pixels(points, least=1)
        for name in ("scores", "sigma"):
            if (value := getattr(self, name)) is None:
                continue
            where = f"{self.source}: {name}"
            value = as_floats(value, name=where, shape=(len(points),), finite=name == "sigma")
            what, bad = ("not positive", value <= 0) if name == "sigma" else ("negative", value < 0)
            bad = measured & (bad | np.isnan(value))
            if bad.any():
                row = int(np.argmax(bad))
                reason = f"keypoint {row} has the value {value[row]:g}, which is {what}"
                if np.isnan(value[row]):
                    reason = f"keypoint {row} has a pixel, but no score"
                raise DataError(reason, where=where)
            if name == "scores":
                value = np.where(measured & (value > 0), value, 0.0)
            object.__setattr__(self, name, value)
        for name in ("names", "ids"):
            values = getattr(self, name)
            if values is not None and len(values) != len(points):
                what = f"{len(points)} keypoints but {len(values)} {name}"
                raise DataError(what, where=self.source)

        object.__setattr__(self, "measured", measured)

    def __len__(self) -> int:
        return len(self.points_2d)

    @property
    def is_found(self) -> BoolArray:
        """Mask (k,) of the keypoints that were found: with a measured pixel and a score over 0."""
        return self.measured if self.scores is None else np.asarray(self.scores > 0)

    def matches_photo(self, photo: str) -> bool:
        """True if the image's name or id matches the photo's file name."""
        path = Path(photo)
        return self.image is not None and (
            self.image in (photo, path.stem) or Path(self.image).name == path.name
        )


def find_photo(folder: Path, image: str) -> Path | None:
    """Find the photo of an image name or id in a folder, or None.

    Leading folders of the name may be missing. COCO's photos are named by ids of twelve digits.
    """
    parts = [part for part in Path(image).parts if part not in (Path(image).anchor, "..")]
    paths = [folder.joinpath(*parts[first:]) for first in range(len(parts))]
    if not Path(image).suffix:  # an id in a detector's result
        stems = (image, image.zfill(_COCO_DIGITS)) if image.isdecimal() else (image,)
        paths += [folder / f"{stem}{ending}" for stem in stems for ending in PHOTO_ENDINGS]
    return next(filter(Path.is_file, paths), None)


def choose_object(
    objects: Sequence[ImageKeypoints], *, image: str | None = None, number: int | None = None
) -> ImageKeypoints:
    """Choose one of a file's objects.

    Parameters
    ----------
    objects : sequence of ImageKeypoints
    image : str, optional
        The image's id, file name or path; required if the file has several images. It is not
        compared if the file has only one image.
    number : int, optional
        Position among the image's objects, from 0; by default the object of the highest score, or
        the only one.

    Raises
    ------
    InputError
        If the image or object does not exist, or the choice is ambiguous.
    """
    images = list(dict.fromkeys(found.image for found in objects))
    wanted = [found for found in objects if image is not None and found.matches_photo(image)]
    shares = {found.image: _count_shared_parts(image, found.image) for found in wanted}
    wanted = [found for found in wanted if shares[found.image] == max(shares.values())]
    named = list(dict.fromkeys(found.image for found in wanted))
    if len(named) > 1:
        fix = f"give a path that ends with one of {', '.join(map(str, named[:5]))}"
        raise InputError(f"{len(named)} images are called {image!r}", where="image", fix=fix)
    if not wanted:
        listed_images = max((found.images for found in objects), default=0)
        if image is not None and listed_images > 1 and len(images) == 1:
            what = f"the file lists {listed_images} images, but no keypoints in {image!r}"
            raise InputError(what, where="image", fix=f"it has keypoints only in {images[0]}")
        if len(images) != 1:
            listed = ", ".join(str(name) for name in images[:5])
            fix = f"choose one of {listed}" + (", ..." if len(images) > 5 else "")
            missing = "" if image is None else f", none is called {image!r}"
            raise InputError(f"the file has {len(images)} images{missing}", where="image", fix=fix)
        wanted = list(objects)
    if number is not None:
        if not 0 <= number < len(wanted):
            what = f"there is no object {number} of {len(wanted)}"
            raise InputError(what, where="number", fix="count from 0")
        return wanted[number]
    if len(wanted) > 1 and any(found.score is None for found in wanted):
        what = f"the image has {len(wanted)} objects, and no scores to choose by"
        raise InputError(what, where="number", fix=f"choose one, 0 to {len(wanted) - 1}")
    return max(wanted, key=lambda found: found.score or 0.0)


def _count_shared_parts(photo: str | None, image: str | None) -> int:
    """Number of parts in an image's path, if the photo's path ends with it; else 0."""
    own = Path(image or "").parts
    return len(own) if own and Path(photo or "").parts[-len(own) :] == own else 0


def join_keypoints(
    found: ImageKeypoints,
    model: ModelKeypoints,
    camera: Camera,
    *,
    image: Path | None = None,
    min_score: float = 0.0,
    ignore_unknown: bool = False,
) -> Observation:
    """Pair an image's keypoints with the model's.

    Keypoints are paired by name if the image's have names; case, ``_``, ``-`` and spaces are not
    compared. Otherwise they are paired by semantic id, or else by order if the numbers are equal.

    Parameters
    ----------
    found : ImageKeypoints
    model : ModelKeypoints
    camera : Camera
        The photo's camera; `Camera.from_size` if its focal length is unknown.
    image : Path, optional
        The photo.
    min_score : float
        Keypoints of a lower score, and of score 0, are left out.
    ignore_unknown : bool
        Leave out keypoints that the model does not have, instead of raising an error.

    Returns
    -------
    Observation

    Raises
    ------
    DataError
        If a keypoint is unknown or occurs twice, none is left, or the camera's size differs.
    """
    if found.size not in (None, (camera.width, camera.height)):
        what = "the image has {} x {} pixels".format(*found.size)
        what += f", the camera has {camera.width} x {camera.height}"
        raise DataError(what, where=found.source, fix="give the camera of these images")
    pixels = found.points_2d[found.measured]
    check_pixels(pixels, camera.width, camera.height, where=found.source)
    kept = np.flatnonzero(found.is_found).tolist()
    if found.scores is not None:
        kept = [row for row in kept if found.scores[row] >= min_score]
    places = _match_rows(found, model)
    unknown = [row for row in kept if places[row] is None]
    if unknown and not ignore_unknown:
        labels = found.names or found.ids or range(len(found))
        what = f"the model has no keypoint {labels[unknown[0]]!r}"
        fix = f"it has {first_names(model.names)}; ignore_unknown leaves out unknown keypoints"
        raise DataError(what, where=found.source, fix=fix)
    pairs = [(row, place) for row in kept if (place := places[row]) is not None]
    first: dict[int, int] = {}
    for row, place in pairs:
        if first.setdefault(place, row) != row:
            what = f"keypoints {first[place]} and {row} are both {model.names[place]!r}"
            raise DataError(what, where=found.source, fix="leave one of them out")
    if not pairs:
        what = f"none of {len(found)} keypoints is found in the image and on the model"
        raise DataError(what, where=found.source, fix=f"the model has {first_names(model.names)}")
    rows, columns = [row for row, _ in pairs], [place for _, place in pairs]
    ids = [model.ids[place] for place in columns]
    return Observation(
        points_3d=model.xyz[columns],
        points_2d=found.points_2d[rows],
        camera=camera,
        sigma=None if found.sigma is None else found.sigma[rows],
        ids=None if None in ids else np.array(ids, dtype=np.int64),
        names=tuple(model.names[place] for place in columns),
        scores=None if found.scores is None else found.scores[rows],
        image=image,
        model=model.model,
        not_found=tuple(np.flatnonzero(~found.measured).tolist()),
    )


def observe_keypoints(
    found: ImageKeypoints,
    model: ModelKeypoints,
    changes: ObservationChanges,
    *,
    image: Path | None = None,
    **how: Any,
) -> Observation:
    """Pair an image's keypoints with the model's, using the camera of ``changes``.

    Without a camera, one of the photo's size and of unknown focal length is used. ``how`` are
    further arguments of `join_keypoints`.

    Raises CadalignError as `join_keypoints` does, if a file cannot be read, if the image's size is
    unknown, or if photo, camera and keypoints differ in size.
    """
    sizes = {} if image is None else {str(image): photo_size(image)}
    if found.size is not None:
        sizes[found.source] = found.size
    camera = changes.read_camera(next(iter(sizes.values()), None))
    if camera is not None:
        sizes = {str(changes.camera): (camera.width, camera.height), **sizes}
    if not sizes:
        fix = "give the photo, or the camera"
        raise DataError("the photo's size is unknown", where=found.source, fix=fix)
    require_one_size(sizes, image)
    camera = camera or Camera.from_size(*next(iter(sizes.values())))
    return replace(changes, camera=None).apply(
        join_keypoints(found, model, camera, image=image, **how)
    )


def _match_rows(found: ImageKeypoints, model: ModelKeypoints) -> list[int | None]:
    """The model's row for each of the image's keypoints; None if the model lacks it."""
    for given, own in ((found.names, model.names), (found.ids, model.ids)):
        if given is not None:
            rows = {plain_name(label): row for row, label in enumerate(own)}
            return [rows.get(plain_name(label)) for label in given]
    if len(found) != len(model):
        what = f"{len(found)} keypoints without names, but the model has {len(model)}"
        fix = "give names, or all of the model's keypoints in its order"
        raise DataError(what, where=found.source, fix=fix)
    return list(range(len(found)))


def first_names(names: Sequence[str]) -> str:
    """List the first five names, for a message."""
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
