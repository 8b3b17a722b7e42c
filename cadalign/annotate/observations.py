"""Observation files of the annotator: read marks, and write marks.

The field ``unfinished`` of an observation holds the pairs that a fit cannot use: one half is not
placed, or the shape lacks the keypoint.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import chain, count
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from cadalign.annotate.files import LastContent, refuse_other_photo, refuse_other_source
from cadalign.annotate.keypoints import ObjectShape, positions_of
from cadalign.annotate.marks import Marks, Pair
from cadalign.annotate.model import MarkedModel
from cadalign.annotate.photos import ObjectMask, PhotoFile, camera_of
from cadalign.annotate.skeleton import open_skeleton
from cadalign.arrays import FloatArray
from cadalign.datasets.model_keypoints import ModelKeypoint
from cadalign.errors import DataError, InputError
from cadalign.geometry.camera import Camera
from cadalign.io.documents import Document, Point2, convert, name_file, name_part
from cadalign.io.evidence import KeypointFields
from cadalign.io.focal import FocalPrior
from cadalign.io.images import write_image
from cadalign.io.observation import Observation
from cadalign.io.pretrained import category_of

logger = logging.getLogger("cadalign")

LIKELY_STRETCH = 0.25
"""Standard deviation of the logarithm of each scale, unless the file has another one."""
LEAST_JOINT_PAIRS = 3
"""Minimum number of pairs of an alignment with further evidence; fewer need a start."""
_OTHER_FILE = "give another --observation or --out"
_OWN_OPTIONS = {"stretch_sigma", "focal_prior", "image"}


class _Half(KeypointFields, kw_only=True):
    """Pair that a fit cannot use: one half is missing, or the shape lacks its keypoint."""

    uv: Point2 | None = None

    def __post_init__(self) -> None:
        if self.uv is None and self.semantic_id is None:
            raise InputError("uv and semantic_id are both missing", fix="give one of them")


class _Unfinished(Document):
    pairs: list[_Half] = msgspec.field(default_factory=list)


@dataclass(eq=False)
class ObservationFile:
    """The observation file of a photo, which need not exist yet."""

    path: Path
    photo: PhotoFile
    stored: Observation = field(init=False)
    """Content of the file when it was opened; the marks replace parts of it."""
    _content: LastContent = field(default_factory=LastContent, repr=False)
    _drawn: tuple[ObjectMask, Path] | None = None  # the last mask that was written, and its file

    def read(self, model: MarkedModel, camera: Camera, *, up_axis: Any = None) -> Marks:
        """Read the marks of an earlier session, and add new points to the model.

        The ``camera`` is for a new file. Raises a CadalignError if a file is invalid.
        """
        self._content.note(self.path)
        if not self.path.exists():
            nothing = np.empty((0, 3)), np.empty((0, 2))
            self.stored = Observation(*nothing, camera, up_axis=up_axis or "y")
            return Marks(camera, model)
        stored = Observation.load(self.path)
        if stored.others:
            what = f"has {len(stored.views)} views, the annotator only opens files of one photo"
            raise DataError(what, where=str(self.path), fix=_OTHER_FILE)
        refuse_other_source("model", stored.model, model.path, where=self.path)
        if model.can_exchange and category_of(stored.shape) not in (None, model.shape.category):
            model = open_skeleton(ObjectShape.open(stored.shape))
        elif model.is_skeleton:
            refuse_other_source("shape", stored.shape, model.shape.path, where=self.path)
        refuse_other_photo(stored.image, self.photo.path, where=self.path)
        self._warn_of_options(stored, model)
        with name_file(self.path), name_part("unfinished"):
            unfinished = convert(stored.draft or {}, _Unfinished)
        self.stored = stored if up_axis is None else replace(stored, up_axis=up_axis)
        mask = stored.evidence.mask
        marks = Marks(
            camera_of(self.photo, stored.camera),
            model,
            mask=None if mask is None else ObjectMask(mask, stored.evidence.mask_sigma),
            photo=bool(stored.fit_options.get("image")),
            start=stored.init,
        )
        by_name = model.registry.fixed or (stored.model is None and stored.shape is not None)
        marks = _add_pairs(marks, stored, by_name=by_name)
        return _add_halves(marks, unfinished.pairs, by_name=by_name)

    def write(self, observation: Observation) -> None:
        """Write the observation; raises DataError on failure, or if others changed the file.

        A killed process leaves either the old or the new content.
        """
        self._content.refuse_changed(self.path)
        observation.save(self.path)
        self._content.note(self.path)

    @property
    def focal_prior(self) -> FocalPrior | None:
        """Prior on an estimated focal length, as in `cadalign fit`."""
        stored = self.stored.fit_options.get("focal_prior", self.photo.likely_focal)
        return FocalPrior(**stored) if isinstance(stored, Mapping) else stored

    @property
    def stretch_sigma(self) -> float:
        """Standard deviation of the prior on the stretch of a model without a learned shape."""
        return float(self.stored.fit_options.get("stretch_sigma") or LIKELY_STRETCH)

    def usable_pairs(self, marks: Marks) -> tuple[Pair, ...]:
        """Return the complete pairs that a fit uses: pairs of keypoints that the shape has.

        With a mask and without a start, a few pairs are not used: the mask alone aligns.
        """
        pairs, shape = marks.complete_pairs, marks.model.shape
        known = shape.knows(marks.points_of(pairs))
        counting = tuple(pair for pair, counts in zip(pairs, known, strict=True) if counts)
        by_mask = marks.mask is not None and marks.start is None and shape.learned is None
        return () if by_mask and len(counting) < LEAST_JOINT_PAIRS else counting

    def observation_of(
        self, marks: Marks, *, sigma: Mapping[str, Any] | None = None
    ) -> Observation:
        """Build the observation of marks; its other fields are the stored ones.

        ``sigma`` is the option for the estimated noise of the pairs.
        """
        pairs = self.usable_pairs(marks)
        points, model = marks.points_of(pairs), marks.model
        options = {**(sigma or {})}
        if model.shape.learned is None:
            options["stretch_sigma"] = self.stretch_sigma
        if marks.photo:
            options["image"] = True
        prior = self.focal_prior
        if prior != self.photo.likely_focal:
            options["focal_prior"] = None if prior is None else asdict(prior)
        depths = np.array([np.nan if pair.depth is None else pair.depth for pair in pairs])
        has_depths = bool(np.isfinite(depths).any())
        mask_sigma = None if marks.mask is None else marks.mask.sigma
        changes = {"mask": self._mask_file(marks), "mask_sigma": mask_sigma}
        if not has_depths:  # all keypoints with depths may be deleted
            changes["depth_sigma"] = None
        halves = [_half_of(pair, model) for pair in marks.pairs if pair not in pairs]
        return replace(
            self.stored,
            # Only places on a CAD model are known: a skeleton's are those of the mean shape.
            points_3d=positions_of(points) * (not model.is_skeleton),
            points_2d=np.array([pair.uv for pair in pairs], dtype=float).reshape(-1, 2),
            camera=marks.camera,
            sigma=_fill_missing(pair.sigma for pair in pairs),
            ids=np.array([point.semantic_id for point in points], dtype=np.int64),
            names=tuple(model.shape.name_of(point) for point in points),
            scores=_fill_missing(pair.score for pair in pairs),
            image=self.photo.path,
            depths=depths if has_depths else None,
            evidence=msgspec.structs.replace(self.stored.evidence, **changes),
            model=model.path,
            fit_options=options,
            shape=model.shape.path,
            init=marks.start if len(pairs) < LEAST_JOINT_PAIRS else None,
            draft={"pairs": halves} if halves else None,
        )

    def _mask_file(self, marks: Marks) -> Path | None:
        """Return the file of the mask, if there is one; writes a drawn mask if necessary."""
        if marks.mask is None or marks.mask.file is not None:
            return None if marks.mask is None else marks.mask.file
        mask, path = self._drawn or (None, None)
        if mask != marks.mask or path is None:
            numbers = chain([""], (f"-{number}" for number in count(2)))
            if path is None:
                paths = (self.path.with_name(f"{self.path.stem}.mask{n}.png") for n in numbers)
                path = next(each for each in paths if not each.exists())
            inside = marks.mask.pixels(self.photo.width, self.photo.height)
            write_image(path, np.where(inside, 255, 0).astype(np.uint8))
            self._drawn = marks.mask, path
        return path

    def _warn_of_options(self, stored: Observation, model: MarkedModel) -> None:
        """Warn of stored options of the fit that the page does not use."""
        options = dict(stored.fit_options)
        if "stretch_sigma" in options or options.get("sigma") is None:
            options.pop("sigma", None)  # estimated by the annotator, or not set
        others = [name for name in options if name not in _OWN_OPTIONS]
        if stored.shape is not None and model.shape.path is None:
            others.append(f"shape {stored.shape}")
        if others:
            logger.warning(
                "%s: the annotator fits without the stored %s, and replaces the stored options "
                "at the first change; keep a copy of the file if they matter",
                *(self.path, ", ".join(others)),
            )


def _fill_missing(values: Iterable[float | None]) -> FloatArray | None:
    """Return the values (n,), with 1 for missing ones; None if all are missing."""
    listed = list(values)
    if all(value is None for value in listed):
        return None
    return np.array([1.0 if value is None else value for value in listed])


def _half_of(pair: Pair, model: MarkedModel) -> dict[str, Any]:
    """Return a pair as the field ``unfinished`` stores it."""
    fields = {name: getattr(pair, name) for name in ("uv", "sigma", "score", "depth")}
    if pair.keypoint is not None:
        point = model.registry[pair.keypoint]
        xyz = None if model.is_skeleton else point.xyz
        fields |= {"semantic_id": pair.keypoint, "xyz": xyz, "name": point.name}
    return {name: value for name, value in fields.items() if value is not None}


def _add_halves(marks: Marks, halves: Sequence[_Half], *, by_name: bool) -> Marks:
    """Add unfinished pairs to the marks, except pairs of which no half is left."""
    for half in halves:
        point = ModelKeypoint(half.name or "", half.xyz or (0, 0, 0), half.semantic_id)
        keypoint = _register(point, marks, by_name=by_name or half.xyz is None)
        if half.uv is not None or keypoint is not None:
            pair = Pair(marks.next_number, half.uv, keypoint, half.sigma, half.score, half.depth)
            marks = marks.append(pair)
    return marks


def _add_pairs(marks: Marks, observation: Observation, *, by_name: bool) -> Marks:
    ids, names = observation.ids, observation.names
    columns = (observation.sigma, observation.scores, observation.depths)
    for row, (x, y, z) in enumerate(observation.points_3d.tolist()):
        number = None if ids is None else int(ids[row])
        point = ModelKeypoint("" if names is None else names[row], (x, y, z), number)
        keypoint = _register(point, marks, by_name=by_name)
        known = [None if each is None else float(each[row]) for each in columns]
        known = [None if each is None or math.isnan(each) else each for each in known]
        u, v = observation.points_2d[row].tolist()
        marks = marks.append(Pair(marks.next_number, (u, v), keypoint, *known))
    return marks


def _register(point: ModelKeypoint, marks: Marks, *, by_name: bool) -> int | None:
    """Find a free point of an observation file in the registry, or add it; returns its id.

    A point of a learned shape, whose ``xyz`` is not on the model, is found ``by_name`` or not at
    all; the result is then None.
    """
    wanted, registry, taken = point.semantic_id, marks.model.registry, marks.keypoints
    if by_name:
        known = registry.find_by_name(point)
        return None if known in taken else known
    if wanted is not None and wanted not in taken and registry.has(point):
        return wanted
    found = registry.find(point.xyz)
    if found is not None and found not in taken:
        return found
    is_free = wanted is not None and wanted not in registry
    return registry.add(point if is_free else replace(point, semantic_id=None))
