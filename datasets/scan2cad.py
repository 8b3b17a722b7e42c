"""Scan2CAD: ShapeNet models aligned to objects in ScanNet scenes with nine degrees of freedom.

Avetisyan et al., "Scan2CAD: Learning CAD Model Alignment in RGB-D Scans", CVPR 2019.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from cadalign.arrays import FloatArray
from cadalign.datasets.photo import (
    CadModel,
    NamedPoints,
    Photo,
    PhotoDataset,
    PhotoKeypoints,
    PhotoObject,
    Truth,
    existing_file,
    find_first_file,
    read_each,
    read_matrix,
)
from cadalign.datasets.records import collect_error, read_list
from cadalign.datasets.shapenet import MESH_FILES, name_of_synset
from cadalign.errors import DataError, InputError, quote
from cadalign.geometry.alignment import Alignment, Box
from cadalign.geometry.camera import Camera
from cadalign.geometry.rotations import nearest_rotation, rotation_from_quat_wxyz
from cadalign.geometry.symmetry import Symmetry
from cadalign.io.documents import Finite, ForeignDocument, Id, Point3, Positive, convert, name_file
from cadalign.io.files import as_path, list_folder
from cadalign.io.images import photo_size

FULL = "full_annotations.json"
# Files with the annotations of one scan, in Scan2CAD's repository and its derivatives.
_SAMPLES = ("example_annotation.json", "annot.json", "samples/annot.json")
_FRAME_FOLDERS = (".", "scans", "scannet", "ScanNet", "ScanNet/scans", "samples")
_MODEL_FOLDERS = ("ShapeNetCore.v2", "shapenet", "ShapeNet", "Meshes", "samples/Meshes", ".")
_UP = (0.0, 1.0, 0.0)
_FOLDS: dict[str, int | None] = {
    "__SYM_NONE": 1,
    "__SYM_ROTATE_UP_2": 2,
    "__SYM_ROTATE_UP_4": 4,
    "__SYM_ROTATE_UP_INF": None,
}
"""Order of the rotational symmetry about y by Scan2CAD's name; None for any angle."""
# Nearest depth at which a corner counts as in front of the camera [m].
_NEAR = 0.05
_FARTHEST = 1000.0  # distance of an object in a scan of rooms [m]


class _Trs(ForeignDocument):
    translation: Point3
    rotation: tuple[Finite, Finite, Finite, Finite]
    scale: tuple[Positive, Positive, Positive]

    def alignment(self) -> Alignment:
        rotation = rotation_from_quat_wxyz(np.array(self.rotation))
        return Alignment(rotation, np.array(self.translation), np.array(self.scale))


class _Points(ForeignDocument):
    position: list[Finite]

    def xyz(self) -> FloatArray:
        if len(self.position) % 3:
            raise InputError(f"expected x, y, z of each point, got {len(self.position)} numbers")
        return np.reshape(self.position, (-1, 3)).astype(float)


class _Model(ForeignDocument):
    trs: _Trs
    id_cad: Id
    catid_cad: Id
    bbox: tuple[Positive, Positive, Positive]  # half of the model's size
    center: Point3
    sym: str = "__SYM_NONE"
    keypoints_cad: _Points | None = None
    keypoints_scan: _Points | None = None


class _Scan(ForeignDocument):
    id_scan: Annotated[str, Meta(pattern=r"\Ascene[^/\\\0]+\Z")]
    trs: _Trs
    aligned_models: list[Any]


class Scan2CAD(PhotoDataset):
    """Frames of ScanNet scenes with the CAD models that annotators aligned.

    The files lie below one folder, which may hold links to them::

        full_annotations.json, or one scan's: [samples/]annot.json, example_annotation.json
        scans/<scene>/color/<frame>.jpg, pose/<frame>.txt, intrinsic/intrinsic_color.txt
        samples/scannet_<scene's number>_<frame>.jpg, ..._<frame>_pose.txt, scannet_..._intr.txt
        ShapeNetCore.v2/<synset>/<id>/models/model_normalized.obj, with or without the synset

    Other common folder names, such as ``ScanNet`` and ``Meshes``, are found, too.

    The truth is complete: pose and stretch along each axis, in metres. Keypoints are the
    annotators' point pairs: one on the CAD model, one on the scan, projected into the photo.
    Occlusion of keypoints is unknown. A photo has the objects whose box overlaps the image. A
    model's symmetry axis passes through the centre of its box.

    Parameters
    ----------
    root : str or path-like
        The folder of the annotations.

    Raises
    ------
    DataError
        If annotations are missing or cannot be read, or there is no frame of any scan.
    """

    kind = "Scan2CAD"
    signature = f"Scan2CAD: {FULL} or annot.json"
    marks = (FULL, *_SAMPLES)
    patterns = (
        *("*.json", "samples/*.json"),
        *(f"{folder}/*/pose/*.txt" for folder in _FRAME_FOLDERS),
        *(f"{folder}/*/intrinsic/*.txt" for folder in _FRAME_FOLDERS),
        *(f"{folder}/scannet_*.txt" for folder in _FRAME_FOLDERS),
    )

    def __init__(self, root: str | os.PathLike[str]) -> None:
        folder = as_path(root, "root")
        annotations = find_first_file(folder / name for name in self.marks)
        if annotations is None:
            what = f"there is no {', '.join(self.marks[:-1])} or {self.marks[-1]}"
            raise DataError(what, where=str(folder), fix="give the folder of the annotations")
        self._file = annotations
        self._models = [folder / name for name in _MODEL_FOLDERS]
        self._records: list[tuple[_Scan, _Frame]] = []
        names: list[str] = []
        bad: dict[str, DataError] = {}
        for number, entry in enumerate(entries := read_list(annotations)):
            with collect_error(f"[{number}]", bad), name_file(annotations):
                scan: _Scan = convert(entry, _Scan, f"[{number}]")
                for frame in _find_frames(scan.id_scan, [folder / name for name in _FRAME_FOLDERS]):
                    self._records.append((scan, frame))
                    names.append(f"{scan.id_scan}/{frame.frame_id}")
        if not names:
            what = f"there are no frames of the {len(entries) - len(bad)} annotated scans"
            fix = "copy or link the folder of ScanNet's scenes to scans/, beside this file"
            raise DataError(what, where=str(annotations), fix=fix)
        super().__init__(folder, names, bad)

    def read(self, index: int) -> Photo:
        """Read the photo at a position, counted from 0."""
        scan, frame = self._records[index]
        camera, cam_from_scan = frame.camera(), frame.cam_from_scan()
        scan_from_world = np.linalg.inv(scan.trs.alignment().cam_from_model)
        cam_from_world = _from_matrix(cam_from_scan.cam_from_model @ scan_from_world)

        def read_object(number: int, model: Any) -> PhotoObject | None:
            found: _Model = convert(model, _Model)
            return _object(str(number), found, cam_from_world, camera, self._models)

        name = self.names[index]
        where = f"{self._file}, {name}"
        objects, problems = read_each(scan.aligned_models, read_object, where=where)
        up = cam_from_scan.rotation[:, 2]  # scans are upright: z points up
        return Photo(name, frame.image_path, camera, objects, up=up, problems=problems)


def _object(
    object_id: str,
    found: _Model,
    cam_from_world: Alignment,
    camera: Camera,
    folders: Iterable[Path],
) -> PhotoObject | None:
    """Convert an object of the scan to a photo's object; None if its box misses the image."""
    world_from_model = found.trs.alignment()
    cam_from_model = _from_matrix(cam_from_world.cam_from_model @ world_from_model.cam_from_model)
    center, half = np.array(found.center), np.array(found.bbox)
    distance = float(np.linalg.norm(cam_from_model.apply(center[None])))
    if distance > _FARTHEST:
        what = f"the object lies {distance:.3g} m from the camera, likely millimetres for metres"
        fix = "convert the frame's pose and the annotations to metres"
        raise InputError(what, where="trs.translation", fix=fix)
    if found.sym not in _FOLDS:
        what, fix = f"{quote(found.sym)} is not a symmetry", f"known are {', '.join(_FOLDS)}"
        raise InputError(what, where="sym", fix=fix)
    bounds = np.array([center - half, center + half])
    box = Box.from_model(bounds, cam_from_model)
    bbox = _rectangle(box, camera)
    if bbox is None:
        return None
    mesh = find_first_file(
        place / file
        for folder in folders
        for place in (folder / found.catid_cad / found.id_cad, folder / found.id_cad)
        for file in MESH_FILES
    )
    keypoints, points = _keypoints(found, world_from_model, cam_from_world, camera)
    return PhotoObject(
        object_id=object_id,
        category=name_of_synset(found.catid_cad),
        truth=Truth(cam_from_model=cam_from_model, box=box),
        keypoints=keypoints,
        model=CadModel(found.id_cad, mesh, points, bounds),
        symmetry=Symmetry.around(_UP, fold=_FOLDS[found.sym], offset=center),
        bbox=bbox,
    )


def _keypoints(
    found: _Model, world_from_model: Alignment, cam_from_world: Alignment, camera: Camera
) -> tuple[PhotoKeypoints | None, NamedPoints | None]:
    """The annotators' point pairs: pixels of those in the image, and points on the CAD model."""
    if found.keypoints_cad is None or found.keypoints_scan is None:
        return None, None
    on_model, on_scan = found.keypoints_cad.xyz(), found.keypoints_scan.xyz()
    if len(on_model) != len(on_scan):
        what = f"{len(on_scan)} points, but keypoints_cad has {len(on_model)}"
        raise InputError(what, where="keypoints_scan")
    names = tuple(str(number) for number in range(len(on_model)))
    points = NamedPoints(names, world_from_model.inverse(on_model))
    pixels = camera.project_where_ahead(cam_from_world.apply(on_scan))
    inside = np.isfinite(pixels).all(axis=1) & camera.contains(pixels)
    seen = tuple(name for name, is_seen in zip(names, inside, strict=True) if is_seen)
    return (PhotoKeypoints(pixels[inside], seen) if seen else None), points


def _rectangle(box: Box, camera: Camera) -> FloatArray | None:
    """The bounding rectangle of a box, clipped to the image; None if it is outside."""
    corners = box.corners[box.corners[:, 2] > _NEAR]
    if box.center[2] <= 0 or not len(corners):
        return None
    pixels = camera.project(corners)
    low = np.maximum(pixels.min(axis=0), -0.5)
    high = np.minimum(pixels.max(axis=0), np.array([camera.width, camera.height]) - 0.5)
    return np.concatenate([low, high]) if (low < high).all() else None


def _from_matrix(matrix: FloatArray) -> Alignment:
    """Split a transform (4, 4); raises InputError if it shears: unequal scales of the scan."""
    scale = np.linalg.norm(matrix[:3, :3], axis=0)
    return Alignment(matrix[:3, :3] / scale, matrix[:3, 3], scale)


# Frames of ScanNet -----------------------------------------------------------------------------

# Intrinsics files of colour images, as SensReader and scannet_frames_25k name them.
_INTRINSICS = (Path("intrinsic", "intrinsic_color.txt"), Path("intrinsics_color.txt"))
_IMAGES = (".jpg", ".jpeg", ".png")


@dataclass(frozen=True)
class _Frame:
    frame_id: str  # its number in the file's name
    image_path: Path
    pose_path: Path  # (4, 4), scan from camera
    intrinsics_path: Path  # (4, 4), for the photo's size

    def camera(self) -> Camera:
        """Read the intrinsics; integers are taken as pixel centres."""
        matrix = read_matrix(self.intrinsics_path, (4, 4))
        width, height = photo_size(self.image_path)
        (fx, _, cx), (_, fy, cy) = matrix[:2, :3].tolist()
        with name_file(self.intrinsics_path):
            return Camera(width, height, fx, fy, cx, cy)

    def cam_from_scan(self) -> Alignment:
        """Read the pose, camera from scan [m].

        Raises DataError if it is invalid: ScanNet writes -inf for frames with lost tracking.
        """
        pose = read_matrix(self.pose_path, (4, 4))
        with name_file(self.pose_path):
            rotation = nearest_rotation(pose[:3, :3]).T
        return Alignment(rotation, -rotation @ pose[:3, 3], np.ones(3))


def _find_frames(scene: str, folders: Iterable[Path]) -> tuple[_Frame, ...]:
    """Find a scene's frames in the first folder that has any, sorted by number."""
    for folder in folders:
        found = (*_scene_folder_frames(folder / scene), *_flat_folder_frames(folder, scene))
        if found:
            return tuple(sorted(found, key=lambda frame: (len(frame.frame_id), frame.frame_id)))
    return ()


def _scene_folder_frames(folder: Path) -> Iterator[_Frame]:
    intrinsics = find_first_file(folder / name for name in _INTRINSICS)
    if intrinsics is None:
        return
    for image in list_folder(folder / "color", "*"):
        if image.suffix.lower() in _IMAGES:
            yield _Frame(image.stem, image, folder / "pose" / f"{image.stem}.txt", intrinsics)


def _flat_folder_frames(folder: Path, scene: str) -> Iterator[_Frame]:
    prefix = f"scannet_{scene.removeprefix('scene')}_"
    intrinsics = folder / f"{prefix}intr.txt"
    if not existing_file(intrinsics):
        return
    for pose in folder.glob(f"{prefix}*_pose.txt"):
        stem = pose.name.removesuffix("_pose.txt")
        images = (folder / f"{stem}{suffix}" for suffix in _IMAGES)
        image = find_first_file(images) or folder / f"{stem}.jpg"
        yield _Frame(stem.removeprefix(prefix), image, pose, intrinsics)
