"""Writing cameras as other programs do: Open3D, COLMAP, and NeRF's transforms.json.

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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.errors import InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.conventions import PIXEL_CENTRE, opengl_from_model
from cadalign.geometry.rotations import quat_wxyz_from_rotation
from cadalign.io.files import write_json, write_text, writing

OPEN3D_VIEW = "PinholeCameraParameters"
OPEN3D_TRAJECTORY = "PinholeCameraTrajectory"
_VERSION = {"version_major": 1, "version_minor": 0}
_NERF_DISTORTION = ("k1", "k2", "p1", "p2")


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


def write_open3d(path: str | os.PathLike[str], views: Sequence[CameraView]) -> None:
    """Write one view as `PinholeCameraParameters`, several as a `PinholeCameraTrajectory`.

    Refused are lens distortion, which these files have no place for, and poses with a scale.
    """
    _require_views(views)
    entries = [_open3d_entry(view, number) for number, view in enumerate(views)]
    data: dict[str, Any] = entries[0]
    if len(entries) > 1:
        data = {"class_name": OPEN3D_TRAJECTORY, "parameters": entries, **_VERSION}
    write_json(Path(path), data)


def write_nerf(path: str | os.PathLike[str], views: Sequence[CameraView]) -> None:
    """Write ``transforms.json``; what all cameras share stands at the top.

    Refused are lenses of more coefficients than k1, k2, p1, p2, and poses with a scale.
    """
    _require_views(views)
    cameras = [_nerf_camera(view.camera, number) for number, view in enumerate(views)]
    shared = {k: v for k, v in cameras[0].items() if all(camera[k] == v for camera in cameras)}
    frames = []
    for number, (view, camera) in enumerate(zip(views, cameras, strict=True)):
        own = {key: value for key, value in camera.items() if key not in shared}
        pose = np.linalg.inv(opengl_from_model(_rigid(view, number)))
        frames.append({"file_path": view.name, **own, "transform_matrix": pose.tolist()})
    write_json(Path(path), {**shared, "frames": frames})


def write_colmap(folder: str | os.PathLike[str], views: Sequence[CameraView]) -> None:
    """Write ``cameras.txt``, ``images.txt`` and an empty ``points3D.txt``.

    Cameras that are equal are written once. Refused are poses with a scale, and names that are
    missing, hold a line break or occur twice.
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
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "cameras.txt", "".join(cameras))
    write_text(folder / "images.txt", "".join(images))
    write_text(folder / "points3D.txt", "")


def _open3d_entry(view: CameraView, number: int) -> dict[str, Any]:
    camera = view.camera
    if camera.distortion:
        raise InputError(
            "Open3D's camera files have no place for lens distortion",
            where=f"views[{number}]",
            fix="undistort the image and give its camera, or write another format",
        )
    return {
        "class_name": OPEN3D_VIEW,
        "extrinsic": _rigid(view, number).cam_from_model.T.ravel().tolist(),
        "intrinsic": {
            "height": camera.height,
            "intrinsic_matrix": camera.matrix.T.ravel().tolist(),
            "width": camera.width,
        },
        **_VERSION,
    }


def _nerf_camera(camera: Camera, number: int) -> dict[str, Any]:
    if any(camera.distortion[4:]):
        what = "transforms.json has no place for more than k1, k2, p1, p2"
        raise InputError(what, where=f"views[{number}]")
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


def _require_views(views: Sequence[CameraView]) -> None:
    if not views:
        raise InputError("give at least one view", where="views")


def _rigid(view: CameraView, number: int) -> Alignment:
    if (view.cam_from_world.scale != 1).any():
        raise InputError(
            f"the pose has the scale {view.cam_from_world.scale.tolist()}",
            where=f"views[{number}]",
            fix="camera files hold rigid poses: stretch the model and give the pose with scale 1",
        )
    return view.cam_from_world
