"""Keypoints of a detector, to be taken or corrected."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from itertools import takewhile
from pathlib import Path

from cadalign.annotate.models import Detected, KeypointRegistry
from cadalign.annotate.photos import PhotoFile
from cadalign.datasets.detections.image_keypoints import ImageKeypoints
from cadalign.datasets.detections.keypoint_files import read_image_keypoints
from cadalign.errors import DataError


def read_detected(
    path: Path, photos: Sequence[PhotoFile], registry: KeypointRegistry
) -> list[tuple[Detected, ...]]:
    """Read COCO's keypoints or a detector's for each photo, by its file name.

    Of photos of one name an image's are those whose folders agree most with its own. Where a photo
    has several objects, the surest counts. Keypoints are found by name, else by their semantic id;
    in a file with neither by their order, if there are as many as the model has.

    Raises DataError if no photo or no keypoint of the model is in the file.
    """
    found = read_image_keypoints(path)
    called = defaultdict[str, list[PhotoFile]](list)
    for photo in photos:
        for name in {photo.path.name, photo.path.stem}:
            called[name].append(photo)
    objects = defaultdict[PhotoFile, list[ImageKeypoints]](list)
    for each in found:
        namesakes = called.get(Path(each.image or "").name, [])
        alike = [_folders_alike(each.image or "", photo.path) for photo in namesakes]
        for photo, count in zip(namesakes, alike, strict=True):
            if count == max(alike):
                objects[photo].append(each)
    by_photo = []
    for photo in photos:
        own = objects[photo] or (list(found) if len(photos) == 1 else [])
        own.sort(key=lambda each: -(each.score or 0.0))
        by_photo.append(_detected(own[0], photo, registry) if own else ())
    if not any(by_photo):
        raise DataError(
            "has no keypoint of the model in any of the photos",
            where=str(path),
            fix="its images and keypoints must be called as the photos and the model's keypoints",
        )
    return by_photo


def _folders_alike(image: str, photo: Path) -> int:
    """Number of the last folders of two paths that are the same."""
    pairs = zip(Path(image).parts[-2::-1], photo.absolute().parts[-2::-1], strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))


def _detected(
    found: ImageKeypoints, photo: PhotoFile, registry: KeypointRegistry
) -> tuple[Detected, ...]:
    by_name = {point.name: number for number, point in registry}
    count = len(found.points_2d)
    wanted: list[int | None]
    if found.names is not None:
        wanted = [by_name.get(name) for name in found.names]
    elif found.ids is not None:
        wanted = [number if number in registry else None for number in found.ids]
    else:
        numbers = sorted(number for number, _ in registry)
        wanted = list(numbers) if len(numbers) == count else [None] * count
    scores = [None] * count if found.scores is None else found.scores.tolist()
    keypoints = []
    for keypoint, (u, v), score in zip(wanted, found.points_2d.tolist(), scores, strict=True):
        inside = -0.5 <= u <= photo.width - 0.5 and -0.5 <= v <= photo.height - 0.5
        if keypoint is not None and inside and score != 0:
            keypoints.append(Detected(keypoint, (u, v)))
    return tuple(keypoints)
