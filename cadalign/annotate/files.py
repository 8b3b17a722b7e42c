"""Files of an annotation: its observation, which holds all that must last, and its alignment.

Beside the observation `photo.json` is `photo_fit/fit.json`, the alignment as `cadalign fit` finds
and writes it. The observation's field ``unfinished`` has what a fit cannot use: pairs with only one
half placed, and those whose keypoint the category's shape lacks.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from cadalign.annotate.document import AnnotationDocument, Pair, Priors
from cadalign.annotate.evidence import MarkedEvidence
from cadalign.annotate.models import (
    KeypointRegistry,
    ObjectShape,
    OpenedModel,
    refuse_other_model,
)
from cadalign.annotate.names import LastContent
from cadalign.arrays import FloatArray
from cadalign.datasets.models.model_keypoints import ModelKeypoint
from cadalign.errors import DataError, InputError
from cadalign.estimation.result import Result
from cadalign.io.documents import Document, Point2, convert, in_file, read_json, within
from cadalign.io.files import write_json, writing
from cadalign.io.focal import FocalPrior
from cadalign.io.observation import Observation
from cadalign.io.observation_file import SeenKeypoint

logger = logging.getLogger("cadalign")

NOTHING = np.empty((0, 3)), np.empty((0, 2))
"""Keypoints of an observation without any: on the model and in the photo."""
_RENAME = "rename it: the annotator writes a file of this name"
_OTHER_FILE = "give another --observation or --out"
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


class _Unfinished(Document):
    pairs: list[_Half] = msgspec.field(default_factory=list)


@dataclass(eq=False)
class AnnotationFiles:
    """Files of one annotation; the observation need not exist yet."""

    observation: Path
    _content: LastContent = field(default_factory=LastContent, init=False, repr=False)

    @property
    def fit(self) -> Path:
        """File of the alignment, the same as `cadalign fit` writes."""
        return self.observation.with_name(f"{self.observation.stem}_fit") / "fit.json"

    def read(
        self, photo: Path, model: OpenedModel, shape: ObjectShape
    ) -> tuple[Observation | None, AnnotationDocument]:
        """Read an earlier session's observation, None without one, and its marks.

        New model points are added to the registry. The document lacks focal length and priors.
        """
        self._content.note(self.observation)
        self._refuse_other_fit()
        if not self.observation.exists():
            return None, AnnotationDocument()
        observation = self._load()
        refuse_other_model(observation.model, model.path, where=self.observation)
        self._refuse_other_photos(observation, photo)
        self._warn_of_options(observation, shape)
        with in_file(self.observation), within("unfinished"):
            unfinished = convert(observation.unfinished or {}, _Unfinished)
        document = _with_pairs(AnnotationDocument(), observation, model.registry)
        document = _with_halves(document, unfinished.pairs, model.registry)
        return observation, replace(document, evidence=MarkedEvidence.of(observation))

    def write(self, observation: Observation) -> None:
        """Write the observation as a whole; raises DataError on failure.

        Killed at any moment, the file has everything of before or of now. A file that was changed
        by others is refused.
        """
        self._content.refuse_changed(self.observation)
        observation.save(self.observation)
        self._content.note(self.observation)

    def write_fit(self, result: Result | None) -> None:
        """Write the alignment, or remove its file; raises DataError on failure."""
        with writing(self.fit):
            if result is None:
                self.fit.unlink(missing_ok=True)
                return
            self.fit.parent.mkdir(exist_ok=True)
        write_json(self.fit, result.to_dict())

    def _load(self) -> Observation:
        data = read_json(self.observation)
        if isinstance(data, dict) and data.get("keypoints") == [] and "camera" in data:
            # All pairs were deleted: what is left is kept, and unfinished pairs are the model's.
            of_the_object = {name: data.pop(name) for name in _OF_THE_OBJECT if name in data}
            with in_file(self.observation):
                data = {"views": [data], **of_the_object}
                return Observation.from_dict(data, folder=self.observation.parent)
        return Observation.load(self.observation)

    def _refuse_other_photos(self, observation: Observation, photo: Path) -> None:
        """Refuse an observation of another photo, or of several; one that is gone was renamed."""
        where, named = str(self.observation), observation.image
        if observation.others:
            what = f"has {len(observation.views)} views, the annotator opens files of one photo"
            raise DataError(what, where=where, fix=_OTHER_FILE)
        if named is not None and named.exists() and not named.samefile(photo):
            raise DataError(
                f"belongs to the photo {named.name}, not {photo.name}",
                where=where,
                fix="give another --observation, or correct the field image in this one",
            )

    def _warn_of_options(self, observation: Observation, shape: ObjectShape) -> None:
        """Warn of stored options of the fit that the page does not use."""
        options = dict(observation.fit_options)
        for name in ("focal_prior", "image"):
            options.pop(name, None)
        if not shape.is_estimated and options.pop("stretch_sigma", None) is not None:
            options.pop("sigma", None)  # the annotator's own
        ours = {"sigma": stored_sigma(observation), "shape_sigma": shape.sigma}
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


def stored_sigma(observation: Observation) -> float | None:
    """Stored standard deviation of all keypoints in place of their own [px]."""
    options = observation.fit_options
    # Beside a prior on the stretch it is the annotator's own, from the pairs of that time.
    sigma = None if "stretch_sigma" in options else options.get("sigma")
    return sigma if isinstance(sigma, float) else None


def stored_priors(observation: Observation, likely: Priors) -> Priors:
    """The priors of `cadalign fit` on stored pairs; the likely ones before there are any.

    Where no prior on the focal length is stored, `cadalign fit` takes the likely one, too.
    """
    if not len(observation.points_2d):
        return likely
    options = observation.fit_options
    stored = options.get("focal_prior", likely.focal)
    focal = FocalPrior(**stored) if isinstance(stored, Mapping) else stored
    return Priors(options.get("stretch_sigma"), focal)


def written_half(pair: Pair) -> dict[str, Any]:
    """A pair as the observation's field of unfinished ones holds it."""
    fields = {"semantic_id": pair.keypoint, "uv": None if pair.uv is None else list(pair.uv)}
    fields |= {name: getattr(pair, name) for name in ("sigma", "score", "depth")}
    return {name: value for name, value in fields.items() if value is not None}


def _with_halves(
    document: AnnotationDocument, halves: Sequence[_Half], registry: KeypointRegistry
) -> AnnotationDocument:
    """The document with unfinished pairs, of which some are of no use any more."""
    for half in halves:
        keypoint = half.semantic_id
        if keypoint not in registry or keypoint in document.keypoints:
            keypoint = None  # the keypoints file was deleted
        if half.uv is None and keypoint is None:
            continue
        number = document.next_number
        pair = Pair(number, half.uv, keypoint, half.sigma, half.score, half.depth)
        document = document.append(pair)
    return document


def _with_pairs(
    document: AnnotationDocument, observation: Observation, registry: KeypointRegistry
) -> AnnotationDocument:
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
