"""Files of the annotator: an observation for each photo, and the model's keypoints.

Beside the observation `photo.json` there may be

- `photo_fit/fit.json`, the alignment as `cadalign fit` finds and writes it,
- `photo.unfinished.json`, pairs with only one half placed, and those whose keypoint the category's
  shape lacks, so that `cadalign fit` could not use them.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.annotate.document import Document, Pair
from cadalign.annotate.keypoint_registry import KeypointRegistry
from cadalign.annotate.names import unfinished_file
from cadalign.annotate.object_shape import ObjectShape
from cadalign.arrays import FloatArray
from cadalign.datasets.models.model_keypoints import ModelKeypoint, ModelKeypoints
from cadalign.errors import DataError, InputError
from cadalign.fitting.joint.result import AlignResult
from cadalign.fitting.result import FitResult
from cadalign.geometry.camera import Camera
from cadalign.io.documents import Document as JsonDocument
from cadalign.io.documents import (
    Labelled,
    NotNegative,
    PathText,
    Point2,
    Positive,
    convert,
    in_file,
    path_from,
    read_json,
)
from cadalign.io.files import write_json, writing
from cadalign.io.observation import Observation

logger = logging.getLogger("cadalign")

_UNFINISHED = "cadalign unfinished pairs"
_RENAME = "rename it: the annotator writes a file of this name"
SAME_PLACE = 1e-6
"""Largest distance of two points that count as one [diagonals]."""


class _Half(Labelled, kw_only=True):
    """Pair with only the photo half or the model half, or both of which are of no use to a fit."""

    uv: Point2 | None = None
    sigma: Positive | None = None
    confidence: NotNegative | None = None

    def __post_init__(self) -> None:
        if self.uv is None and self.semantic_id is None:
            raise InputError("uv and semantic_id are both missing", fix="give one of them")


class _Unfinished(JsonDocument):
    """File of the pairs that the observation lacks."""

    pairs: list[_Half]
    format: str = ""


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

    def read(
        self, registry: KeypointRegistry, diagonal: float, shape: ObjectShape | None = None
    ) -> tuple[Document, Camera | None]:
        """Read an earlier session's annotation.

        New model points are added to the registry; ``diagonal`` is that of the model's box. The
        second value is the observation's camera, if the file exists.
        """
        document, camera = Document(), None
        if self.observation.exists():
            observation = self._load()
            camera = observation.camera
            self._warn_of_options(observation, shape)
            document = _document_of(observation, registry, diagonal)
        if self.unfinished.exists():
            document = _with_halves(document, self.unfinished, registry)
        self._refuse_other_fit()
        return document, camera

    def observation_of(
        self,
        pairs: Sequence[Pair],
        registry: KeypointRegistry,
        camera: Camera,
        fit_options: Mapping[str, Any],
        shape: ObjectShape | None = None,
    ) -> Observation:
        """The observation of some complete pairs."""
        keypoints = [pair.keypoint for pair in pairs if pair.keypoint is not None]
        if shape is not None and shape.sigma is not None:
            fit_options = {**fit_options, "shape_sigma": shape.sigma}
        return Observation(
            points_3d=registry.xyz(keypoints),
            points_2d=np.array([pair.uv for pair in pairs], dtype=float).reshape(-1, 2),
            camera=camera,
            sigma=filled(pair.sigma for pair in pairs),
            semantic_ids=np.array(keypoints, dtype=np.int64),
            names=tuple(registry[keypoint].name for keypoint in keypoints),
            confidences=filled(pair.confidence for pair in pairs),
            image=self.image,
            model=self.model,
            fit_options=fit_options,
            shape=None if shape is None else shape.path,
        )

    def write(
        self,
        document: Document,
        registry: KeypointRegistry,
        camera: Camera,
        fit_options: Mapping[str, Any],
        shape: ObjectShape | None = None,
    ) -> None:
        """Write the photo's observation and other pairs; raises DataError on failure."""
        used = known_pairs(document, registry, shape)
        observation = self.observation_of(used, registry, camera, fit_options, shape)
        observation.save(self.observation)
        others = [_written(pair) for pair in document.pairs if pair not in used]
        if others:
            write_json(self.unfinished, {"format": _UNFINISHED, "pairs": others})
        else:
            with writing(self.unfinished):
                self.unfinished.unlink(missing_ok=True)

    def write_fit(self, result: FitResult | AlignResult | None) -> None:
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
        others = [
            name
            for name, value in observation.fit_options.items()
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
            raise DataError("not a folder", where=str(folder), fix=_RENAME)
        if self.fit.exists():
            data = read_json(self.fit)
            if not isinstance(data, dict) or "alignment" not in data:
                raise DataError("not an alignment of cadalign", where=str(self.fit), fix=_RENAME)

    def _load(self) -> Observation:
        data = read_json(self.observation)
        if isinstance(data, dict) and data.get("keypoints") == [] and "camera" in data:
            # All pairs were deleted; the camera is kept, and unfinished pairs belong to the model.
            with in_file(self.observation):
                camera = Camera.from_dict(data["camera"])
                named: str | None = convert(data.get("model"), PathText | None, where="model")
            model = None if named is None else path_from(named, self.observation.parent)
            observation = Observation(np.empty((0, 3)), np.empty((0, 2)), camera, model=model)
        else:
            observation = Observation.load(self.observation)
        if not observation.is_plain:
            raise DataError(
                "has evidence beyond keypoints in one image, which the annotator would not keep",
                where=str(self.observation),
                fix="give another --observation",
            )
        refuse_other_model(observation.model, self.model, where=self.observation)
        return observation


def known_pairs(
    document: Document, registry: KeypointRegistry, shape: ObjectShape | None
) -> tuple[Pair, ...]:
    """Complete pairs whose keypoints the shape knows; all of them without a shape."""
    return tuple(
        pair
        for pair in document.complete_pairs
        if shape is None or shape.id_of(registry[pair.keypoint or 0]) is not None
    )


def _written(pair: Pair) -> dict[str, Any]:
    """A pair that the observation lacks, as an entry of the other file."""
    fields = {
        "semantic_id": pair.keypoint,
        "uv": None if pair.uv is None else list(pair.uv),
        "sigma": pair.sigma,
        "confidence": pair.confidence,
    }
    return {name: value for name, value in fields.items() if value is not None}


def filled(values: Iterable[float | None]) -> FloatArray | None:
    """The values (n,), 1 where one is missing; None if all are missing."""
    listed = list(values)
    if all(value is None for value in listed):
        return None
    return np.array([1.0 if value is None else value for value in listed])


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


def _document_of(observation: Observation, registry: KeypointRegistry, diagonal: float) -> Document:
    document = Document()
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
        )
        document = document.append(pair)
    return document


def _entry(values: FloatArray | None, row: int) -> float | None:
    return None if values is None else float(values[row])


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


def _with_halves(document: Document, path: Path, registry: KeypointRegistry) -> Document:
    found = read_json(path)
    if isinstance(found, dict) and "pairs" not in found:
        raise DataError(f"not a file of {_UNFINISHED}", where=str(path), fix=_RENAME)
    with in_file(path):
        data: _Unfinished = convert(found, _Unfinished)
    if data.format != _UNFINISHED:
        raise DataError(
            f"not a file of {_UNFINISHED}", where=str(path), fix="delete it to start without them"
        )
    for half in data.pairs:
        keypoint = half.semantic_id
        if keypoint not in registry or keypoint in document.keypoints:
            keypoint = None  # it was saved in another pair, or the keypoints file was deleted
        if half.uv is None and keypoint is None:
            continue
        number = document.next_number
        pair = Pair(number, half.uv, keypoint, sigma=half.sigma, confidence=half.confidence)
        document = document.append(pair)
    return document
