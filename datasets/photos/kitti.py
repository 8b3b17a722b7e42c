"""KITTI: cars in street photos, with boxes in space, and keypoints where there are files of them.

Geiger et al., "Are we ready for Autonomous Driving? The KITTI Vision Benchmark Suite", CVPR 2012.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.photos.dataset import PhotoDataset, read_each
from cadalign.datasets.photos.kitti_files import KittiLabel, read_labels, read_projection
from cadalign.datasets.photos.kitti_keypoints import (
    CARS,
    TRACKS,
    UP,
    KeypointFrame,
    list_cars,
    list_tracks,
)
from cadalign.datasets.photos.photo import Photo, PhotoObject, Truth, existing
from cadalign.errors import DataError
from cadalign.geometry.camera import Camera
from cadalign.io.images import photo_size

SIZE = (1242, 375)
"""The size of most of KITTI's photos, taken where the photo itself is not there [px]."""
_OBJECT, _TRACKING = ("label_2", "image_2"), ("label_02", "image_02")
_PLACES = (".", "training")


@dataclass(frozen=True)
class _LabelFrame:
    """The place of one photo's labels: a file, or one frame of a sequence's file."""

    name: str
    labels: Path
    image: Path
    calibration: Path
    frame: int | None = None


class KittiCars(PhotoDataset):
    """Street photos with cars.

    Read are KITTI's labels in the layouts of the object and of the tracking benchmark, below
    ``root`` or ``root/training``, and files of keypoints::

        label_2/000000.txt      image_2/000000.png             calib/000000.txt
        label_02/0000.txt       image_02/0000/000000.png       calib/0000.txt
        cars.json, car_tracks.json          see `cadalign.datasets.photos.kitti_keypoints`

    The truth is the box: its axes are the car's (x to its left, y to its rear, z up), its extents
    width, length and height, in metres. Boxes are in the frame of the left colour camera: the
    offset in P2 is added to the labels' locations. Where a calibration file is missing, so are the
    camera and the offset.

    Parameters
    ----------
    root : str or path-like
        The folder.
    categories : iterable of str
        KITTI's types to take.

    Raises
    ------
    DataError
        If there is none of these files, or none can be read.
    """

    kind = "KITTI"

    def __init__(
        self, root: str | os.PathLike[str], *, categories: Iterable[str] = ("Car",)
    ) -> None:
        folder = Path(root)
        self._categories = frozenset(categories)
        self._frames: list[KeypointFrame | _LabelFrame] = []
        bad: dict[str, DataError] = {}
        for list_them in (_list_keypoints, _list_object_labels, _list_tracking_labels):
            for found in list_them(folder):
                if isinstance(found, DataError):
                    bad[str(found.where)] = found
                else:
                    self._frames.append(found)
        if not self._frames:
            raise next(iter(bad.values()), None) or DataError(
                "no KITTI labels are here",
                where=str(folder),
                fix=f"give a folder of {_OBJECT[0]}, {_TRACKING[0]}, {CARS} or {TRACKS}",
            )
        super().__init__(folder, [frame.name for frame in self._frames])
        self.problems |= bad
        self._sequence: tuple[Path, dict[int, list[KittiLabel | DataError]]] | None = None

    def read(self, index: int) -> Photo:
        """Read the photo of a number from 0."""
        frame = self._frames[index]
        if isinstance(frame, KeypointFrame):
            return frame.photo(SIZE)
        image = existing(frame.image)
        camera: Camera | None = None
        shift = np.zeros(3)
        problems: tuple[DataError, ...] = ()
        if frame.calibration.is_file():
            size = SIZE if image is None else photo_size(image)
            camera, shift = read_projection(frame.calibration, size)

        def read_object(number: int, label: KittiLabel | DataError) -> PhotoObject | None:
            if isinstance(label, DataError):
                raise label
            return self._object(number, label, shift)

        objects, problems = read_each(self._labels(frame), read_object, where=str(frame.labels))
        return Photo(frame.name, image, camera, objects, up=UP, problems=problems)

    def _labels(self, frame: _LabelFrame) -> list[KittiLabel | DataError]:
        if frame.frame is None:
            return read_labels(frame.labels, tracking=False)
        if self._sequence is None or self._sequence[0] != frame.labels:
            self._sequence = frame.labels, _by_frame(read_labels(frame.labels, tracking=True))
        return self._sequence[1].get(frame.frame, [])

    def _object(self, number: int, label: KittiLabel, shift: FloatArray) -> PhotoObject | None:
        if label.kind not in self._categories:
            return None
        return PhotoObject(
            object_id=str(number if label.track is None else label.track),
            category=label.kind,
            truth=Truth(box=label.box(shift), metres=1.0),
            bbox=label.bbox,
            flags=label.flags,
        )


def _list_keypoints(root: Path) -> Iterator[KeypointFrame | DataError]:
    for name, list_them in ((CARS, list_cars), (TRACKS, list_tracks)):
        if (root / name).is_file():
            yield from list_them(root / name)


def _list_object_labels(root: Path) -> Iterator[_LabelFrame]:
    labels, images = _OBJECT
    for place in _PLACES:
        for path in sorted((root / place / labels).glob("*.txt")):
            image = root / place / images / f"{path.stem}.png"
            yield _LabelFrame(path.stem, path, image, root / place / "calib" / path.name)


def _list_tracking_labels(root: Path) -> Iterator[_LabelFrame | DataError]:
    labels, images = _TRACKING
    for place in _PLACES:
        for path in sorted((root / place / labels).glob("*.txt")):
            try:
                found = _by_frame(read_labels(path, tracking=True))
            except DataError as error:
                yield error
                continue
            yield from (each for each in found.get(_NO_FRAME, []) if isinstance(each, DataError))
            for frame in sorted(set(found) - {_NO_FRAME}):
                name = f"{frame:06d}"
                image = root / place / images / path.stem / f"{name}.png"
                calibration = root / place / "calib" / path.name
                yield _LabelFrame(f"{path.stem}/{name}", path, image, calibration, frame)


_NO_FRAME = -1


def _by_frame(
    labels: Iterable[KittiLabel | DataError],
) -> dict[int, list[KittiLabel | DataError]]:
    """A sequence's labels by frame; lines that could not be read are those of frame -1."""
    found: dict[int, list[KittiLabel | DataError]] = {}
    for label in labels:
        is_read = isinstance(label, KittiLabel) and label.frame is not None
        frame = label.frame if is_read and isinstance(label, KittiLabel) else _NO_FRAME
        found.setdefault(_NO_FRAME if frame is None else frame, []).append(label)
    return found
