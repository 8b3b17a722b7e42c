"""BOP: poses of known models in photos, as one scene's folder or as a whole data set.

Hodan et al., "BOP: Benchmark for 6D Object Pose Estimation", ECCV 2018; the format is
bop_toolkit's ``docs/bop_datasets_format.md``.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.photos.bop_files import (
    TRUTH,
    BopModels,
    Nine,
    ScenePose,
    object_name,
)
from cadalign.datasets.photos.dataset import (
    PhotoDataset,
    PhotoFormat,
    leaving_out,
    parse,
    read_each,
    read_table,
)
from cadalign.datasets.photos.photo import DepthImage, Photo, PhotoObject, Truth, first_existing
from cadalign.errors import DataError, quote
from cadalign.geometry.box import Box
from cadalign.geometry.camera import Camera
from cadalign.geometry.symmetry import Symmetry
from cadalign.io.documents import (
    Finite,
    ForeignDocument,
    NotNegative,
    Positive,
    convert,
    in_file,
    read_json,
)
from cadalign.io.files import as_path
from cadalign.io.images import photo_size

MILLIMETRES = 1e-3
_CAMERAS = "scene_camera.json"
_INFO = "scene_gt_info.json"
_CAMERA = "camera.json"
_MASK_FOLDERS = ("mask_visib", "mask")
_MOST_DIGITS = 18
_IMAGES = (".png", ".jpg", ".jpeg", ".tif")


class _Info(ForeignDocument):
    bbox_obj: tuple[Finite, Finite, Finite, Finite] | None = None
    visib_fract: Finite | None = None

    def bbox(self) -> FloatArray | None:
        if self.bbox_obj is None or min(self.bbox_obj[2:]) <= 0:
            return None
        left, top, width, height = self.bbox_obj
        return np.array([left, top, left + width, top + height])


class _FrameCamera(ForeignDocument):
    cam_K: Nine
    depth_scale: NotNegative = 1.0


class _SceneCamera(ForeignDocument):
    """The camera of all photos; ``width`` and ``height`` may be missing."""

    fx: Positive
    fy: Positive
    cx: Finite
    cy: Finite
    width: Positive | None = None
    height: Positive | None = None
    depth_scale: NotNegative = 1.0


class _Scene:
    """A scene's tables, whose values are parsed when they are asked for; its camera and models."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.truth = read_table(folder / TRUTH)
        paths = folder / _CAMERAS, folder / _INFO
        self.cameras, self.info = (read_table(path) if path.is_file() else {} for path in paths)
        self.common = _common_camera(folder)
        self.models = BopModels.find(folder)

    def camera(self, key: str, image: Path | None) -> tuple[Camera | None, float]:
        """The photo's camera, None where its size is not known; and the depth's scale."""
        common = self.common
        size = photo_size(image) if image is not None else None
        if size is None and common is not None and common.width and common.height:
            size = int(common.width), int(common.height)
        if key in self.cameras:
            path = self.folder / _CAMERAS
            found: _FrameCamera = parse(self.cameras[key], _FrameCamera, path=path, where=key)
            k = found.cam_K
            values, scale = (k[0], k[4], k[2], k[5]), found.depth_scale
        elif common is not None:
            values, scale = (common.fx, common.fy, common.cx, common.cy), common.depth_scale
        else:
            what = f"no camera of photo {key}: neither {_CAMERAS} nor {_CAMERA} has it"
            raise DataError(what, where=str(self.folder))
        if size is None:
            return None, scale
        with in_file(f"{self.folder}, camera of photo {key}"):
            return Camera(*size, *values), scale


class Bop(PhotoDataset):
    """Photos with the poses of known models, in BOP's format.

    ::

        <root>/models/obj_000001.ply, models_info.json        also models_eval, models_cad
        <root>/<split>/<scene>/scene_gt.json, scene_camera.json, scene_gt_info.json,
                               rgb/000000.png (or gray), depth/, mask/, mask_visib/

    ``root`` may be the data set, a split, or one scene. From a scene, ``scene_gt.json`` alone is
    necessary with a camera: ``scene_camera.json``, or ``camera.json`` in the scene or above it.
    Models are looked for in the scene's folder and the three above it.

    Lengths are millimetres. Integer pixels are pixel centres, as in bop_toolkit. Symmetries are
    ``models_info.json``'s. The mask is that of the visible pixels. Categories are the models' ids,
    ``obj_000001``. A model's box is its truth's box.

    Raises DataError if there is no scene, or no table of a scene can be read.
    """

    kind = "BOP"
    patterns = (
        *(f"{level}scene_*.json" for level in ("", "*/", "*/*/")),
        *(f"{level}{_CAMERA}" for level in ("../../", "../", "", "*/", "*/*/")),
        *(f"{level}models*/models_info.json" for level in ("../../../", "../../", "../", "")),
    )

    def __init__(self, root: str | os.PathLike[str]) -> None:
        folder = as_path(root, "root")
        scenes = tuple(find_scenes(folder))
        if not scenes:
            what = f"there is no {TRUTH} in this folder, nor one or two below"
            fix = "give a BOP data set, one of its splits, or a scene"
            raise DataError(what, where=str(folder), fix=fix)
        self._photos: list[tuple[Path, str]] = []
        names: list[str] = []
        bad: dict[str, DataError] = {}
        for scene in scenes:
            prefix = "" if scene == folder else f"{scene.relative_to(folder).as_posix()}/"
            with leaving_out(str(scene), bad):
                keys = list(read_table(scene / TRUTH))
                self._photos += [(scene, key) for key in keys]
                names += [f"{prefix}{key}" for key in keys]
        super().__init__(folder, names, bad)

    def read(self, index: int) -> Photo:
        """Read the photo of a number from 0."""
        folder, key = self._photos[index]
        scene = self._read_once(folder, _Scene)
        image = _image(folder, ("rgb", "gray"), key)
        camera, depth_scale = scene.camera(key, image)
        poses: list[Any] = parse(scene.truth[key], list[Any], path=folder / TRUTH, where=key)
        infos: list[_Info] = []
        if key in scene.info:
            infos = parse(scene.info[key], list[_Info], path=folder / _INFO, where=key)

        def read_object(number: int, entry: Any) -> PhotoObject:
            pose: ScenePose = convert(entry, ScenePose)
            model, symmetry = None, Symmetry.none()
            if scene.models is not None:
                model, symmetry = scene.models.model(pose.obj_id)
            alignment, box = pose.alignment(), None
            if model is not None and model.bounds is not None:
                box = Box.from_model(model.bounds, alignment)
            info = infos[number] if number < len(infos) else _Info()
            masks = (folder / kind / f"{int(key):06d}_{number:06d}.png" for kind in _MASK_FOLDERS)
            return PhotoObject(
                object_id=str(number),
                category=object_name(pose.obj_id),
                truth=Truth(cam_from_model=alignment, box=box, metres=MILLIMETRES),
                model=model,
                symmetry=symmetry,
                mask_path=first_existing(masks),
                bbox=info.bbox(),
                visible_fraction=info.visib_fract,
            )

        objects, problems = read_each(poses, read_object, where=f"{folder / TRUTH}, {key}")
        depth_path = _image(folder, ("depth",), key)
        depth = None if depth_path is None else DepthImage(depth_path, depth_scale)
        return Photo(self.names[index], image, camera, objects, depth=depth, problems=problems)


def find_scenes(folder: Path) -> Iterator[Path]:
    """List the folders with a ``scene_gt.json``: this one, or those one or two below it."""
    if (folder / TRUTH).is_file():
        yield folder
        return
    for pattern in ("*", "*/*"):
        yield from sorted(path.parent for path in folder.glob(f"{pattern}/{TRUTH}"))


def _image(folder: Path, kinds: tuple[str, ...], key: str) -> Path | None:
    if not key.isdecimal() or len(key) > _MOST_DIGITS:
        raise DataError(f"{quote(key)} is not the number of an image", where=str(folder / TRUTH))
    name = f"{int(key):06d}"
    return first_existing(folder / kind / f"{name}{end}" for kind in kinds for end in _IMAGES)


def _common_camera(folder: Path) -> _SceneCamera | None:
    """The camera of all photos of a scene: its own, or that of a folder above it."""
    for place in (folder, *folder.parents[:2]):
        path = place / _CAMERA
        data = read_json(path) if path.is_file() else None
        if isinstance(data, dict) and "fx" in data:
            with in_file(path):
                found: _SceneCamera = convert(data, _SceneCamera)
            return found
    return None


FORMAT = PhotoFormat(
    f"BOP: {TRUTH}, in the folder or one or two below",
    lambda folder: next(find_scenes(folder), None) is not None,
    Bop,
)
