"""KITTI: cars in street photos, with boxes in space, and keypoints where there are files of them.

Geiger et al., "Are we ready for Autonomous Driving? The KITTI Vision Benchmark Suite", CVPR 2012.
"""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.photos.dataset import PhotoDataset, PhotoFormat, has, leaving_out, read_each
from cadalign.datasets.photos.kitti_keypoints import (
    CARS,
    SIZE,
    TRACKS,
    UP,
    KeypointFrame,
    car_box,
    list_cars,
    list_tracks,
)
from cadalign.datasets.photos.photo import Photo, PhotoObject, Truth, existing
from cadalign.errors import DataError, InputError, quote
from cadalign.geometry.alignment import Box
from cadalign.geometry.camera import Camera
from cadalign.io.documents import in_file
from cadalign.io.files import as_path, damaged, listed, read_text
from cadalign.io.images import photo_size

_OBJECT, _TRACKING = ("label_2", "image_2"), ("label_02", "image_02")
_LAYOUTS = (_OBJECT, _TRACKING)
# The numbers after an object's type: truncated, occluded, alpha, bbox 4, dimensions h w l,
# location 3, rotation_y; a detector's score may follow.
_NUMBERS = 14
# The car's frame from a model whose y is up: left is -x, rear z, up y.
_CAR_FROM_Y_UP = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
_MOST_TILT = 10.0  # of a written model's up from the camera's [degrees]


@dataclass(frozen=True, eq=False)
class KittiLabel:
    """One line of a label file."""

    kind: str  # the object's type, such as "Car"
    numbers: FloatArray  # (14,), what follows the type
    object_id: str  # the tracking benchmark's second column; elsewhere the line's number from 0
    frame: int = 0  # the tracking benchmark's first column

    @property
    def flags(self) -> frozenset[str]:
        """Some of "truncated" and "occluded"."""
        found = {"truncated": self.numbers[0] > 0, "occluded": self.numbers[1] > 0}
        return frozenset(name for name, is_set in found.items() if is_set)

    @property
    def bbox(self) -> FloatArray:
        """Left, top, right and bottom [px], (4,) float."""
        return self.numbers[3:7]

    def box(self, shift: FloatArray) -> Box:
        """The object's box in the frame of a camera that lies ``shift`` off the reference."""
        height, width, length, x, y, z, rotation_y = self.numbers[7:14]
        dims = np.array([height, width, length])
        return car_box(dims, np.array([x, y, z]) + shift, float(rotation_y))


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
        cars.json, car_tracks.json          see docs/formats/photo_files.md

    The truth is the box: its axes are the car's (x to its left, y to its rear, z up), its extents
    width, length and height, in metres. Boxes are in the frame of the left colour camera: the
    offset in P2 is added to the labels' locations. Where a calibration file is missing, so are the
    camera and the offset.

    ``categories`` are KITTI's types to take of the labels. Raises DataError if there is none of
    these files, or none can be read.
    """

    kind = "KITTI"
    patterns = (
        *("*.json", "label_*/*.txt", "calib/*.txt"),
        *("training/label_*/*.txt", "training/calib/*.txt"),
    )

    def __init__(
        self, root: str | os.PathLike[str], *, categories: Iterable[str] = ("Car",)
    ) -> None:
        folder = as_path(root, "root")
        self._categories = frozenset([categories] if isinstance(categories, str) else categories)
        bad: dict[str, DataError] = {}
        self._frames = list(_list_frames(folder, bad))
        if not self._frames and not bad:
            fix = f"give a folder of {_OBJECT[0]}, {_TRACKING[0]}, {CARS} or {TRACKS}"
            raise DataError("no KITTI labels are here", where=str(folder), fix=fix)
        super().__init__(folder, [frame.name for frame in self._frames], bad)

    def read(self, index: int) -> Photo:
        """Read the photo of a number from 0."""
        frame = self._frames[index]
        if isinstance(frame, KeypointFrame):
            return frame.photo()
        image = existing(frame.image)
        camera, shift = None, np.zeros(3)
        if frame.calibration.is_file():
            size = SIZE if image is None else photo_size(image)
            camera, shift = read_projection(frame.calibration, size)

        def read_object(_: int, label: KittiLabel) -> PhotoObject | None:
            if label.kind not in self._categories:
                return None
            return PhotoObject(
                object_id=label.object_id,
                category=label.kind,
                truth=Truth(box=label.box(shift), metres=1.0),
                bbox=label.bbox,
                flags=label.flags,
            )

        bad: dict[str, DataError] = {}
        if frame.frame is None:
            labels = read_labels(frame.labels, tracking=False, problems=bad)
        else:
            by_frame = self._read_once(frame.labels, partial(_by_frame, problems={}))
            labels = by_frame.get(frame.frame, [])
        objects, problems = read_each(labels, read_object, where=str(frame.labels))
        problems = (*bad.values(), *problems)
        return Photo(frame.name, image, camera, objects, up=UP, problems=problems)


def _list_frames(
    root: Path, problems: dict[str, DataError]
) -> Iterator[KeypointFrame | _LabelFrame]:
    """List the photos of all layouts; ``problems`` gets the reasons why others cannot be read."""
    for name, list_them in ((CARS, list_cars), (TRACKS, list_tracks)):
        if (root / name).is_file():
            with leaving_out(str(root / name), problems):
                yield from list_them(root / name, problems)
    for (labels, images), place in product(_LAYOUTS, (root, root / "training")):
        for path in listed(place / labels, "*.txt"):
            image, calibration = place / images, place / "calib" / path.name
            if labels == _OBJECT[0]:
                yield _LabelFrame(path.stem, path, image / f"{path.stem}.png", calibration)
                continue
            frames: Iterable[int] = ()
            with leaving_out(str(path), problems):
                frames = _by_frame(path, problems)
            for frame in sorted(frames):
                name = f"{path.stem}/{frame:06d}"
                yield _LabelFrame(name, path, image / f"{name}.png", calibration, frame)


def _by_frame(path: Path, problems: dict[str, DataError]) -> dict[int, list[KittiLabel]]:
    """Labels of a sequence by frame."""
    found: dict[int, list[KittiLabel]] = defaultdict(list)
    for label in read_labels(path, tracking=True, problems=problems):
        found[label.frame].append(label)
    return found


def read_labels(
    path: Path, *, tracking: bool, problems: dict[str, DataError] | None = None
) -> list[KittiLabel]:
    """Read a label file; for ``tracking``, frame and track come before the type.

    ``problems`` gets the reasons why lines cannot be read, by their places; without it, the first
    is raised. Raises DataError if the file cannot be read.
    """
    lines = enumerate(read_text(path).splitlines(), start=1)
    found: list[KittiLabel] = []
    for row, (number, line) in enumerate(each for each in lines if each[1].strip()):
        place = f"{path}, line {number}"
        with leaving_out(place, problems), in_file(place):
            found.append(_label(line.split(), row, tracking=tracking))
    return found


def _label(fields: list[str], row: int, *, tracking: bool) -> KittiLabel:
    skipped = 2 if tracking else 0
    if len(fields) not in (skipped + 1 + _NUMBERS, skipped + 2 + _NUMBERS):
        raise InputError(f"{len(fields)} columns, expected {skipped + 1 + _NUMBERS}")
    try:
        numbers = np.array(fields[skipped + 1 : skipped + 1 + _NUMBERS], dtype=np.float64)
        frame, object_id = map(int, fields[:2]) if tracking else (0, row)
    except ValueError:
        raise InputError(f"{quote(' '.join(fields))} are not a label's numbers") from None
    if not np.isfinite(numbers).all():
        raise InputError("some of its numbers are not finite")
    return KittiLabel(fields[skipped], numbers, str(object_id), frame)


def read_projection(path: Path, size: tuple[int, int]) -> tuple[Camera, FloatArray]:
    """Read the left colour camera from a calibration file's matrix P2, and its shift (3,) [m].

    The shift is added to the reference camera's coordinates, in which locations are given, to get
    this camera's. Raises DataError if the file cannot be read, or holds no valid P2.
    """
    lines = (line.partition(" ") for line in read_text(path).splitlines())
    found = next((rest for name, _, rest in lines if name.rstrip(":") == "P2"), None)
    if found is None:
        raise damaged("there is no line P2", path)
    try:
        matrix = np.array(found.split(), dtype=np.float64).reshape(3, 4)
    except ValueError:
        raise damaged("P2 is not a 3 x 4 matrix", path) from None
    k = matrix[:, :3]
    with in_file(f"{path}: P2"):
        camera = Camera(*size, k[0, 0], k[1, 1], k[0, 2], k[1, 2])
    try:
        return camera, np.asarray(np.linalg.solve(k, matrix[:, 3]))
    except np.linalg.LinAlgError:
        raise damaged("P2 is not the matrix of a camera", path) from None


FORMAT = PhotoFormat(
    f"KITTI: {_OBJECT[0]}, {_TRACKING[0]}, {CARS} or {TRACKS}",
    has(CARS, TRACKS, *(f"{place}{kind}" for place in ("", "training/") for kind, _ in _LAYOUTS)),
    KittiCars,
)
