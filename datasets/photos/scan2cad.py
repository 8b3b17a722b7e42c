"""Scan2CAD: ShapeNet models aligned, with nine degrees of freedom, to objects in ScanNet scenes.

Avetisyan et al., "Scan2CAD: Learning CAD Model Alignment in RGB-D Scans", CVPR 2019.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from cadalign.arrays import FloatArray, is_whole
from cadalign.datasets.models.shapenet import MESH_FILES, name_of_synset
from cadalign.datasets.photos.dataset import (
    PhotoDataset,
    leaving_out,
    read_each,
    read_list,
)
from cadalign.datasets.photos.photo import (
    CadModel,
    NamedPoints,
    Photo,
    PhotoKeypoints,
    PhotoObject,
    Truth,
    existing,
    first_existing,
)
from cadalign.datasets.photos.scannet import ScanNetFrame, list_frames
from cadalign.errors import DataError, InputError, quote
from cadalign.geometry.alignment import Alignment, Box
from cadalign.geometry.camera import Camera
from cadalign.geometry.rotations import rotation_from_quat_wxyz
from cadalign.geometry.symmetry import SCAN2CAD_FOLDS, Symmetry
from cadalign.io.documents import Finite, ForeignDocument, Id, Point3, Positive, convert, in_file
from cadalign.io.files import as_path

FULL = "full_annotations.json"
# One scan's annotations, as in the repository and its derivatives.
_SAMPLES = ("example_annotation.json", "annot.json", "samples/annot.json")
_FRAME_FOLDERS = (".", "scans", "scannet", "ScanNet", "ScanNet/scans", "samples")
_MODEL_FOLDERS = ("ShapeNetCore.v2", "shapenet", "ShapeNet", "Meshes", "samples/Meshes", ".")
_UP = (0.0, 1.0, 0.0)
# Corners nearer than this are as good as behind the camera [m].
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
            raise InputError(f"{len(self.position)} numbers are not x, y, z of points")
        return np.reshape(self.position, (-1, 3)).astype(float)


class _Model(ForeignDocument):
    trs: _Trs
    id_cad: Id
    catid_cad: Id
    sym: str = "__SYM_NONE"
    bbox: tuple[Positive, Positive, Positive] | None = None
    center: Point3 | None = None
    keypoints_cad: _Points | None = None
    keypoints_scan: _Points | None = None


class _Head(ForeignDocument):
    id_scan: Annotated[str, Meta(pattern=r"\Ascene[^/\\\0]+\Z")]


class _Scan(_Head):
    trs: _Trs
    aligned_models: list[Any]


class Scan2CAD(PhotoDataset):
    """Frames of ScanNet scenes with the CAD models that annotators aligned.

    Read are the official ``full_annotations.json``, or one scan's annotations in the same form
    (``annot.json``, ``samples/annot.json``, ``example_annotation.json``); ScanNet's frames as
    `cadalign.datasets.photos.scannet.list_frames` describes; models as
    ``<synset>/<id>/models/model_normalized.obj`` or without the synset's folder.

    The truth is complete: pose and stretch along each axis, in metres. Keypoints are the pairs
    of the annotators: on the CAD model, and on the scan, projected into the photo. Whether
    something hides them is not known. A photo holds the objects whose box reaches into the
    image. A model's symmetry axis runs through the centre of its box.

    Parameters
    ----------
    root : str or path-like
        The folder of the annotations, or the annotation file itself.
    scannet : str or path-like, optional
        The folder of ScanNet's scenes; by default ``scans``, ``scannet`` and the like below
        ``root``.
    shapenet : str or path-like, optional
        ShapeNetCore.v2; by default ``ShapeNetCore.v2``, ``shapenet``, ``Meshes`` and the like.
    every : int
        Take each scene's frames 0, every, 2 every and so on: a scene has thousands.

    Raises
    ------
    DataError
        If there are no annotations, they cannot be read, or there is no frame of any scan.
    InputError
        If ``every`` is no positive whole number.
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

    def __init__(
        self,
        root: str | os.PathLike[str],
        *,
        scannet: str | os.PathLike[str] | None = None,
        shapenet: str | os.PathLike[str] | None = None,
        every: int = 1,
    ) -> None:
        if not (is_whole(every) and every > 0):
            fix = "give 1, 2, 3 ..."
            raise InputError(f"{every!r} is not a number of frames", where="every", fix=fix)
        folder, self.annotations = _annotation_file(as_path(root, "root"))
        self._entries = read_list(self.annotations)
        frames = [folder / name for name in _FRAME_FOLDERS]
        if scannet is not None:
            frames = [as_path(scannet, "scannet")]
        below = [folder / name for name in _MODEL_FOLDERS]
        self._models = below if shapenet is None else [as_path(shapenet, "shapenet")]
        self._records: list[tuple[int, ScanNetFrame]] = []  # with the row of the scan
        names: list[str] = []
        bad: dict[str, DataError] = {}
        for number in range(len(self._entries)):
            with leaving_out(f"[{number}]", bad):
                scene = self._parse(number, _Head).id_scan
                for frame in list_frames(frames, scene)[::every]:
                    self._records.append((number, frame))
                    names.append(f"{scene}/{frame.frame_id}")
        if not names:
            what = f"no frame of the {len(self._entries) - len(bad)} annotated scans is here"
            fix = "give the folder of ScanNet's scenes: Scan2CAD(root, scannet=...)"
            raise DataError(what, where=str(self.annotations), fix=fix)
        super().__init__(folder, names, bad)

    def read(self, index: int) -> Photo:
        """Read the photo of a number from 0."""
        row, frame = self._records[index]
        scan = self._parse(row, _Scan)
        camera, cam_from_scan = frame.camera(), frame.cam_from_scan()
        cam_from_world = cam_from_scan @ _inverse(scan.trs.alignment())

        def read_object(number: int, model: Any) -> PhotoObject | None:
            found: _Model = convert(model, _Model)
            return _object(str(number), found, cam_from_world, camera, self._models)

        name = self.names[index]
        where = f"{self.annotations}, {name}"
        objects, problems = read_each(scan.aligned_models, read_object, where=where)
        up = cam_from_scan.rotation[:, 2]  # scans are upright: z points up
        return Photo(name, frame.image_path, camera, objects, up=up, problems=problems)

    def _parse(self, number: int, kind: Any) -> Any:
        with in_file(self.annotations):
            return convert(self._entries[number], kind, f"[{number}]")


def _object(
    object_id: str,
    found: _Model,
    cam_from_world: Alignment,
    camera: Camera,
    folders: Iterable[Path],
) -> PhotoObject | None:
    """An object of the scan as a photo shows it; None where its box is not in the image."""
    world_from_model = found.trs.alignment()
    cam_from_model = cam_from_world @ world_from_model
    center = np.array(found.center or (0.0, 0.0, 0.0))
    distance = float(np.linalg.norm(cam_from_model.apply(center[None])))
    if distance > _FARTHEST:
        what = f"the object lies {distance:.3g} m from the camera, as with millimetres for metres"
        fix = "give the frame's pose and the annotations in metres, such as divided by 1000"
        raise InputError(what, where="trs.translation", fix=fix)
    if found.sym not in SCAN2CAD_FOLDS:
        known = ", ".join(SCAN2CAD_FOLDS)
        raise InputError(f"{quote(found.sym)} is no symmetry", where="sym", fix=f"known: {known}")
    bounds = box = bbox = None
    if found.bbox is not None:
        half = np.array(found.bbox)
        bounds = np.array([center - half, center + half])
        box = Box.from_model(bounds, cam_from_model)
        bbox = _rectangle(box, camera)
        if bbox is None:
            return None
    mesh = first_existing(
        place / file
        for folder in folders
        for place in (folder / found.catid_cad / found.id_cad, folder / found.id_cad)
        for file in MESH_FILES
    )
    keypoints, points = _keypoints(found, world_from_model, cam_from_world, camera)
    return PhotoObject(
        object_id=object_id,
        category=name_of_synset(found.catid_cad),
        truth=Truth(cam_from_model=cam_from_model, box=box, metres=1.0),
        keypoints=keypoints,
        model=CadModel(found.id_cad, mesh, points, bounds),
        symmetry=Symmetry.around(_UP, fold=SCAN2CAD_FOLDS[found.sym], offset=center),
        bbox=bbox,
    )


def _keypoints(
    found: _Model, world_from_model: Alignment, cam_from_world: Alignment, camera: Camera
) -> tuple[PhotoKeypoints | None, NamedPoints | None]:
    """The annotators' pairs: on the scan as pixels, where in the image; and on the CAD model."""
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
    marked = PhotoKeypoints(pixels[inside], seen, np.ones(len(seen), dtype=bool))
    return (marked if seen else None), points


def _rectangle(box: Box, camera: Camera) -> FloatArray | None:
    """The image's part of the rectangle around a box; None where there is no such part."""
    corners = box.corners[box.corners[:, 2] > _NEAR]
    if box.center[2] <= 0 or not len(corners):
        return None
    pixels = camera.project(corners)
    low = np.maximum(pixels.min(axis=0), -0.5)
    high = np.minimum(pixels.max(axis=0), np.array([camera.width, camera.height]) - 0.5)
    return np.concatenate([low, high]) if (low < high).all() else None


def _inverse(alignment: Alignment) -> Alignment:
    scale = alignment.scale
    if np.ptp(scale) > 1e-9 * scale.max():
        raise InputError(f"the scan has unequal scales {scale.tolist()}", where="trs.scale")
    rotation = alignment.rotation.T
    shift = -rotation @ alignment.translation / scale[0]
    return Alignment(rotation, shift, 1 / scale)


def _annotation_file(path: Path) -> tuple[Path, Path]:
    if existing(path):
        return path.parent, path
    found = first_existing(path / name for name in (FULL, *_SAMPLES))
    if found is not None:
        return path, found
    what = f"neither {FULL} nor {' nor '.join(_SAMPLES)} is here"
    raise DataError(what, where=str(path), fix="give the folder of Scan2CAD's annotations")
