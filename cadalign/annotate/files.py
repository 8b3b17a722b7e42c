"""Files of an object: its observation, which holds all that must last, and its alignment.

Beside the observation `photo.json` is `photo_fit/fit.json`, the alignment as `cadalign fit` finds
and writes it, but for what other objects of the photo say of its focal length. The observation's
field ``unfinished`` has what a fit cannot use: pairs with only one half placed, those whose
keypoint the category's shape lacks, and further photos without any pair.
Sessions of earlier versions kept these in a file of their own, `photo.unfinished.json`.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from cadalign.annotate.document import AnnotationDocument, Pair, Priors
from cadalign.annotate.locks import LastContent
from cadalign.annotate.models import (
    KeypointRegistry,
    ObjectShape,
    OpenedModel,
    refuse_other_model,
)
from cadalign.annotate.names import earlier_unfinished_file
from cadalign.arrays import FloatArray
from cadalign.datasets.models.model_keypoints import ModelKeypoint
from cadalign.errors import DataError, InputError
from cadalign.estimation.focal import FocalPrior
from cadalign.estimation.result import Result
from cadalign.geometry.camera import Camera
from cadalign.io.documents import (
    Document,
    PathText,
    Point2,
    convert,
    in_file,
    path_from,
    read_json,
    within,
)
from cadalign.io.evidence import ObservedImage
from cadalign.io.files import write_json, writing
from cadalign.io.observation import Observation
from cadalign.io.observation_file import SeenKeypoint

logger = logging.getLogger("cadalign")

_RENAME = "rename it: the annotator writes a file of this name"
_NO_KEYPOINTS = np.empty((0, 3)), np.empty((0, 2))
_EARLIER_FORMAT = "cadalign unfinished pairs"
# Fields that are not of one image.
_OF_THE_OBJECT = (
    *("init", "model", "object", "shape", "size", "symmetry", "up_axis", "fit", "unfinished"),
)


class _Half(SeenKeypoint, kw_only=True):
    """Pair with only the photo half or the model half, or both of which are of no use to a fit."""

    uv: Point2 | None = None

    def __post_init__(self) -> None:
        if self.uv is None and self.semantic_id is None:
            raise InputError("uv and semantic_id are both missing", fix="give one of them")


class _UnfinishedView(Document):
    """The pairs of a further photo that the observation lacks, or the photo without any."""

    image: PathText
    camera: Any  # in the form of `Camera.from_dict`
    pairs: list[_Half] = msgspec.field(default_factory=list)


class _Unfinished(Document):
    pairs: list[_Half] = msgspec.field(default_factory=list)
    views: list[_UnfinishedView] = msgspec.field(default_factory=list)
    format: str = ""  # of the file of earlier versions


@dataclass(frozen=True, eq=False)
class StoredView:
    """An image of an observation; a further photo of the object has its annotation if it exists."""

    seen: ObservedImage
    document: AnnotationDocument | None = None


@dataclass(frozen=True, eq=False)
class Stored:
    """An earlier session's annotation of a photo; ``observation`` is None without such a file."""

    document: AnnotationDocument = field(default_factory=AnnotationDocument)
    observation: Observation | None = None
    views: tuple[StoredView | None, ...] = (None,)
    """The images of the observation, and further ones without anything that counts.

    None stands in the place of the photo itself.
    """

    @property
    def seen(self) -> ObservedImage | None:
        """Content of the observation about the photo."""
        given = self.observation
        return None if given is None else given.views[self.views.index(None)]

    @property
    def sigma(self) -> float | None:
        """Stored standard deviation of all keypoints in place of their own [px]."""
        options = {} if self.observation is None else self.observation.fit_options
        # Beside a prior on the stretch it is the annotator's own, from the pairs of that time.
        sigma = None if "stretch_sigma" in options else options.get("sigma")
        return sigma if isinstance(sigma, float) else None

    def priors_or(self, likely: Priors) -> Priors:
        """The priors of `cadalign fit` on the stored pairs; the likely ones before there are any.

        Where no prior on the focal length is stored, `cadalign fit` takes the likely one, too.
        """
        if self.observation is None or not self.document.complete_pairs:
            return likely
        options = self.observation.fit_options
        stored = options.get("focal_prior", likely.focal)
        focal = FocalPrior(**stored) if isinstance(stored, Mapping) else stored
        return Priors(options.get("stretch_sigma"), focal)


@dataclass(eq=False)
class AnnotationFiles:
    """Files of one object; the observation, which names photos and mesh, need not exist yet."""

    observation: Path
    _content: LastContent = field(default_factory=LastContent, init=False, repr=False)

    @property
    def fit(self) -> Path:
        """File of the alignment, the same as `cadalign fit` writes."""
        return self.observation.with_name(f"{self.observation.stem}_fit") / "fit.json"

    def read(self, photo: Path, model: OpenedModel, shape: ObjectShape) -> Stored:
        """Read an earlier session's annotation; new model points are added to the registry."""
        registry, stored = model.registry, Stored()
        self._content.note(self.observation)
        parts = []
        if self.observation.exists():
            observation = self._load()
            refuse_other_model(observation.model, model.path, where=self.observation)
            place = _place_of(photo, observation.views, where=self.observation)
            shown = _document_of(observation.views[place], registry)
            shown = replace(shown, name=observation.object_name or "")
            views: list[StoredView | None] = []
            for seen in observation.views:
                is_there = seen.image is not None and seen.image.exists()
                is_other = is_there and len(views) != place
                own = _document_of(seen, registry) if is_other else None
                views.append(StoredView(seen, own))
            views[place] = None
            stored = Stored(shown, observation, tuple(views))
            self._warn_of_options(stored, shape)
            with in_file(self.observation), within("unfinished"):
                parts.append(convert(observation.unfinished or {}, _Unfinished))
        earlier = self._earlier_unfinished()
        for unfinished in parts if earlier is None else [*parts, earlier]:
            stored = self._with_unfinished(stored, unfinished, registry)
        self._refuse_other_fit()
        return stored

    def write(self, observation: Observation) -> None:
        """Write the observation as a whole; raises DataError on failure.

        Killed at any moment, the file has everything of before or of now. A file that was changed
        by others is refused.
        """
        self._content.refuse_changed(self.observation)
        earlier = self._earlier_unfinished()
        observation.save(self.observation)
        self._content.note(self.observation)
        if earlier is not None:
            _remove(earlier_unfinished_file(self.observation))

    def write_fit(self, result: Result | None) -> None:
        """Write the alignment, or remove its file; raises DataError on failure."""
        if result is None:
            _remove(self.fit)
            return
        with writing(self.fit):
            self.fit.parent.mkdir(exist_ok=True)
        write_json(self.fit, result.to_dict())

    def remove(self) -> None:
        """Remove the files of a deleted object; raises DataError on failure."""
        self._content.refuse_changed(self.observation)
        for path in (self.observation, self.fit):
            _remove(path)
        with suppress(OSError):  # something else is in it
            self.fit.parent.rmdir()

    def _load(self) -> Observation:
        data = read_json(self.observation)
        if isinstance(data, dict) and data.get("keypoints") == [] and "camera" in data:
            # All pairs were deleted: what is left is kept, and unfinished pairs are the model's.
            of_the_object = {name: data.pop(name) for name in _OF_THE_OBJECT if name in data}
            with in_file(self.observation):
                data = {"views": [data], **of_the_object}
                return Observation.from_dict(data, folder=self.observation.parent)
        return Observation.load(self.observation)

    def _earlier_unfinished(self) -> _Unfinished | None:
        """The unfinished pairs in a file of an earlier version; None if there is none."""
        path = earlier_unfinished_file(self.observation)
        if not path.is_file():
            return None
        with suppress(DataError):
            data = read_json(path)
            if isinstance(data, dict) and data.get("format") == _EARLIER_FORMAT:
                with in_file(path):
                    found: _Unfinished = convert(data, _Unfinished)
                return found
        return None

    def _with_unfinished(
        self, stored: Stored, unfinished: _Unfinished, registry: KeypointRegistry
    ) -> Stored:
        """An annotation with what the keypoints of its observation lack."""
        views = list(stored.views)
        further = {
            view.seen.image.resolve(): row
            for row, view in enumerate(views)
            if view is not None and view.document is not None and view.seen.image is not None
        }
        for number, each in enumerate(unfinished.views):
            image = path_from(each.image, self.observation.parent)
            if not image.exists():
                logger.warning(
                    "%s: the photo %s is gone, with its unfinished pairs", self.observation, image
                )
                continue
            with in_file(self.observation), within(f"unfinished.views[{number}]"):
                camera = Camera.from_dict(each.camera)
            new = StoredView(ObservedImage(*_NO_KEYPOINTS, camera, image=image))
            row = further.setdefault(image.resolve(), len(views))
            if row == len(views):
                views.append(new)
            view = views[row] or new
            before = view.document or AnnotationDocument()
            views[row] = replace(view, document=_with_halves(before, each.pairs, registry))
        document = _with_halves(stored.document, unfinished.pairs, registry)
        return replace(stored, document=document, views=tuple(views))

    def _warn_of_options(self, stored: Stored, shape: ObjectShape) -> None:
        """Warn of stored options of the fit that the page does not use."""
        observation = stored.observation
        assert observation is not None
        ours = {"sigma": stored.sigma, "shape_sigma": shape.sigma}
        options = dict(observation.fit_options)
        for name in ("focal_prior", "image"):
            options.pop(name, None)
        if not shape.is_estimated and options.pop("stretch_sigma", None) is not None:
            options.pop("sigma", None)  # the annotator's own
        others = [
            name
            for name, value in options.items()
            if value != ours.get(name) and not (name == "sigma" and not isinstance(value, float))
        ]
        if observation.shape is not None and shape.path is None:
            others.append(f"shape {observation.shape}")
        if others:
            logger.warning(
                "%s: the annotator fits without the stored %s, and replaces the stored options "
                "at the first change; keep a copy of the file if they matter",
                *(self.observation, ", ".join(others)),
            )

    def _refuse_other_fit(self) -> None:
        """Refuse a file in the alignment's place that is something else, before it is replaced."""
        folder = self.fit.parent
        if folder.exists() and not folder.is_dir():
            raise DataError("not a folder", where=str(folder), fix=_RENAME)
        if self.fit.exists():
            data = read_json(self.fit)
            if not isinstance(data, dict) or "alignment" not in data:
                raise DataError("not an alignment of cadalign", where=str(self.fit), fix=_RENAME)


def _place_of(photo: Path, views: Sequence[ObservedImage], *, where: Path) -> int:
    """The number of the view that shows a photo; that of a single view whose photo is gone."""
    named = views[0].image
    if len(views) == 1:
        if named is None or not named.exists() or named.samefile(photo):
            return 0
        raise DataError(
            f"belongs to the photo {named.name}, not {photo.name}",
            where=str(where),
            fix="give another --observation, or correct the field image in this one",
        )
    for number, view in enumerate(views):
        if view.image is not None and view.image.exists() and view.image.samefile(photo):
            return number
    raise DataError(
        f"none of its {len(views)} views has the image {photo.name}",
        where=str(where),
        fix="annotate the image of one of them, or give another --observation",
    )


def _remove(path: Path) -> None:
    with writing(path):
        path.unlink(missing_ok=True)


def written_half(pair: Pair) -> dict[str, Any]:
    """A pair as the observation's field of unfinished ones holds it."""
    fields = {"semantic_id": pair.keypoint, "uv": None if pair.uv is None else list(pair.uv)}
    fields |= {name: getattr(pair, name) for name in ("sigma", "score", "depth")}
    return {name: value for name, value in fields.items() if value is not None}


def _with_halves(
    document: AnnotationDocument, halves: Sequence[_Half], registry: KeypointRegistry
) -> AnnotationDocument:
    """The document with unfinished pairs, of which some are of no use any more."""
    placed = {pair.uv for pair in document.pairs}
    for half in halves:
        keypoint = half.semantic_id
        if half.uv in placed and (keypoint is None or keypoint in document.keypoints):
            continue  # a file of an earlier version, not yet without the pair that was completed
        if keypoint not in registry or keypoint in document.keypoints:
            keypoint = None  # it was saved in another pair, or the keypoints file was deleted
        if half.uv is None and keypoint is None:
            continue
        number = document.next_number
        pair = Pair(number, half.uv, keypoint, half.sigma, half.score, half.depth)
        document = document.append(pair)
    return document


def _document_of(observation: ObservedImage, registry: KeypointRegistry) -> AnnotationDocument:
    document = AnnotationDocument()
    ids, names = observation.ids, observation.names
    columns = (observation.sigma, observation.scores, observation.depths)
    for row, (xyz, uv) in enumerate(
        zip(observation.points_3d.tolist(), observation.points_2d.tolist(), strict=True)
    ):
        number = None if ids is None else int(ids[row])
        point = ModelKeypoint("" if names is None else names[row], tuple(xyz), number)
        keypoint = _registered(point, registry, document.keypoints)
        known = (_entry(values, row) for values in columns)
        document = document.append(Pair(document.next_number, tuple(uv), keypoint, *known))
    return document


def _entry(values: FloatArray | None, row: int) -> float | None:
    return None if values is None or np.isnan(values[row]) else float(values[row])


def _registered(point: ModelKeypoint, registry: KeypointRegistry, taken: frozenset[int]) -> int:
    """Find a point of an observation file in the registry, or add it; returns its id."""
    wanted = point.semantic_id
    if wanted is not None and wanted not in taken and registry.has(point):
        return wanted
    found = registry.find(point.xyz)
    if found is not None and found not in taken:
        return found
    free = wanted is not None and wanted >= 0 and wanted not in registry
    return registry.add(point if free else replace(point, semantic_id=None))
