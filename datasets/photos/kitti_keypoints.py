"""Files of cars' keypoints in KITTI's photos, as keypoint networks and their papers write them.

``cars.json`` is a list of cars, each with its photo, which is listed once for each car in it::

    [{"image": "2_98.png", "K": 3 x 3, "bbox": [left, top, right, bottom],
      "dims_hwl": [h, w, l], "location_bottom_centre": [x, y, z], "rotation_y": -1.5,
      "keypoints": [{"name": "front wheel left", "xyz": [...], "uv": [...], "score": 0.6}]}]

``car_tracks.json`` holds cars that are followed through a sequence, without photos::

    {"names": [...], "model_xyz": k x 3,
     "tracks": [{"sequence": 10, "track": 0, "K": 3 x 3, "dims_hwl": [h, w, l],
                 "frames": [{"frame": 0, "bbox": [...], "location_bottom_centre": [...],
                             "rotation_y": -1.7, "uv": k x 2, "score": [...]}]}]}

``xyz`` is the keypoint on the model: x to the car's left, y to its rear, z up [m].
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Raw

from cadalign.arrays import FloatArray, read_only
from cadalign.datasets.photos.kitti_files import car_box
from cadalign.datasets.photos.photo import (
    CadModel,
    ModelFiles,
    NamedPoints,
    Photo,
    PhotoKeypoints,
    PhotoObject,
    Truth,
    existing,
)
from cadalign.datasets.photos.records import parse, read_list, read_table
from cadalign.errors import DataError, InputError
from cadalign.geometry.camera import Camera
from cadalign.io.documents import (
    Finite,
    ForeignDocument,
    PathText,
    Point2,
    Point3,
    Positive,
    Text,
    convert,
    in_file,
    within,
)
from cadalign.io.images import photo_size

CARS = "cars.json"
TRACKS = "car_tracks.json"
HIDDEN = 0.1
"""Scores below this are those of keypoints that something hides."""
UP = read_only(np.array([0.0, -1.0, 0.0]))
"""KITTI's cameras are level, and so are the boxes of its labels."""
_MEAN_CAR = np.array([1.63, 3.88, 1.53])  # width, length and height of cars in KITTI [m]
_Matrix = tuple[Point3, Point3, Point3]
_Dims = tuple[Positive, Positive, Positive]
_Four = tuple[Finite, Finite, Finite, Finite]


class _Keypoint(ForeignDocument):
    name: Text
    xyz: Point3
    uv: Point2
    score: Finite | None = None


class _Pose(ForeignDocument, kw_only=True):
    bbox: _Four
    location_bottom_centre: Point3
    rotation_y: Finite


class _Car(_Pose, kw_only=True):
    image: PathText
    K: _Matrix
    dims_hwl: _Dims
    keypoints: list[_Keypoint]


class _Frame(_Pose, kw_only=True):
    frame: int
    uv: list[Point2]
    score: list[Finite] | None = None


class _Track(ForeignDocument):
    sequence: int
    track: int
    K: _Matrix
    dims_hwl: _Dims
    frames: list[Any]


class MeanCar(ForeignDocument):
    """The mean car: names and places of its keypoints [m]."""

    names: list[Text]
    model_xyz: list[Point3]

    def __post_init__(self) -> None:
        if len(self.names) != len(self.model_xyz):
            what = f"{len(self.model_xyz)} points, but {len(self.names)} names"
            raise InputError(what, where="model_xyz")


@dataclass(frozen=True, eq=False)
class KeypointFrame:
    """One car in one photo, not yet checked.

    Parameters
    ----------
    name : str
        The photo's name.
    path : Path
        The file.
    place : str
        The entry's place in it, for messages.
    entry : Raw or Any
        The entry.
    model, track : optional
        What ``car_tracks.json`` says of all frames, and of the frames of one car.
    """

    name: str
    path: Path
    place: str
    entry: Any
    model: MeanCar | None = None
    track: _Track | None = None

    def photo(self, size: tuple[int, int]) -> Photo:
        """Read the entry; ``size`` is that of photos that are not there.

        Raises
        ------
        DataError
            If the entry is bad.
        """
        with in_file(self.path), within(self.place):
            if self.track is None or self.model is None:
                return self._photo_of_car(convert(self.entry, _Car), size)
            frame = convert(self.entry, _Frame)
            return self._photo_of_track(frame, self.model, self.track, size)

    def _photo_of_car(self, car: _Car, size: tuple[int, int]) -> Photo:
        names = tuple(each.name for each in car.keypoints)
        if len(set(names)) != len(names):
            raise InputError("a name occurs twice", where="keypoints")
        points = NamedPoints(names, np.array([each.xyz for each in car.keypoints]).reshape(-1, 3))
        pixels = np.array([each.uv for each in car.keypoints], dtype=float).reshape(-1, 2)
        scores = [each.score for each in car.keypoints if each.score is not None]
        image = existing(self.path.parent / car.image)
        camera = _camera(car.K, size if image is None else photo_size(image))
        marked = _marked(pixels, names, scores or None)
        found = _object("0", car, np.array(car.dims_hwl), points, marked)
        return Photo(self.name, image, camera, (found,), up=UP)

    def _photo_of_track(
        self, frame: _Frame, model: MeanCar, track: _Track, size: tuple[int, int]
    ) -> Photo:
        names = tuple(model.names)
        points = NamedPoints(names, np.array(model.model_xyz).reshape(-1, 3))
        marked = _marked(np.array(frame.uv, dtype=float).reshape(-1, 2), names, frame.score)
        dims = np.array(track.dims_hwl)
        found = _object(str(track.track), frame, dims, points, marked)
        return Photo(self.name, None, _camera(track.K, size), (found,), up=UP)


def list_cars(path: Path) -> Iterator[KeypointFrame | DataError]:
    """List the cars of ``cars.json``; a file that cannot be read is the reason why."""
    try:
        entries = read_list(path)
    except DataError as error:
        yield error
        return
    for number, raw in enumerate(entries):
        place = f"[{number}]"
        try:
            entry = parse(raw, Any, path=path, where=place)
        except DataError as error:
            yield error
            continue
        image = entry.get("image") if isinstance(entry, dict) else None
        stem = Path(image).stem if isinstance(image, str) and "\0" not in image else str(number)
        yield KeypointFrame(f"{stem}#{number}", path, place, entry)


def list_tracks(path: Path) -> Iterator[KeypointFrame | DataError]:
    """List the frames of ``car_tracks.json``; what cannot be read is the reason why."""
    try:
        table = read_table(path)
        raw = {
            name: parse(table.get(name, Raw(b"null")), Any, path=path, where=name)
            for name in ("names", "model_xyz", "tracks")
        }
        with in_file(path):
            model = convert({key: raw[key] for key in ("names", "model_xyz")}, MeanCar)
            tracks = convert(raw["tracks"], list[Any], "tracks")
    except DataError as error:
        yield error
        return
    for number, entry in enumerate(tracks):
        place = f"tracks[{number}]"
        try:
            with in_file(path):
                track = convert(entry, _Track, place)
        except DataError as error:
            yield error
            continue
        for row, frame in enumerate(track.frames):
            name = f"{track.sequence}/track {track.track}/{row}"
            yield KeypointFrame(name, path, f"{place}.frames[{row}]", frame, model, track)


def car_bounds(points: FloatArray) -> FloatArray:
    """The box (2, 3) of the mean car with these keypoints (k, 3), which lie within it.

    Keypoints reach to the roof, and at the wheels to their hubs. The sides are those of KITTI's
    average car.
    """
    if not len(points):
        return np.array([-_MEAN_CAR / 2, _MEAN_CAR / 2])
    low, high = points.min(axis=0), points.max(axis=0)
    center = np.array([*(low[:2] + high[:2]) / 2, high[2] - _MEAN_CAR[2] / 2])
    return np.array([center - _MEAN_CAR / 2, center + _MEAN_CAR / 2])


def _camera(k: _Matrix, size: tuple[int, int]) -> Camera:
    return Camera(*size, k[0][0], k[1][1], k[0][2], k[1][2])


def _marked(
    pixels: FloatArray, names: tuple[str, ...], scores: list[float] | None
) -> PhotoKeypoints:
    known = np.ones(len(pixels)) if scores is None else np.array(scores, dtype=float)
    return PhotoKeypoints(pixels, names, known >= HIDDEN, known if scores is not None else None)


def _object(
    object_id: str, pose: _Pose, dims: FloatArray, points: NamedPoints, marked: PhotoKeypoints
) -> PhotoObject:
    box = car_box(dims, np.array(pose.location_bottom_centre), pose.rotation_y)
    return PhotoObject(
        object_id=object_id,
        category="Car",
        truth=Truth(box=box, metres=1.0),
        keypoints=marked,
        model=CadModel("mean car", ModelFiles(None, points), bounds=car_bounds(points.xyz)),
        bbox=np.array(pose.bbox),
    )
