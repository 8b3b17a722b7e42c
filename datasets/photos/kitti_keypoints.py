"""Cars of KITTI: their boxes, files of their keypoints, and their linear shape.

The files are described in docs/formats/photo_files.md.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Raw

from cadalign.arrays import FloatArray, read_only
from cadalign.datasets.detections.image_keypoints import ImageKeypoints
from cadalign.datasets.photos.dataset import leaving_out, parse, read_list, read_table
from cadalign.datasets.photos.photo import (
    CadModel,
    NamedPoints,
    Photo,
    PhotoKeypoints,
    PhotoObject,
    Truth,
    existing,
)
from cadalign.datasets.photos.scannet import read_matrix
from cadalign.errors import DataError, InputError
from cadalign.geometry.alignment import Box
from cadalign.geometry.camera import Camera
from cadalign.geometry.rotations import rotation_from_vector
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
from cadalign.shapes.basis import find_reflection
from cadalign.shapes.model import ShapeModel

CARS = "cars.json"
TRACKS = "car_tracks.json"
SIZE = (1242, 375)
"""The size of most of KITTI's photos, taken where the photo itself is not there [px]."""
HIDDEN = 0.1
"""Scores below this are those of keypoints that something hides."""
UP = read_only(np.array([0.0, -1.0, 0.0]))
"""KITTI's cameras are level, and so are the boxes of its labels."""
_MEAN_CAR = np.array([1.63, 3.88, 1.53])  # width, length and height of cars in KITTI [m]
# The car's frame from KITTI's object frame (x forward, y down, z left at rotation_y = 0).
_OBJECT_FROM_CAR = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
_MEAN, _MODES = "meanShape_2.txt", "vectors2.txt"
_LENGTH_SIGMAS = (0.05, 0.11, 0.08)  # of the logs of width, length, height of cars in KITTI
_MODE_DEVIATION = 1.5  # of modes of unit norm, on a mean of about 8 units of length
_LONGEST = 1e6  # of a coordinate
_REST = 0.03  # what the modes leave of a keypoint's place [m]
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
    """One car in one photo, not yet checked."""

    name: str  # the photo's name
    path: Path  # the file
    place: str  # the entry's place in it, for messages
    entry: Any  # the entry
    model: MeanCar | None = None  # the part of ``car_tracks.json`` for all frames
    track: _Track | None = None  # and for the frames of one car

    def photo(self) -> Photo:
        """Read the entry; raises DataError if it is bad."""
        with in_file(self.path), within(self.place):
            if self.track is None or self.model is None:
                return self._photo_of_car(convert(self.entry, _Car))
            frame, track = convert(self.entry, _Frame), self.track
            names = tuple(self.model.names)
            points = NamedPoints(names, np.array(self.model.model_xyz).reshape(-1, 3))
            marked = _marked(frame.uv, names, frame.score)
            found = _object(str(track.track), frame, track.dims_hwl, points, marked)
            return Photo(self.name, None, _camera(track.K), (found,), up=UP)

    def _photo_of_car(self, car: _Car) -> Photo:
        names = tuple(each.name for each in car.keypoints)
        if len(set(names)) != len(names):
            raise InputError("a name occurs twice", where="keypoints")
        points = NamedPoints(names, np.array([each.xyz for each in car.keypoints]).reshape(-1, 3))
        scores = [each.score for each in car.keypoints if each.score is not None]
        image = existing(self.path.parent / car.image)
        camera = _camera(car.K, SIZE if image is None else photo_size(image))
        marked = _marked([each.uv for each in car.keypoints], names, scores or None)
        found = _object("0", car, car.dims_hwl, points, marked)
        return Photo(self.name, image, camera, (found,), up=UP)


def car_box(dims_hwl: FloatArray, location: FloatArray, rotation_y: float) -> Box:
    """The box of a car from KITTI's numbers.

    Its axes are the car's: x to its left, y to its rear, z up; its extents width, length, height.
    ``dims_hwl`` (3,) are height, width and length [m], ``location`` (3,) is the centre of its
    bottom in the camera frame [m], ``rotation_y`` [rad] 0 for a car that heads along the camera's
    x. Raises InputError if a dimension is not positive.
    """
    height, width, length = dims_hwl.tolist()
    if not min(height, width, length) > 0:
        raise InputError(f"{dims_hwl.tolist()} are not positive", where="dimensions")
    angle = math.remainder(rotation_y, math.tau)  # of a number whose square overflows, too
    turn = rotation_from_vector(np.array([0.0, angle, 0.0]))
    center = location - np.array([0, height / 2, 0])
    return Box(center, turn @ _OBJECT_FROM_CAR, np.array([width, length, height]))


def yaw_of_car(rotation: FloatArray) -> float:
    """KITTI's rotation_y [rad] of a rotation (3, 3) from the car's frame to the camera's.

    Examples
    --------
    >>> box = car_box(np.ones(3), np.array([0.0, 0.0, 9.0]), 0.7)
    >>> round(yaw_of_car(box.rotation), 12)
    0.7
    """
    forward = -rotation[:, 1]
    return float(np.arctan2(-forward[2], forward[0]))


def list_cars(path: Path, problems: dict[str, DataError]) -> Iterator[KeypointFrame]:
    """List the cars of ``cars.json``; ``problems`` gets the reasons why others cannot be read.

    Raises DataError if the file cannot be read.
    """
    for number, raw in enumerate(read_list(path)):
        place = f"[{number}]"
        with leaving_out(f"{path}: {place}", problems):
            entry = parse(raw, Any, path=path, where=place)
            image = entry.get("image") if isinstance(entry, dict) else None
            stem = str(number)
            if isinstance(image, str) and "\0" not in image:
                stem = Path(image).stem
            yield KeypointFrame(f"{stem}#{number}", path, place, entry)


def list_tracks(
    path: Path, problems: dict[str, DataError] | None = None
) -> Iterator[KeypointFrame]:
    """List the frames of ``car_tracks.json``; see `list_cars`.

    Without ``problems`` the first of the reasons is raised.
    """
    table = read_table(path)
    model = _mean_car(path, table)
    for number, entry in enumerate(_part(path, table, "tracks", list[Any])):
        place = f"tracks[{number}]"
        with leaving_out(f"{path}: {place}", problems), in_file(path):
            track: _Track = convert(entry, _Track, place)
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


def _camera(k: _Matrix, size: tuple[int, int] = SIZE) -> Camera:
    return Camera(*size, k[0][0], k[1][1], k[0][2], k[1][2])


def _marked(uv: list[Point2], names: tuple[str, ...], scores: list[float] | None) -> PhotoKeypoints:
    pixels = np.array(uv, dtype=float).reshape(-1, 2)
    if scores is None:
        return PhotoKeypoints(pixels, names, np.ones(len(pixels), dtype=bool))
    known = np.array(scores, dtype=float)
    return PhotoKeypoints(pixels, names, known >= HIDDEN, known)


def _object(
    object_id: str, pose: _Pose, dims: _Dims, points: NamedPoints, marked: PhotoKeypoints
) -> PhotoObject:
    box = car_box(np.array(dims), np.array(pose.location_bottom_centre), pose.rotation_y)
    return PhotoObject(
        object_id=object_id,
        category="Car",
        truth=Truth(box=box, metres=1.0),
        keypoints=marked,
        model=CadModel("mean car", None, points, car_bounds(points.xyz)),
        bbox=np.array(pose.bbox),
    )


def car_shape(folder: Path) -> ShapeModel | None:
    """The shape model of the cars of a folder, in metres; None without its three files.

    Raises DataError if a file cannot be read, or their sizes disagree.
    """
    paths = [folder / name for name in (TRACKS, _MEAN, _MODES)]
    if not all(path.is_file() for path in paths):
        return None
    car = _mean_car(paths[0], read_table(paths[0]))
    points = np.array(car.model_xyz, dtype=float).reshape(-1, 3)
    mean = read_matrix(paths[1], points.shape)
    modes = read_matrix(paths[2], (None, points.size)).reshape(-1, *points.shape)
    for path, lengths in zip(paths, (points, mean, modes), strict=True):
        if not (np.abs(lengths) < _LONGEST).all():  # whose squares are not finite
            what = f"some of its numbers are beyond {_LONGEST:.0e}"
            raise DataError(what, where=str(path))
    box = car_bounds(points)
    metres, *_ = np.linalg.lstsq(mean - mean.mean(axis=0), points - points.mean(axis=0), rcond=None)
    return ShapeModel.from_basis(
        points,
        modes @ metres,
        np.full(len(modes), _MODE_DEVIATION),
        names=car.names,
        box=box,
        residual_sigma=_REST,
        size_sigma=_LENGTH_SIGMAS,
        # The mean of annotated cars is a little skew: its left wheel stands before its right one.
        reflection=find_reflection(np.vstack([points, box])[None], car.names, axis=0),
        category="Car",
        up_axis="z",
        unit="m",
    )


def car_keypoints(shape: ShapeModel, box: Box, camera: Camera) -> ImageKeypoints:
    """Keypoints of a car in an image as its true box places them, with their uncertainty.

    The shape's keypoints given the lengths of the box, projected. ``sigma`` [px] is what the
    lengths leave open of them: labels have no keypoints.

    Raises InputError if the shape is no single Gaussian, or the car is behind the camera.
    """
    _, means, covariances = shape.gaussians
    if len(means) != 1:
        raise InputError("a mixture has no single mean", where="shape")
    mean, covariance, count = means[0].ravel(), covariances[0], len(shape.ids)
    lengths = np.zeros((3, len(mean)))
    axes = np.arange(3)
    lengths[axes, 3 * count + 3 + axes], lengths[axes, 3 * count + axes] = 1.0, -1.0
    gain = np.linalg.solve(
        lengths @ covariance @ lengths.T + 1e-8 * np.eye(3), lengths @ covariance
    )
    points = (mean + (box.extents - lengths @ mean) @ gain).reshape(-1, 3)
    left = (covariance - covariance @ lengths.T @ gain).reshape(count + 2, 3, count + 2, 3)
    center = (points[-2] + points[-1]) / 2
    in_camera = (points[:-2] - center) @ box.rotation.T + box.center
    slopes = camera.projection_slopes(in_camera) @ box.rotation
    own = np.einsum("iaib->iab", left)[:count]
    variances = np.einsum("nka,nab,nkb->nk", slopes, own, slopes)
    sigma = np.sqrt(np.maximum(variances.mean(axis=1), 1e-12))
    names = tuple(str(each) for each in shape.ids)
    return ImageKeypoints(camera.project(in_camera), names=names, sigma=sigma)


def _mean_car(path: Path, table: dict[str, Raw]) -> MeanCar:
    raw = {name: _part(path, table, name, Any) for name in ("names", "model_xyz")}
    with in_file(path):
        found: MeanCar = convert(raw, MeanCar)
    return found


def _part(path: Path, table: dict[str, Raw], name: str, kind: Any) -> Any:
    return parse(table.get(name, Raw(b"null")), kind, path=path, where=name)
