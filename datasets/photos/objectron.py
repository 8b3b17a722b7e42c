"""Objectron: boxes with nine degrees of freedom in the frames of phone videos.

Ahmadyan et al., "Objectron: A Large Scale Dataset of Object-Centric Videos in the Wild with Pose
Annotations", CVPR 2021.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.photos.dataset import PhotoDataset, PhotoFormat, leaving_out, read_each
from cadalign.datasets.photos.objectron_files import (
    ArCamera,
    ObjectronAnnotation,
    read_sequence,
)
from cadalign.datasets.photos.photo import (
    CadModel,
    NamedPoints,
    Photo,
    PhotoKeypoints,
    PhotoObject,
    Truth,
    first_existing,
)
from cadalign.datasets.photos.placed import PlacedObject, converted, upright_rotation
from cadalign.errors import DataError, InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import Box
from cadalign.geometry.camera import Camera
from cadalign.geometry.conventions import PIXEL_CENTRE
from cadalign.geometry.rotations import nearest_rotation
from cadalign.io.documents import convert
from cadalign.io.files import as_path, listed, open_input, write_json
from cadalign.io.images import ByteImage

ANNOTATIONS = "annotations"
_GEOMETRY = "geometry.pbdata"
_LEVELS = ("", "*/", "*/*/", "*/*/*/")
_PATTERNS = (
    *(f"{level}*.pbdata" for level in _LEVELS),
    *(f"{ANNOTATIONS}/{level}*.json" for level in _LEVELS),
)
# Objects come first in a JSON file, and there are few.
_BEGINNING = 2**16
_BOUNDS = np.array([[-0.5] * 3, [0.5] * 3])
# The centre, then the corners: the sign of z changes first, that of x last.
_UNIT_BOX = np.array(
    [[0, 0, 0], *([x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5))],
    dtype=float,
)
_NAMES = ("center", *(f"corner {number}" for number in range(1, 9)))
# The photo is upright, the sensor on its side: the sensor's y (up) is the photo's x (right), its x
# (right) the photo's y (down), and it looks along -z.
_CV_FROM_SENSOR = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_VISIBLE = 0.1
_Y_UP_FROM_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_NEAR, _FAR = 1e-3, 1e3  # of written projection matrices
_CONTAINERS = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip")
_MOST_BYTES = 2**36  # of a video


def read_video_frame(path: Path, number: int) -> ByteImage:
    """Read a frame of a video, from 0, upright, (h, w, 3) uint8.

    Raises DataError if the video has no such frame, or cannot be read.
    """
    import cv2  # on first use: it takes longer to import than all the rest

    # Going by the content, OpenCV would play lists of other files and addresses, too.
    with open_input(path, most=_MOST_BYTES) as file:
        if file.read(8)[4:] not in _CONTAINERS:
            raise DataError("not a video in QuickTime's or MP4's form", where=str(path))
    video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        video.set(cv2.CAP_PROP_POS_FRAMES, number)
        is_read, pixels = video.read()
    finally:
        video.release()
    if not is_read:
        raise DataError(f"frame {number} cannot be read", where=str(path))
    if pixels.shape[0] < pixels.shape[1]:  # the file's note on rotation was not heeded
        pixels = np.rot90(pixels, k=-1)
    return np.ascontiguousarray(pixels[:, :, ::-1], dtype=np.uint8)


class Objectron(PhotoDataset):
    """Frames of Objectron's videos.

    ::

        annotations/<class>/batch-<i>/<j>.pbdata          (or .json)
        videos/<class>/batch-<i>/<j>/video.MOV

    or such annotation files up to four levels below ``root``, each with frames in a folder of its
    name, ``<j>/<frame id>.jpg`` or ``.png``, or ``<j>/video.MOV``. Files are the official protocol
    buffers, or the same messages as JSON; see `cadalign.datasets.photos.objectron_files`.

    The truth is complete: the model is the unit box around the origin, its stretch the sides in
    metres. The keypoints are the box's centre and corners, also those that the object hides. Photos
    are upright, while the annotated camera is the sensor's, which lies on its side.

    Raises DataError if there are no annotation files, or none can be read.
    """

    kind = "Objectron"
    patterns = _PATTERNS

    def __init__(self, root: str | os.PathLike[str]) -> None:
        folder = as_path(root, "root")
        paths = list_annotations(folder)
        if not paths:
            fix = "give the folder of Objectron's annotations"
            raise DataError("there are no annotation files (.pbdata)", where=str(folder), fix=fix)
        self._frames: list[tuple[Path, int]] = []
        names: list[str] = []
        bad: dict[str, DataError] = {}
        for path in paths:
            stem = path.relative_to(folder).with_suffix("").as_posix()
            with leaving_out(str(path), bad):
                count = len(read_sequence(path).frames)
                self._frames += [(path, number) for number in range(count)]
                names += [f"{stem}/{number}" for number in range(count)]
        if not names and not bad:
            raise DataError("the annotation files have no frames", where=str(folder))
        super().__init__(folder, names, bad)

    def read(self, index: int) -> Photo:
        """Read the photo of a number from 0."""
        path, number = self._frames[index]
        sequence = self._read_once(path, read_sequence)
        frame = sequence.frame(number)
        camera = _camera(frame.camera)
        view: FloatArray = np.reshape(frame.camera.view_matrix, (4, 4)).astype(float)
        turn = _CV_FROM_SENSOR @ nearest_rotation(view[:3, :3])
        cam_from_world = Alignment(turn, _CV_FROM_SENSOR @ view[:3, 3], np.ones(3))

        def read_object(row: int, entry: Any) -> PhotoObject:
            annotation: ObjectronAnnotation = convert(entry, ObjectronAnnotation)
            found = sequence.object(annotation.object_id)
            rotation = nearest_rotation(np.reshape(found.rotation, (3, 3)).astype(float))
            shift, scale = np.array(found.translation), np.array(found.scale)
            world_from_model = Alignment(rotation, shift, scale)
            cam_from_model = cam_from_world @ world_from_model
            return PhotoObject(
                object_id=str(row),
                category=found.category,
                truth=Truth(cam_from_model, Box.from_model(_BOUNDS, cam_from_model), metres=1.0),
                keypoints=_keypoints(annotation, camera),
                model=CadModel("unit box", None, NamedPoints(_NAMES, _UNIT_BOX), _BOUNDS),
                visible_fraction=float(np.clip(annotation.visibility, 0.0, 1.0)),
                flags=frozenset(() if annotation.visibility > _VISIBLE else ("occluded",)),
            )

        where = f"{path}: frame_annotations[{number}]"
        objects, problems = read_each(frame.annotations, read_object, where=where)
        image = _image(self.root, path, frame.frame_id)
        up = cam_from_world.rotation[:, 1]  # the phone's world is upright: y points up
        return Photo(self.names[index], image, camera, objects, up=up, problems=problems)


def list_annotations(folder: Path) -> list[Path]:
    """List the annotation files: ``.pbdata``, and ``.json`` in ``annotations``; four levels."""
    found = (path for pattern in _PATTERNS for path in listed(folder, pattern))
    return sorted(path for path in found if path.name != _GEOMETRY)


def _is_sequence(path: Path) -> bool:
    """True for an annotation file, by its ending or, where it is JSON, its content."""
    if path.suffix == ".pbdata":
        return True
    with suppress(DataError), open_input(path) as file:
        begin = file.read(_BEGINNING)
        return b"frame_annotations" in begin or b"frameAnnotations" in begin
    return False


def _keypoints(annotation: ObjectronAnnotation, camera: Camera) -> PhotoKeypoints:
    if len(annotation.keypoints) != len(_NAMES):
        raise InputError(f"{len(annotation.keypoints)}, expected {len(_NAMES)}", where="keypoints")
    ordered = sorted(annotation.keypoints, key=lambda each: each.id)
    share = np.array([[each.point_2d.get(name, 0.0) for name in "xy"] for each in ordered])
    pixels = share * (camera.width, camera.height) - PIXEL_CENTRE
    return PhotoKeypoints(pixels, _NAMES, np.ones(len(_NAMES), dtype=bool))


def _camera(found: ArCamera) -> Camera:
    """The upright photo's camera, from the projection matrix of the sensor on its side."""
    width, height = found.image_resolution_height, found.image_resolution_width
    projection = np.reshape(found.projection_matrix, (4, 4))
    # Across the sensor, which is down the photo, from -1 to 1: P[0, 0] x / -z - P[0, 2].
    fx, fy = projection[1, 1] * width / 2, projection[0, 0] * height / 2
    cx = (1 - projection[1, 2]) * width / 2 - PIXEL_CENTRE
    cy = (1 - projection[0, 2]) * height / 2 - PIXEL_CENTRE
    return Camera(width, height, float(fx), float(fy), float(cx), float(cy))


def _image(root: Path, annotation: Path, frame_id: int) -> Path | Callable[[], ByteImage] | None:
    place = annotation.with_suffix("").relative_to(root)
    folders = [root / place]
    if place.parts[0] == ANNOTATIONS:
        folders.append(root / Path("videos", *place.parts[1:]))
    for folder in folders:
        names = (str(frame_id), f"{frame_id:06d}")
        image = first_existing(folder / f"{n}{end}" for n in names for end in (".jpg", ".png"))
        if image is not None:
            return image
        if (folder / "video.MOV").is_file():
            return partial(read_video_frame, folder / "video.MOV", frame_id)
    return None


def write_objectron(folder: Path, numbered: Iterable[tuple[int, PlacedObject]]) -> list[InputError]:
    """Write each object as a sequence of one frame, as JSON: its box with centre and corners.

    The scene's y points up. Returns why objects were left out.
    """

    def write(number: int, placed: PlacedObject) -> None:
        sequence = _sequence(placed)
        place = folder / ANNOTATIONS / placed.category / "batch-1"
        placed.copy_image(place / f"{number}" / "0")
        write_json(place / f"{number}.json", sequence)

    _, problems = converted(numbered, write)
    return problems


def _sequence(placed: PlacedObject) -> dict[str, Any]:
    placed.require_plain_camera("Objectron")
    pose, camera, sides, center = placed.pose, placed.camera, placed.sides, placed.center
    if not sides.min() > 0:
        raise InputError("the model is flat, which no box is", where=placed.photo.name)
    corners = center + (_UNIT_BOX * sides) @ pose.rotation.T
    share = (camera.project_where_ahead(corners) + PIXEL_CENTRE) / (camera.width, camera.height)
    if not np.isfinite(share).all():
        raise InputError("the box reaches behind the camera", where=placed.photo.name)
    world_from_cam = _Y_UP_FROM_Z_UP @ upright_rotation(placed.up)
    view = np.eye(4)
    view[:3, :3] = _CV_FROM_SENSOR.T @ world_from_cam.T
    found = {
        "id": 1,
        "category": placed.found.category,
        "rotation": (world_from_cam @ pose.rotation).ravel().tolist(),
        "translation": (world_from_cam @ center).tolist(),
        "scale": sides.tolist(),
    }
    keypoints = [
        {"id": k, "point2d": {"x": x, "y": y, "depth": depth}}
        for k, (x, y, depth) in enumerate(np.column_stack([share, corners[:, 2]]).tolist())
    ]
    sensor = {
        "imageResolutionWidth": camera.height,
        "imageResolutionHeight": camera.width,
        "projectionMatrix": _projection(camera).ravel().tolist(),
        "viewMatrix": view.ravel().tolist(),
    }
    annotation = {"objectId": 1, "keypoints": keypoints, "visibility": 1.0}
    frame = {"frameId": 0, "annotations": [annotation], "camera": sensor}
    return {"objects": [found], "frameAnnotations": [frame]}


def _projection(camera: Camera) -> FloatArray:
    width, height = camera.width, camera.height
    matrix = np.zeros((4, 4))
    matrix[0, 0], matrix[1, 1] = 2 * camera.fy / height, 2 * camera.fx / width
    matrix[0, 2] = 1 - 2 * (camera.cy + PIXEL_CENTRE) / height
    matrix[1, 2] = 1 - 2 * (camera.cx + PIXEL_CENTRE) / width
    matrix[2, 2:] = -(_FAR + _NEAR) / (_FAR - _NEAR), -2 * _FAR * _NEAR / (_FAR - _NEAR)
    matrix[3, 2] = -1.0
    return matrix


FORMAT = PhotoFormat(
    "objectron",
    f"Objectron: .pbdata files, or JSON files in {ANNOTATIONS}",
    lambda folder: any(map(_is_sequence, list_annotations(folder))),
    Objectron,
    write_objectron,
)
