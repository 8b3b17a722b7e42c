"""Keypoints of a detector, proposed to confirm or correct."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cadalign.annotate.keypoint_registry import KeypointRegistry
from cadalign.annotate.photos import PhotoFile
from cadalign.datasets.detections.image_keypoints import ImageKeypoints
from cadalign.datasets.detections.keypoint_files import read_image_keypoints
from cadalign.errors import DataError


@dataclass(frozen=True)
class Proposal:
    """A keypoint of the model, where a detector has found it [px], and how sure it is."""

    keypoint: int
    uv: tuple[float, float]
    score: float | None = None


def read_proposals(
    path: Path, photos: Sequence[PhotoFile], registry: KeypointRegistry
) -> list[tuple[Proposal, ...]]:
    """Read COCO's keypoints or a detector's for each photo, by its file name.

    Of several objects in a photo the surest counts. Keypoints are found by name, else by semantic
    id; those of a file with neither by their order, if there are as many as the model has. Raises
    DataError if no photo or no keypoint of the model is in the file.
    """
    found = read_image_keypoints(path)
    by_photo = []
    for photo in photos:
        names = (photo.path.name, photo.path.stem)
        own = [each for each in found if each.image and Path(each.image).name in names]
        if not own and len(photos) == 1:
            own = found
        own.sort(key=lambda each: -(each.score or 0.0))
        by_photo.append(_proposals(own[0], photo, registry) if own else ())
    if not any(by_photo):
        raise DataError(
            "has no keypoint of the model in any of the photos",
            where=str(path),
            fix="its images and keypoints must be called as the photos and the model's keypoints",
        )
    return by_photo


def _proposals(
    found: ImageKeypoints, photo: PhotoFile, registry: KeypointRegistry
) -> tuple[Proposal, ...]:
    by_name = {point.name: number for number, point in registry}
    count = len(found.points_2d)
    wanted: list[int | None]
    if found.names is not None:
        wanted = [by_name.get(name) for name in found.names]
    elif found.semantic_ids is not None:
        wanted = [number if number in registry else None for number in found.semantic_ids]
    else:
        numbers = sorted(number for number, _ in registry)
        wanted = list(numbers) if len(numbers) == count else [None] * count
    scores = [None] * count if found.scores is None else found.scores.tolist()
    proposals = []
    for keypoint, (u, v), score in zip(wanted, found.points_2d.tolist(), scores, strict=True):
        inside = -0.5 <= u <= photo.width - 0.5 and -0.5 <= v <= photo.height - 0.5
        if keypoint is not None and inside and score != 0:
            proposals.append(Proposal(keypoint, (u, v), score))
    return tuple(proposals)
