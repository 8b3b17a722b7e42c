"""Files of the annotator: an observation for each object, and the model's keypoints.

Beside the observation `photo.json` there may be

- `photo_fit/fit.json`, the alignment as `cadalign fit` finds and writes it,
- `photo.unfinished.json`, pairs with only one half placed, and those whose keypoint the category's
  shape lacks, so that `cadalign fit` could not use them; and those of the object's further photos.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.annotate.document import AnnotationDocument, Pair, Priors
from cadalign.annotate.further import FurtherEvidence, known_depths
from cadalign.annotate.keypoint_registry import KeypointRegistry
from cadalign.annotate.names import unfinished_file
from cadalign.annotate.object_shape import ObjectShape
from cadalign.annotate.objects.unfinished import (
    RENAME,
    LeftOut,
    StoredView,
    read_unfinished,
    with_halves,
    with_unfinished,
    write_unfinished,
    written_pair,
)
from cadalign.arrays import FloatArray
from cadalign.datasets.models.model_keypoints import ModelKeypoint, ModelKeypoints
from cadalign.errors import DataError
from cadalign.estimation.focal import FocalPrior
from cadalign.estimation.result import Result
from cadalign.geometry.camera import Camera
from cadalign.io.documents import (
    in_file,
    path_from,
    read_json,
    written_path,
)
from cadalign.io.files import write_json, writing
from cadalign.io.observation import Observation
from cadalign.io.observed_image import ObservedImage

logger = logging.getLogger("cadalign")

_OF_THE_OBJECT = (
    "init",
    "model",
    "object",
    "shape",
    "size",
    "symmetry",
    "fit",
)  # fields that are not of one image
SAME_PLACE = 1e-6
"""Largest distance of two points that count as one [diagonals]."""


@dataclass(frozen=True, eq=False)
class Stored:
    """An earlier session's annotation; ``camera`` is None without an observation file."""

    document: AnnotationDocument
    camera: Camera | None
    further: FurtherEvidence
    fit_options: Mapping[str, Any]
    views: tuple[StoredView, ...] = ()

    def priors_or(self, likely: Priors, *, exif: FocalPrior | None) -> Priors:
        """The priors of `cadalign fit` on the stored pairs; the likely ones before there are any.

        ``exif`` is the prior of the photo, which `cadalign fit` takes where none is stored.
        """
        if self.camera is None or not self.document.complete_pairs:
            return likely
        focal = exif
        if "focal_prior" in self.fit_options:
            stored = self.fit_options["focal_prior"]
            focal = None if stored is None else FocalPrior(**stored)
        return Priors(self.fit_options.get("scale_prior_sigma"), focal)


@dataclass(frozen=True)
class AnnotationFiles:
    """Files of one photo; the observation, which names photo and mesh, need not exist yet."""

    observation: Path
    image: Path
    model: Path

    @property
    def unfinished(self) -> Path:
        """File of the pairs that the observation lacks."""
        return unfinished_file(self.observation)

    @property
    def fit(self) -> Path:
        """File of the alignment, the same as `cadalign fit` writes."""
        return self.observation.with_name(f"{self.observation.stem}_fit") / "fit.json"

    @property
    def written(self) -> tuple[Path, ...]:
        """The files whose writers exclude each other."""
        return (self.observation, self.unfinished)

    def read(
        self, registry: KeypointRegistry, diagonal: float, shape: ObjectShape | None = None
    ) -> Stored:
        """Read an earlier session's annotation.

        New model points are added to the registry; ``diagonal`` is that of the model's box.
        """
        document, camera, further = AnnotationDocument(), None, FurtherEvidence()
        fit_options: Mapping[str, Any] = {}
        views: list[StoredView] = []
        if self.observation.exists():
            observation = self._load()
            further = FurtherEvidence.of(observation, self.image, where=self.observation)
            photo = observation.views[further.place]
            camera, fit_options = photo.camera, observation.fit_options
            self._warn_of_options(observation, shape)
            document = _document_of(photo, registry, diagonal)
            document = replace(document, name=observation.object_name or "")
            views = _views_of(further, registry, diagonal)
        if self.unfinished.exists():
            unfinished = read_unfinished(self.unfinished)
            document = with_halves(document, unfinished.pairs, registry)
            views = with_unfinished(views, unfinished.views, self.unfinished, registry)
        self._refuse_other_fit()
        return Stored(document, camera, further, fit_options, tuple(views))

    def image_of(
        self, pairs: Sequence[Pair], registry: KeypointRegistry, camera: Camera
    ) -> ObservedImage:
        """The photo with some complete pairs."""
        keypoints = [pair.keypoint for pair in pairs if pair.keypoint is not None]
        return ObservedImage(
            points_3d=registry.xyz(keypoints),
            points_2d=np.array([pair.uv for pair in pairs], dtype=float).reshape(-1, 2),
            camera=camera,
            sigma=filled(pair.sigma for pair in pairs),
            semantic_ids=np.array(keypoints, dtype=np.int64),
            names=tuple(registry[keypoint].name for keypoint in keypoints),
            confidences=filled(pair.confidence for pair in pairs),
            image=self.image,
            depths=known_depths([pair.depth for pair in pairs]),
        )

    def observation_of(
        self,
        pairs: Sequence[Pair],
        registry: KeypointRegistry,
        camera: Camera,
        fit_options: Mapping[str, Any],
        further: FurtherEvidence,
        shape: ObjectShape | None = None,
        name: str = "",
    ) -> Observation:
        """The observation of some complete pairs, of the object of that name."""
        if shape is not None and shape.sigma is not None:
            fit_options = {**fit_options, "shape_sigma": shape.sigma}
        return further.added_to(
            self.image_of(pairs, registry, camera),
            model=self.model,
            fit_options=fit_options,
            size=further.size,
            shape=None if shape is None else shape.path,
            object_name=name or None,
        )

    def write(
        self,
        document: AnnotationDocument,
        registry: KeypointRegistry,
        camera: Camera,
        fit_options: Mapping[str, Any],
        further: FurtherEvidence,
        shape: ObjectShape | None = None,
        unfinished_views: Sequence[Mapping[str, Any]] = (),
        *,
        unfinished: LeftOut | None = None,
    ) -> LeftOut:
        """Write the photo's observation and other pairs; raises DataError on failure.

        A pair that moves from one file to the other is in both meanwhile: killed at any moment,
        nothing is lost. ``unfinished_views`` are those of `unfinished_view` of the object's further
        photos, ``unfinished`` is what the other file has; returns what it has then.
        """
        used = known_pairs(document, registry, shape)
        observation = self.observation_of(
            used, registry, camera, fit_options, further, shape, document.name
        )
        others = tuple(pair for pair in document.pairs if pair not in used)
        now = LeftOut(others, tuple(unfinished_views))
        before = unfinished or LeftOut()
        now_used = {pair.number for pair in used}
        completed = tuple(pair for pair in before.pairs if pair.number in now_used)
        left = tuple(view for view in before.views if view not in now.views)
        if now.pairs or now.views:
            self._write_unfinished(LeftOut(now.pairs + completed, left + now.views))
        observation.save(self.observation)
        if completed or left or not (now.pairs or now.views):
            self._write_unfinished(now)
        return now

    def _write_unfinished(self, unfinished: LeftOut) -> None:
        if not unfinished.pairs and not unfinished.views:
            with writing(self.unfinished):
                self.unfinished.unlink(missing_ok=True)
            return
        write_unfinished(self.unfinished, unfinished)

    def unfinished_view(
        self,
        document: AnnotationDocument,
        registry: KeypointRegistry,
        camera: Camera,
        shape: ObjectShape | None,
    ) -> dict[str, Any]:
        """A further photo with the pairs that the observation lacks, as written beside it."""
        used = known_pairs(document, registry, shape)
        return {
            "image": written_path(self.image, folder=self.observation.parent),
            "camera": camera.to_dict(pixel_origin="corner"),
            "pairs": [written_pair(pair) for pair in document.pairs if pair not in used],
        }

    def remove(self) -> None:
        """Remove the files of a deleted object; raises DataError on failure."""
        for path in (self.observation, self.unfinished, self.fit):
            with writing(path):
                path.unlink(missing_ok=True)
        with suppress(OSError):  # something else is in it
            self.fit.parent.rmdir()

    def write_fit(self, result: Result | None) -> None:
        """Write the alignment, or remove its file; raises DataError on failure."""
        with writing(self.fit):
            if result is None:
                self.fit.unlink(missing_ok=True)
                return
            self.fit.parent.mkdir(exist_ok=True)
        write_json(self.fit, result.to_dict())

    def _warn_of_options(self, observation: Observation, shape: ObjectShape | None) -> None:
        """Warn of stored options of the fit that the page does not use."""
        ours = {} if shape is None else {"shape_sigma": shape.sigma}
        stored = dict(observation.fit_options)
        stored.pop("focal_prior", None)
        if shape is None:
            # With a prior on the stretch the annotator stores sigma, too.
            prior = stored.pop("scale_prior_sigma", None)
            if prior is not None or not observation.is_plain or stored.get("sigma") is None:
                stored.pop("sigma", None)
        others = [
            name
            for name, value in stored.items()
            if (name != "sigma" or isinstance(value, float)) and value != ours.get(name)
        ]
        if observation.shape is not None and (shape is None or shape.path is None):
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
            raise DataError("not a folder", where=str(folder), fix=RENAME)
        if self.fit.exists():
            data = read_json(self.fit)
            if not isinstance(data, dict) or "alignment" not in data:
                raise DataError("not an alignment of cadalign", where=str(self.fit), fix=RENAME)

    def _load(self) -> Observation:
        data = read_json(self.observation)
        if isinstance(data, dict) and data.get("keypoints") == [] and "camera" in data:
            # All pairs were deleted: what is left is kept, and unfinished pairs are the model's.
            of_the_object = {name: data.pop(name) for name in _OF_THE_OBJECT if name in data}
            with in_file(self.observation):
                data = {"views": [data], **of_the_object}
                observation = Observation.from_dict(data, folder=self.observation.parent)
        else:
            observation = Observation.load(self.observation)
        refuse_other_model(observation.model, self.model, where=self.observation)
        return observation


def known_pairs(
    document: AnnotationDocument, registry: KeypointRegistry, shape: ObjectShape | None
) -> tuple[Pair, ...]:
    """Complete pairs whose keypoints the shape knows; all of them without a shape."""
    return tuple(
        pair
        for pair in document.complete_pairs
        if shape is None or shape.id_of(registry[pair.keypoint or 0]) is not None
    )


def filled(values: Iterable[float | None]) -> FloatArray | None:
    """The values (n,), 1 where one is missing; None if all are missing."""
    listed = list(values)
    if all(value is None for value in listed):
        return None
    return np.array([1.0 if value is None else value for value in listed])


def model_named_in(observation: Path, default: Path) -> Path:
    """The model that an observation names; the default if it names none."""
    data = read_json(observation)
    named = data.get("model") if isinstance(data, dict) else None
    return path_from(named, observation.parent) if isinstance(named, str) else default


def refuse_other_model(named: Path | None, model: Path, *, where: Path) -> None:
    """Refuse a file that names another model than the annotated one; raises DataError."""
    if named is None or named.resolve() == model.resolve():
        return
    # In some datasets all meshes have the same file name and differ by their folders.
    same = named.name == model.name
    other, ours = (named.resolve(), model.resolve()) if same else (named.name, model.name)
    raise DataError(
        f"belongs to the model {other}, not {ours}",
        where=str(where),
        fix="give another --observation or --out",
    )


def write_keypoints(
    path: Path, registry: KeypointRegistry, used: frozenset[int], model: Path
) -> None:
    """Write the given keypoints and those in use; raises DataError on failure."""
    kept = tuple(point for number, point in registry if number in registry.given or number in used)
    ModelKeypoints(kept, model).save(path)


def _document_of(
    observation: ObservedImage, registry: KeypointRegistry, diagonal: float
) -> AnnotationDocument:
    document = AnnotationDocument()
    ids, names = observation.semantic_ids, observation.names
    for row, (xyz, uv) in enumerate(
        zip(observation.points_3d.tolist(), observation.points_2d.tolist(), strict=True)
    ):
        point = ModelKeypoint(
            name="" if names is None else names[row],
            xyz=tuple(xyz),
            semantic_id=None if ids is None else int(ids[row]),
        )
        pair = Pair(
            document.next_number,
            uv=tuple(uv),
            keypoint=_registered(point, registry, SAME_PLACE * diagonal, document.keypoints),
            sigma=_entry(observation.sigma, row),
            confidence=_entry(observation.confidences, row),
            depth=_entry(observation.depths, row),
        )
        document = document.append(pair)
    return document


def _entry(values: FloatArray | None, row: int) -> float | None:
    return None if values is None or np.isnan(values[row]) else float(values[row])


def _registered(
    point: ModelKeypoint, registry: KeypointRegistry, tolerance: float, taken: frozenset[int]
) -> int:
    """Find a point of an observation file in the registry, or add it; returns its id."""
    wanted = point.semantic_id
    if wanted is not None and wanted in registry and wanted not in taken:
        gap = np.linalg.norm(np.subtract(registry[wanted].xyz, point.xyz))
        if gap <= tolerance:
            return wanted
    found = registry.find(point.xyz, tolerance=tolerance)
    if found is not None and found not in taken:
        return found
    free = wanted is not None and wanted >= 0 and wanted not in registry
    return registry.add(point if free else replace(point, semantic_id=None))


def _views_of(
    further: FurtherEvidence, registry: KeypointRegistry, diagonal: float
) -> list[StoredView]:
    """The other images of an observation that are there, so that they can be annotated."""
    return [
        StoredView(view.image, _document_of(view, registry, diagonal), view.camera, view.evidence)
        for view in further.others
        if view.image is not None and view.image.exists()
    ]
