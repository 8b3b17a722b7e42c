"""The object's box, keypoints and cameras as a line set, in the PLY form that Open3D reads."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.export.aligned_object import AlignedObject, Frame
from cadalign.export.scene_parts import photo_plane
from cadalign.geometry.box import BOX_EDGES, Box
from cadalign.io.files import write_text

_BOX_COLOR = (230, 60, 50)
_CAMERA_COLOR = (40, 90, 200)
_FRUSTUM = 0.25  # depth of a drawn camera over the object's distance
_FRUSTUM_EDGES = ((0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1))

_Lines = tuple[FloatArray, IntArray, tuple[int, int, int]]


def write_line_set(path: Path, exported: AlignedObject, *, frame: Frame = "camera") -> None:
    """Write the box of the object and a pyramid for each camera as edges of a PLY file.

    ``open3d.io.read_line_set`` reads it.

    Raises
    ------
    InputError
        If the frame is not known, or there is neither mesh nor keypoints.
    """
    box = Box.from_model(exported.bounds, exported.frame_from_model(frame))
    pieces: list[_Lines] = [(box.corners, np.array(BOX_EDGES), _BOX_COLOR)]
    pieces += [_pyramid(exported, number, frame) for number in range(len(exported.views))]
    points = np.concatenate([points for points, _, _ in pieces]) * exported.metres
    starts = np.cumsum([0, *(len(points) for points, _, _ in pieces)])
    edges = [
        f"{a + start} {b + start} {red} {green} {blue}"
        for (_, pairs, (red, green, blue)), start in zip(pieces, starts, strict=False)
        for a, b in pairs.tolist()
    ]
    header = [
        "ply",
        "format ascii 1.0",
        f"element vertex {len(points)}",
        *(f"property double {axis}" for axis in "xyz"),
        f"element edge {len(edges)}",
        "property int vertex1",
        "property int vertex2",
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
        "end_header",
    ]
    vertices = [f"{x:.17g} {y:.17g} {z:.17g}" for x, y, z in points.tolist()]
    write_text(path, "\n".join([*header, *vertices, *edges]) + "\n")


def _pyramid(exported: AlignedObject, number: int, frame: Frame) -> _Lines:
    """A camera's centre and the corners of its photo."""
    view = exported.views[number]
    distance = float(np.linalg.norm(view.cam_from_model.translation))
    corners = photo_plane(view.camera, None).corners * _FRUSTUM * (distance or 1.0)
    pose = exported.frame_from_cam(frame, number)
    points = np.vstack([np.zeros(3), corners]) @ pose[:3, :3].T + pose[:3, 3]
    return points, np.array(_FRUSTUM_EDGES), _CAMERA_COLOR
