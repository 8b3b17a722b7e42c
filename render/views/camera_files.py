"""Reading and writing cameras as other programs do: Open3D, COLMAP, and NeRF's transforms.json.

Each program has its own axes, pixel origin and direction of transforms; none of that gets past this
module.

- Open3D's `PinholeCameraParameters` (and `PinholeCameraTrajectory`): OpenCV's axes, ``extrinsic``
  is camera from world, matrices are written column by column, the top-left pixel's centre is
  (0, 0): the viewer's principal point is ``(width - 1) / 2``. No lens distortion.
- COLMAP: OpenCV's axes, camera from world, that centre is (0.5, 0.5), quaternions are wxyz.
- ``transforms.json`` (instant-ngp, nerfstudio): OpenGL's axes, world from camera, the centre is
  (0.5, 0.5) as in COLMAP, from which these files mostly come.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import CadalignError, DataError, InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.conventions import PIXEL_CENTRE, alignment_from_opengl, opengl_from_model
from cadalign.geometry.rotations import quat_wxyz_from_rotation

_OPEN3D_VIEW = "PinholeCameraParameters"
_OPEN3D_TRAJECTORY = "PinholeCameraTrajectory"
_VERSION = {"version_major": 1, "version_minor": 0}
_NERF_DISTORTION = ("k1", "k2", "p1", "p2")
_NERF_CAMERA = ("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y")


@dataclass(frozen=True, eq=False)
class CameraView:
    """A camera and where it stands.

    Parameters
    ----------
    camera : Camera
    cam_from_world : Alignment
        Its pose, with all scales 1.
    name : str
        The image's name; empty where the file has none.
    """

    camera: Camera
    cam_from_world: Alignment
    name: str = ""


def read_camera_views(path: str | os.PathLike[str]) -> list[CameraView]:
    """Read cameras and poses from a file or folder of any of the three kinds.

    Parameters
    ----------
    path : str or path-like
        An Open3D or NeRF JSON file, or the folder of a COLMAP model.

    Returns
    -------
    list of CameraView

    Raises
    ------
    DataError
        If it is missing, of another kind, or malformed; it names the file and the field.
    """
    path = Path(path)
    if path.is_dir():
        return _read_colmap(path)
    data = _read_json(path)
    if not isinstance(data, dict):
        raise _unknown(path)
    if "frames" in data:
        return _read_nerf(data, path)
    if data.get("class_name") == _OPEN3D_TRAJECTORY:
        entries = _list(data, "parameters", path)
        return [_open3d_view(entry, f"{path}, parameters[{n}]") for n, entry in enumerate(entries)]
    if data.get("class_name") == _OPEN3D_VIEW or {"extrinsic", "intrinsic"} <= data.keys():
        return [_open3d_view(data, str(path))]
    raise _unknown(path)


def write_open3d(path: str | os.PathLike[str], views: Sequence[CameraView]) -> None:
    """Write one view as `PinholeCameraParameters`, several as a `PinholeCameraTrajectory`.

    Raises
    ------
    InputError
        If there are no views, one has lens distortion, which these files have no place for, or a
        pose has a scale.
    DataError
        If the file cannot be written.
    """
    _require_views(views)
    entries = [_open3d_entry(view, number) for number, view in enumerate(views)]
    data: dict[str, Any] = entries[0]
    if len(entries) > 1:
        data = {"class_name": _OPEN3D_TRAJECTORY, "parameters": entries, **_VERSION}
    _write_text(Path(path), json.dumps(data, indent=1) + "\n")


def write_nerf(path: str | os.PathLike[str], views: Sequence[CameraView]) -> None:
    """Write ``transforms.json``; what all cameras share stands at the top.

    Raises
    ------
    InputError
        If there are no views, a lens has more coefficients than k1, k2, p1, p2, or a pose has a
        scale.
    DataError
        If the file cannot be written.
    """
    _require_views(views)
    cameras = [_nerf_camera(view.camera, number) for number, view in enumerate(views)]
    shared = {key: value for key, value in cameras[0].items() if _in_all(key, value, cameras)}
    frames = [
        {"file_path": view.name}
        | {key: value for key, value in camera.items() if key not in shared}
        | {"transform_matrix": _world_from_opengl(view, number).tolist()}
        for number, (view, camera) in enumerate(zip(views, cameras, strict=True))
    ]
    _write_text(Path(path), json.dumps({**shared, "frames": frames}, indent=1) + "\n")


def write_colmap(folder: str | os.PathLike[str], views: Sequence[CameraView]) -> None:
    """Write ``cameras.txt``, ``images.txt`` and an empty ``points3D.txt``.

    Cameras that are equal are written once.

    Raises
    ------
    InputError
        If there are no views, a pose has a scale, or a name is missing, holds a line break or
        occurs twice.
    DataError
        If the files cannot be written.
    """
    _require_views(views)
    names = [view.name for view in views]
    if len(set(names)) < len(names) or any(not n or "\n" in n or n != n.strip() for n in names):
        raise InputError("every view needs an image name of its own", where="views")
    numbers: dict[Camera, int] = {}
    images = []
    for number, view in enumerate(views, start=1):
        camera_id = numbers.setdefault(view.camera, len(numbers) + 1)
        pose = _rigid(view, number - 1)
        values = [*quat_wxyz_from_rotation(pose.rotation), *pose.translation]
        text = " ".join(f"{value:.17g}" for value in values)
        images.append(f"{number} {text} {camera_id} {view.name}\n\n")
    cameras = []
    for camera, camera_id in numbers.items():
        entry = camera.to_dict()
        params = " ".join(f"{value:.17g}" for value in entry["params"])
        cameras.append(f"{camera_id} {entry['model']} {camera.width} {camera.height} {params}\n")
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"cannot be made ({error.strerror})", where=str(folder)) from None
    _write_text(folder / "cameras.txt", "".join(cameras))
    _write_text(folder / "images.txt", "".join(images))
    _write_text(folder / "points3D.txt", "")


# Open3D


def _open3d_view(data: Any, where: str) -> CameraView:
    intrinsic = data.get("intrinsic") if isinstance(data, dict) else None
    if not isinstance(intrinsic, dict):
        raise DataError("the field 'intrinsic' is missing", where=where)
    matrix = _matrix(intrinsic.get("intrinsic_matrix"), 3, f"{where}, intrinsic_matrix").T
    extrinsic = _matrix(data.get("extrinsic"), 4, f"{where}, extrinsic").T
    try:
        camera = Camera(
            width=intrinsic.get("width", 0),
            height=intrinsic.get("height", 0),
            fx=matrix[0, 0],
            fy=matrix[1, 1],
            cx=matrix[0, 2],
            cy=matrix[1, 2],
        )
        pose = Alignment(extrinsic[:3, :3], extrinsic[:3, 3], np.ones(3))
    except InputError as error:
        raise _in_file(error, where) from None
    return CameraView(camera, pose)


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
        "extrinsic": _rigid(view, number).cam_from_model.T.ravel().tolist(),
        "intrinsic": {
            "height": camera.height,
            "intrinsic_matrix": camera.matrix.T.ravel().tolist(),
            "width": camera.width,
        },
        **_VERSION,
    }


# NeRF


def _read_nerf(data: dict[str, Any], path: Path) -> list[CameraView]:
    views = []
    for number, frame in enumerate(_list(data, "frames", path)):
        where = f"{path}, frames[{number}]"
        if not isinstance(frame, dict):
            raise DataError("is not an object", where=where)
        matrix = _matrix(frame.get("transform_matrix"), 4, f"{where}, transform_matrix")
        try:
            if abs(np.linalg.det(matrix)) < 1e-12:
                raise InputError("the matrix has no inverse", where="transform_matrix")
            pose = alignment_from_opengl(np.asarray(np.linalg.inv(matrix), dtype=float))
            camera = _camera_from_nerf({**data, **frame})
        except CadalignError as error:
            raise _in_file(error, where) from None
        views.append(CameraView(camera, pose, str(frame.get("file_path", ""))))
    return views


def _camera_from_nerf(entry: dict[str, Any]) -> Camera:
    values = {key: _number(entry, key) for key in (*_NERF_CAMERA, *_NERF_DISTORTION)}
    for key in ("k3", "k4"):
        if _number(entry, key):
            raise InputError(f"{key} is a fisheye's coefficient", where=key, fix="undistort first")
    width, height = values["w"], values["h"]
    if width is None or height is None:
        raise InputError("w and h, the image's size, are missing", where="transforms")
    fx, fy = values["fl_x"], values["fl_y"]
    if fx is None and values["camera_angle_x"] is not None:
        fx = width / 2 / np.tan(values["camera_angle_x"] / 2)
    if fy is None and values["camera_angle_y"] is not None:
        fy = height / 2 / np.tan(values["camera_angle_y"] / 2)
    if fx is None:
        raise InputError("neither fl_x nor camera_angle_x is there", where="transforms")
    cx = width / 2 if values["cx"] is None else values["cx"]
    cy = height / 2 if values["cy"] is None else values["cy"]
    return Camera(
        width=int(width),
        height=int(height),
        fx=fx,
        fy=fx if fy is None else fy,
        cx=cx - PIXEL_CENTRE,
        cy=cy - PIXEL_CENTRE,
        distortion=tuple(values[key] or 0.0 for key in _NERF_DISTORTION),
    )


def _nerf_camera(camera: Camera, number: int) -> dict[str, Any]:
    if any(camera.distortion[4:]):
        raise InputError(
            "transforms.json has no place for more than k1, k2, p1, p2", where=f"views[{number}]"
        )
    coefficients = camera.distortion[:4] or (0.0,) * 4
    return {
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx + PIXEL_CENTRE,
        "cy": camera.cy + PIXEL_CENTRE,
        **dict(zip(_NERF_DISTORTION, coefficients, strict=True)),
    }


def _world_from_opengl(view: CameraView, number: int) -> FloatArray:
    return np.asarray(np.linalg.inv(opengl_from_model(_rigid(view, number))))


def _in_all(key: str, value: Any, cameras: list[dict[str, Any]]) -> bool:
    return all(camera[key] == value for camera in cameras)


# COLMAP


def _read_colmap(folder: Path) -> list[CameraView]:
    # The loaders stand above this module, and are not needed for the other formats.
    from cadalign.datasets.sfm.colmap import Colmap

    model = Colmap(folder)
    images = (model[name] for name in model.ids)
    return [CameraView(image.camera, image.cam_from_world, image.id) for image in images]


# All of them


def _require_views(views: Sequence[CameraView]) -> None:
    if not views:
        raise InputError("there are none", where="views")


def _rigid(view: CameraView, number: int) -> Alignment:
    if (view.cam_from_world.scale != 1).any():
        raise InputError(
            f"the pose has the scale {view.cam_from_world.scale.tolist()}",
            where=f"views[{number}]",
            fix="camera files hold rigid poses: stretch the model and give the pose with scale 1",
        )
    return view.cam_from_world


def _matrix(value: Any, size: int, where: str) -> FloatArray:
    """A flat or nested list of numbers as (size, size) float, row by row."""
    try:
        matrix = np.array(value, dtype=float)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    if matrix.shape not in ((size * size,), (size, size)) or not np.isfinite(matrix).all():
        raise DataError(f"is not {size} x {size} finite numbers", where=where)
    return matrix.reshape(size, size)


def _number(entry: dict[str, Any], key: str) -> float | None:
    value = entry.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{value!r} is not a number", where=key)
    return float(value)


def _list(data: dict[str, Any], key: str, path: Path) -> list[Any]:
    value = data.get(key)
    if not isinstance(value, list) or not value:
        raise DataError("is not a list with anything in it", where=f"{path}, {key}")
    return value


def _in_file(error: CadalignError, where: str) -> DataError:
    place = where if error.where is None else f"{where}, {error.where}"
    return DataError(error.what, where=place, fix=error.fix)


def _unknown(path: Path) -> DataError:
    return DataError(
        "not a camera file that is known",
        where=str(path),
        fix="give an Open3D PinholeCameraParameters or a NeRF transforms.json file, or the folder "
        "of a COLMAP model",
    )


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_bytes())
    except FileNotFoundError:
        raise DataError("no such file", where=str(path)) from None
    except OSError as error:
        raise DataError(f"cannot be read ({error.strerror})", where=str(path)) from None
    except (ValueError, RecursionError) as error:
        raise DataError(f"not JSON: {error}", where=str(path)) from None


def _write_text(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise DataError(f"cannot be written ({error.strerror})", where=str(path)) from None
