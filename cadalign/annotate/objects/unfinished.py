"""File of what an observation lacks: unfinished pairs, and further photos without pairs."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec

from cadalign.annotate.document import AnnotationDocument, Pair
from cadalign.annotate.keypoint_registry import KeypointRegistry
from cadalign.errors import DataError, InputError
from cadalign.geometry.camera import Camera
from cadalign.io.documents import (
    Document,
    Labelled,
    NotNegative,
    PathText,
    Point2,
    Positive,
    convert,
    in_file,
    path_from,
    read_json,
    within,
)
from cadalign.io.evidence import ImageEvidence
from cadalign.io.files import write_json

logger = logging.getLogger("cadalign")

UNFINISHED = "cadalign unfinished pairs"
"""Format that the file states."""
RENAME = "rename it: the annotator writes a file of this name"
"""What to do about another file of its name."""


class Half(Labelled, kw_only=True):
    """Pair with only the photo half or the model half, or both of which are of no use to a fit."""

    uv: Point2 | None = None
    sigma: Positive | None = None
    confidence: NotNegative | None = None
    depth: Positive | None = None

    def __post_init__(self) -> None:
        if self.uv is None and self.semantic_id is None:
            raise InputError("uv and semantic_id are both missing", fix="give one of them")


class UnfinishedView(Document):
    """The pairs of a further photo that the observation lacks, or the photo without any."""

    image: PathText
    camera: Any  # in the form of `Camera.from_dict`
    pairs: list[Half] = msgspec.field(default_factory=list)


class Unfinished(Document):
    """File of the pairs that the observation lacks."""

    pairs: list[Half]
    format: str = ""
    views: list[UnfinishedView] = msgspec.field(default_factory=list)


@dataclass(frozen=True)
class LeftOut:
    """Contents of such a file: pairs, and further photos as they are written."""

    pairs: tuple[Pair, ...] = ()
    views: tuple[Mapping[str, Any], ...] = ()


@dataclass(frozen=True, eq=False)
class StoredView:
    """A further photo of an earlier session's annotation."""

    image: Path
    document: AnnotationDocument
    camera: Camera
    evidence: ImageEvidence


def written_pair(pair: Pair) -> dict[str, Any]:
    """A pair as an entry of the file."""
    fields = {
        "semantic_id": pair.keypoint,
        "uv": None if pair.uv is None else list(pair.uv),
        "sigma": pair.sigma,
        "confidence": pair.confidence,
        "depth": pair.depth,
    }
    return {name: value for name, value in fields.items() if value is not None}


def write_unfinished(path: Path, left_out: LeftOut) -> None:
    """Write the file; raises DataError on failure."""
    pairs = [written_pair(pair) for pair in left_out.pairs]
    data: dict[str, Any] = {"format": UNFINISHED, "pairs": pairs}
    if left_out.views:
        data["views"] = list(left_out.views)
    write_json(path, data)


def read_unfinished(path: Path) -> Unfinished:
    """Read the file; raises DataError if it is another one."""
    found = read_json(path)
    if isinstance(found, dict) and "pairs" not in found:
        raise DataError(f"not a file of {UNFINISHED}", where=str(path), fix=RENAME)
    with in_file(path):
        data: Unfinished = convert(found, Unfinished)
    if data.format != UNFINISHED:
        raise DataError(
            f"not a file of {UNFINISHED}", where=str(path), fix="delete it to start without them"
        )
    return data


def with_unfinished(
    views: Sequence[StoredView],
    unfinished: Sequence[UnfinishedView],
    path: Path,
    registry: KeypointRegistry,
) -> list[StoredView]:
    """The further photos with the pairs beside the observation, and those that it lacks."""
    known = {view.image.resolve(): view for view in views}
    for number, each in enumerate(unfinished):
        image = path_from(each.image, path.parent)
        if not image.exists():
            logger.warning("%s: the photo %s is gone, with its unfinished pairs", path, image)
            continue
        with in_file(path), within(f"views[{number}]"):
            camera = Camera.from_dict(each.camera)
        view = known.get(
            image.resolve(), StoredView(image, AnnotationDocument(), camera, ImageEvidence())
        )
        document = with_halves(view.document, each.pairs, registry)
        known[image.resolve()] = replace(view, document=document)
    return list(known.values())


def with_halves(
    document: AnnotationDocument, halves: Sequence[Half], registry: KeypointRegistry
) -> AnnotationDocument:
    """The document with pairs of such a file, of which some are of no use any more."""
    placed = {pair.uv for pair in document.pairs}
    for half in halves:
        keypoint = half.semantic_id
        if half.uv in placed and (keypoint is None or keypoint in document.keypoints):
            continue  # the file was written, but not yet without the pair that was completed
        if keypoint not in registry or keypoint in document.keypoints:
            keypoint = None  # it was saved in another pair, or the keypoints file was deleted
        if half.uv is None and keypoint is None:
            continue
        number = document.next_number
        pair = Pair(number, half.uv, keypoint, half.sigma, half.confidence, half.depth)
        document = document.append(pair)
    return document
