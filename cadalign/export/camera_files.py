"""Cameras of other programs, read and written: Open3D, and NeRF's transforms.json; COLMAP's, read.

Each program has its own axes, pixel origin and direction of transforms:

- Open3D's `PinholeCameraParameters` (and `PinholeCameraTrajectory`): OpenCV's axes, ``extrinsic``
  is camera from world, matrices are written column by column, the top-left pixel's centre is
  (0, 0): the viewer's principal point is ``(width - 1) / 2``. No lens distortion.
- COLMAP: OpenCV's axes, camera from world, that centre is (0.5, 0.5), quaternions are wxyz.
- ``transforms.json`` (instant-ngp, nerfstudio): OpenGL's axes, world from camera, the centre is
  (0.5, 0.5) as in COLMAP, from which these files mostly come.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from cadalign.arrays import FloatArray
from cadalign.datasets.sfm.colmap import Colmap
from cadalign.datasets.sfm.correspondences import CameraView
from cadalign.errors import DataError, InputError, quote
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.conventions import PIXEL_CENTRE, alignment_from_opengl, opengl_from_model
from cadalign.geometry.rotations import quat_wxyz_from_rotation
from cadalign.io.documents import Finite, ForeignDocument, convert, in_file, read_json, within
from cadalign.io.files import as_path, write_json, write_text

_OPEN3D_VIEW = "PinholeCameraParameters"
_OPEN3D_TRAJECTORY = "PinholeCameraTrajectory"
_VERSION = {"version_major": 1, "version_minor": 0}
_NERF_DISTORTION = {"OPENCV": ("k1", "k2", "p1", "p2"), "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4")}
_NERF_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", *_NERF_DISTORTION)
_Angle = Annotated[float, Meta(gt=0, lt=np.pi)]


class _Open3dIntrinsic(ForeignDocument):
    intrinsic_matrix: list[Any]  # column by column
    width: int = 0
    height: int = 0


class _Open3dView(ForeignDocument):
    """Open3D's ``PinholeCameraParameters``."""

    intrinsic: _Open3dIntrinsic
    extrinsic: list[Any]  # column by column


class _Open3dTrajectory(ForeignDocument):
    parameters: Annotated[list[_Open3dView], Meta(min_length=1)]


class _NerfFrame(ForeignDocument):
    """A frame of ``transforms.json``, together with what the file's top says for all frames."""

    transform_matrix: list[Any]
    w: Finite | None = None
    h: Finite | None = None
    fl_x: Finite | None = None
    fl_y: Finite | None = None
    cx: Finite | None = None
    cy: Finite | None = None
    camera_angle_x: _Angle | None = None
    camera_angle_y: _Angle | None = None
    k1: Finite | None = None
    k2: Finite | None = None
    k3: Finite | None = None
    k4: Finite | None = None
    p1: Finite | None = None
    p2: Finite | None = None
    camera_model: str | None = None
    is_fisheye: bool = False
    file_path: Any = ""


class _NerfFile(ForeignDocument):
    frames: Annotated[list[dict[str, Any]], Meta(min_length=1)]


def write_open3d(path: str | os.PathLike[str], views: Sequence[CameraView]) -> None:
    """Write one view as `PinholeCameraParameters`, several as a `PinholeCameraTrajectory`.

    Refused are lens distortion, which these files have no place for, and poses with a scale.
    """
    _require_views(views)
    entries = [_open3d_entry(view, number) for number, view in enumerate(views)]
    data: dict[str, Any] = entries[0]
    if len(entries) > 1:
        data = {"class_name": _OPEN3D_TRAJECTORY, "parameters": entries, **_VERSION}
    write_json(as_path(path), data)


def write_nerf(path: str | os.PathLike[str], views: Sequence[CameraView]) -> None:
    """Write ``transforms.json``; what all cameras share stands at the top.

    Refused are lenses of more coefficients than k1, k2, p1, p2, of a fisheye k1 to k4, fov lenses,
    and poses with a scale.
    """
    _require_views(views)
    cameras = [nerf_camera(view.camera, f"views[{number}]") for number, view in enumerate(views)]
    shared = {k: v for k, v in cameras[0].items() if all(camera[k] == v for camera in cameras)}
    frames = []
    for number, (view, camera) in enumerate(zip(views, cameras, strict=True)):
        own = {key: value for key, value in camera.items() if key not in shared}
        pose = np.linalg.inv(opengl_from_model(view.rigid(f"views[{number}]")))
        frames.append({"file_path": view.name, **own, "transform_matrix": pose.tolist()})
    write_json(as_path(path), {**shared, "frames": frames})


def _open3d_entry(view: CameraView, number: int) -> dict[str, Any]:
    camera = view.camera
    if camera.distortion:
        raise InputError(
            "Open3D's camera files have no place for lens distortion",
            where=f"views[{number}]",
            fix="undistort the image and give its camera, or write another format",
        )
    return {
        "class_name": _OPEN3D_VIEW,
        "extrinsic": view.rigid(f"views[{number}]").cam_from_model.T.ravel().tolist(),
        "intrinsic": {
            "height": camera.height,
            "intrinsic_matrix": camera.matrix.T.ravel().tolist(),
            "width": camera.width,
        },
        **_VERSION,
    }


def nerf_camera(camera: Camera, where: str) -> dict[str, Any]:
    """The fields of a camera in ``transforms.json``; raises InputError if it has no place there."""
    if any(camera.distortion[4:]) or camera.lens == "fov":
        what = "transforms.json has no place for more than k1, k2, p1, p2, or a fisheye's k1 to k4"
        raise InputError(what, where=where)
    coefficients = camera.distortion[:4] or (0.0,) * 4
    model = "OPENCV_FISHEYE" if camera.lens == "fisheye" else "OPENCV"
    return {
        "camera_model": model,
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx + PIXEL_CENTRE,
        "cy": camera.cy + PIXEL_CENTRE,
        **dict.fromkeys(("k1", "k2", "k3", "k4", "p1", "p2"), 0.0),
        **dict(zip(_NERF_DISTORTION[model], coefficients, strict=True)),
    }


def _require_views(views: Sequence[CameraView]) -> None:
    if not views:
        raise InputError("give at least one view", where="views")


def read_camera_views(path: str | os.PathLike[str]) -> list[CameraView]:
    """Read cameras and poses from an Open3D or NeRF JSON file, or the folder of a COLMAP model."""
    path = as_path(path)
    if path.is_dir():
        model = Colmap(path)
        images = (model[name] for name in model.ids)
        return [CameraView(image.camera, image.cam_from_world, image.id) for image in images]
    data = read_json(path)
    with in_file(path), np.errstate(over="ignore", invalid="ignore"):
        return _views_of(data)


def _views_of(data: Any) -> list[CameraView]:
    """The cameras of a parsed Open3D or NeRF file."""
    fields = data if isinstance(data, dict) else {}
    if "frames" in fields:
        return _nerf_views(fields)
    if fields.get("class_name") == _OPEN3D_TRAJECTORY:
        views = convert(fields, _Open3dTrajectory).parameters
        return [_open3d_view(view, f"parameters[{n}]") for n, view in enumerate(views)]
    if fields.get("class_name") == _OPEN3D_VIEW or {"extrinsic", "intrinsic"} <= fields.keys():
        return [_open3d_view(convert(fields, _Open3dView), "")]
    raise DataError(
        "not a camera file that is known",
        fix="give an Open3D PinholeCameraParameters or a NeRF transforms.json file, or the folder "
        "of a COLMAP model",
    )


def _open3d_view(view: _Open3dView, where: str) -> CameraView:
    with within(where):
        matrix = _matrix(view.intrinsic.intrinsic_matrix, 3, "intrinsic_matrix").T
        extrinsic = _matrix(view.extrinsic, 4, "extrinsic").T
        size, focal = (view.intrinsic.width, view.intrinsic.height), (matrix[0, 0], matrix[1, 1])
        camera = Camera(*size, *focal, matrix[0, 2], matrix[1, 2])
        return CameraView(camera, Alignment(extrinsic[:3, :3], extrinsic[:3, 3], np.ones(3)))


def _nerf_views(data: dict[str, Any]) -> list[CameraView]:
    shared = {key: data[key] for key in _NerfFrame.__struct_fields__ if key in data}
    views = []
    for number, entry in enumerate(convert(data, _NerfFile).frames):
        with within(f"frames[{number}]"):
            frame: _NerfFrame = convert({**shared, **entry}, _NerfFrame)
            matrix = _matrix(frame.transform_matrix, 4, "transform_matrix")
            with np.errstate(all="ignore"):
                determinant = abs(np.linalg.det(matrix))
            if not 1e-12 <= determinant < np.inf:
                raise InputError("the matrix has no inverse", where="transform_matrix")
            pose = alignment_from_opengl(np.asarray(np.linalg.inv(matrix), dtype=float))
            views.append(CameraView(_camera_from_nerf(frame), pose, str(frame.file_path)))
    return views


def _camera_from_nerf(frame: _NerfFrame) -> Camera:
    if frame.camera_model not in (None, *_NERF_MODELS):
        what, fix = f"{quote(frame.camera_model)} is not a camera model that is known", "undistort"
        raise InputError(what, where="camera_model", fix=f"{fix}, or give {_NERF_MODELS[-1]}")
    is_fisheye = frame.is_fisheye or frame.camera_model == "OPENCV_FISHEYE"
    model = "OPENCV_FISHEYE" if is_fisheye else "OPENCV"
    for name in {"k3", "k4", "p1", "p2"} - set(_NERF_DISTORTION[model]):
        if getattr(frame, name):
            what = f"{name} is not a coefficient of the model {model}"
            raise InputError(what, where=name, fix="state the camera_model, or undistort")
    width, height = frame.w, frame.h
    if width is None or height is None:
        raise InputError("w and h, the image's size, are missing")
    fx, fy = frame.fl_x, frame.fl_y
    if is_fisheye and fx is None:
        raise InputError("fl_x, a fisheye's focal length, is missing")
    if fx is None and frame.camera_angle_x is not None:
        fx = width / 2 / float(np.tan(frame.camera_angle_x / 2))
    if fy is None and frame.camera_angle_y is not None and not is_fisheye:
        fy = height / 2 / float(np.tan(frame.camera_angle_y / 2))
    if fx is None:
        raise InputError("neither fl_x nor camera_angle_x is there")
    return Camera(
        width=int(width),
        height=int(height),
        fx=fx,
        fy=fx if fy is None else fy,
        cx=(width / 2 if frame.cx is None else frame.cx) - PIXEL_CENTRE,
        cy=(height / 2 if frame.cy is None else frame.cy) - PIXEL_CENTRE,
        distortion=tuple(getattr(frame, name) or 0.0 for name in _NERF_DISTORTION[model]),
        lens="fisheye" if is_fisheye else "perspective",
    )


def _matrix(value: list[Any], size: int, where: str) -> FloatArray:
    """A flat or nested list of numbers as (size, size) float, row by row."""
    nested = bool(value) and isinstance(value[0], list)
    rows = convert(value, list[list[Finite]] if nested else list[Finite], where=where)
    flat = [number for row in rows for number in row] if nested else rows
    if len(flat) != size * size or (nested and any(len(row) != size for row in rows)):
        raise DataError(f"is not {size} x {size} finite numbers", where=where)
    return np.array(flat).reshape(size, size)


def write_tum(path: Path, times: FloatArray, poses: FloatArray) -> None:
    """Write times (P,) [s] and poses (P, 12), rotations by rows and translations.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp(), "track.tum")
    >>> write_tum(path, np.array([0.5]), np.array([[1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 2.0]]))
    >>> [float(number) for number in path.read_text().split()]
    [0.5, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 1.0]
    """
    lines = []
    for time, pose in zip(times, poses, strict=True):
        w, x, y, z = quat_wxyz_from_rotation(pose[:9].reshape(3, 3))
        lines.append(_line([time, *pose[9:], x, y, z, w]))
    write_text(path, "".join(lines))


def write_kitti(path: Path, poses: FloatArray) -> None:
    """Write poses (P, 12), rotations by rows and translations, a matrix (3, 4) a line."""
    matrices = np.concatenate([poses[:, :9].reshape(-1, 3, 3), poses[:, 9:, None]], axis=2)
    write_text(path, "".join(map(_line, matrices.reshape(-1, 12).tolist())))


def _line(numbers: list[float]) -> str:
    return " ".join(f"{number + 0.0:.9f}" for number in numbers) + "\n"
