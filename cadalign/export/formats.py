"""The export formats, by name and by the endings of their files."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from cadalign.datasets.detections.coco import write_coco_keypoints
from cadalign.datasets.photos import bop, bop_files
from cadalign.datasets.photos.dataset import PoseEstimate
from cadalign.datasets.photos.scan2cad import scan_entry
from cadalign.datasets.sfm.colmap import write_colmap
from cadalign.datasets.sfm.correspondences import CameraView
from cadalign.errors import DataError, InputError, quote, refuse_unused
from cadalign.export.aligned_object import FRAMES, AlignedObject, Frame, names_of, photos_of
from cadalign.export.camera_files import write_nerf, write_open3d
from cadalign.export.scene_parts import write_line_set
from cadalign.export.usd import write_usd
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.mesh import Mesh
from cadalign.io.documents import written_path
from cadalign.io.files import as_path, keeping, printable, refuse_input, refuse_nul, write_json
from cadalign.io.meshes.files import write_obj_mesh, write_ply_mesh

_SAME = 1e-9
_OF_BOP = ("scene_id", "image_id", "object_id")


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """Options of an export; formats refuse those that they have no place for.

    Parameters
    ----------
    frame : {"camera", "rig", "world", "model"}
        Frame of the exported coordinates: the first photo's camera, the frame that cameras of known
        motion share, the world, or the stretched model's own.
    scene_id : int
        The scene's number, of BOP's files.
    object_id : int
        The model's number, of BOP's files.
    image_id : int, optional
        The first photo's number, of BOP's files; by default that of its file's name, or else 0.
    scan_id : str
        The scan, of Scan2CAD's files.
    category_id : str
        The model's synset, of Scan2CAD's files.
    """

    frame: Frame = "camera"
    scene_id: int = 1
    image_id: int | None = None
    object_id: int = 1
    scan_id: str = "scene0000_00"
    category_id: str = "00000000"

    def __post_init__(self) -> None:
        if self.frame not in FRAMES:
            fix = f"known are {', '.join(FRAMES)}"
            raise InputError(f"unknown frame {quote(self.frame)}", where="frame", fix=fix)
        for name in ("scene_id", "image_id", "object_id"):
            value = getattr(self, name)
            if value is not None and not (isinstance(value, int) and value >= 0):
                raise InputError(f"{quote(value)} is not a whole number from 0", where=name)


Writer = Callable[[Path, AlignedObject, ExportOptions], object]


@dataclass(frozen=True)
class Format:
    """An export format.

    Parameters
    ----------
    about : str
        What is written.
    write : callable
        Writes a path, an object and the options.
    endings : tuple of str
        Endings of file names that mean this format; a whole name where it has no dot in front.
    options : tuple of str
        The fields of `ExportOptions` that it has a place for.
    """

    about: str
    write: Writer
    endings: tuple[str, ...] = ()
    options: tuple[str, ...] = ("frame",)


def _glb(path: Path, exported: AlignedObject, options: ExportOptions) -> None:
    from cadalign.export.glb import write_glb  # loads trimesh

    write_glb(path, exported, frame=options.frame)


def _mesh_in_metres(exported: AlignedObject, options: ExportOptions) -> Mesh:
    return exported.placed_mesh(options.frame).stretched(exported.metres)


def _bop_results(path: Path, exported: AlignedObject, options: ExportOptions) -> None:
    mesh, poses = _bop_mesh(exported), _bop_poses(exported, options)
    _write_bop_model(path.parent, mesh, options)
    bop_files.write_bop_results(path, poses)


def _bop(path: Path, exported: AlignedObject, options: ExportOptions) -> None:
    folder = path.parent if path.name == bop_files.TRUTH else path
    mesh, poses = _bop_mesh(exported), _bop_poses(exported, options)
    cameras = {each.image: view.camera for each, view in zip(poses, exported.views, strict=True)}
    table = bop.scene_cameras(folder, cameras)
    _write_bop_model(folder, mesh, options)
    bop.write_scene(folder, poses, table)


def _bop_poses(exported: AlignedObject, options: ExportOptions) -> list[PoseEstimate]:
    """The poses of an object in its photos, in millimetres, of its stretched mesh.

    Photos have the numbers of `bop_files.photo_numbers`; a given one is that of the first view.
    """
    poses = []
    photos = [
        view.image if isinstance(view.image, Path) else number
        for number, view in enumerate(exported.views)
    ]
    numbers = bop_files.photo_numbers(photos)
    for number, (photo, view) in enumerate(zip(photos, exported.views, strict=True)):
        pose = view.cam_from_model
        shift = pose.translation * exported.metres / bop.MILLIMETRES
        image = numbers[photo] if options.image_id is None else options.image_id + number
        rigid = Alignment(pose.rotation, shift, np.ones(3))
        ids = str(options.scene_id), str(image), str(options.object_id)
        poses.append(PoseEstimate(*ids, rigid))
    return poses


def _bop_mesh(exported: AlignedObject) -> Mesh | None:
    """The stretched mesh [mm]; poses alone are enough of a model without stretch and mesh."""
    scale = exported.views[0].cam_from_model.scale * exported.metres / bop.MILLIMETRES
    if exported.mesh is None and np.abs(scale - 1).max() > _SAME:
        what = "BOP's poses have no stretch, and there is no mesh to stretch instead"
        raise InputError(what, where="mesh", fix="give it: an observation's `model`")
    return None if exported.mesh is None else exported.mesh.stretched(scale)


def _write_bop_model(folder: Path, mesh: Mesh | None, options: ExportOptions) -> None:
    if mesh is not None:
        entry = bop_files.write_model(folder, mesh, options.object_id)
        bop_files.write_models_info(folder, {options.object_id: entry})


def _scan2cad(path: Path, exported: AlignedObject, options: ExportOptions) -> None:
    pose, metres = exported.frame_from_model(options.frame), exported.metres
    entry = scan_entry(
        options.scan_id,
        Alignment(pose.rotation, pose.translation * metres, pose.scale * metres),
        model_id=exported.name,
        category_id=options.category_id,
        bounds=exported.bounds,
    )
    write_json(path, [entry])


def _nerf(path: Path, exported: AlignedObject, options: ExportOptions) -> None:
    placed = _camera_views(exported, options)
    names = [
        written_path(each.image, folder=path.parent) if isinstance(each.image, Path) else view.name
        for each, view in zip(exported.views, placed, strict=True)
    ]
    write_nerf(path, [replace(view, name=name) for view, name in zip(placed, names, strict=True)])


def _coco(path: Path, exported: AlignedObject, options: ExportOptions) -> None:
    names = zip(photos_of(exported), _names(exported), strict=True)
    write_coco_keypoints(path, [replace(photo, name=name) for photo, name in names])


def _names(exported: AlignedObject) -> list[str]:
    """Names of the photos: several of one name are told apart by their folders."""
    known = names_of(view.image for view in exported.views if isinstance(view.image, Path))
    views = enumerate(exported.views)
    return [known[v.image] if isinstance(v.image, Path) else f"{row}.png" for row, v in views]


def _camera_views(exported: AlignedObject, options: ExportOptions) -> list[CameraView]:
    views = []
    for number, (view, name) in enumerate(zip(exported.views, _names(exported), strict=True)):
        frame_from_cam = exported.frame_from_cam(options.frame, number)
        pose = np.asarray(np.linalg.inv(frame_from_cam), dtype=np.float64)
        pose[:3, 3] *= exported.metres
        placed = Alignment(pose[:3, :3], pose[:3, 3], np.ones(3))
        views.append(CameraView(view.camera, placed, name))
    return views


FORMATS: dict[str, Format] = {
    "glb": Format("textured model, cameras and photos, for viewers", _glb, (".glb",)),
    "usd": Format(
        "the same as USD",
        lambda path, exported, options: write_usd(path, exported, frame=options.frame),
        (".usdz", ".usda", ".usdc", ".usd"),
    ),
    "obj": Format(
        "the mesh, with materials and textures",
        lambda path, *given: write_obj_mesh(path, _mesh_in_metres(*given)),
        (".obj",),
    ),
    "ply": Format(
        "the mesh, with vertex colours",
        lambda path, *given: write_ply_mesh(path, _mesh_in_metres(*given)),
        (".ply",),
    ),
    "lines": Format(
        "box and cameras as Open3D's line set (PLY)",
        lambda path, exported, options: write_line_set(path, exported, frame=options.frame),
        (".lines.ply",),
    ),
    "bop-results": Format(
        "BOP's result CSV, the stretched mesh beside it", _bop_results, (".csv",), _OF_BOP
    ),
    "bop": Format("a BOP scene's folder with its models", _bop, ("scene_gt.json",), _OF_BOP),
    "scan2cad": Format(
        "Scan2CAD's JSON, the stretch as scale",
        _scan2cad,
        ("annotations.json",),
        ("frame", "scan_id", "category_id"),
    ),
    "nerfstudio": Format("cameras as transforms.json", _nerf, ("transforms.json",)),
    "colmap": Format(
        "cameras as COLMAP's text files",
        lambda path, *given: write_colmap(path, _camera_views(*given)),
    ),
    "open3d-camera": Format(
        "cameras as Open3D's JSON",
        lambda path, *given: write_open3d(path, _camera_views(*given)),
        ("camera.json",),
    ),
    "coco": Format("keypoints in the photos", _coco, (".coco.json", "keypoints.json"), options=()),
}
"""The formats by name."""


def format_of(path: str | os.PathLike[str]) -> str:
    """Name of the format that a path's ending means; the longest ending counts.

    Raises
    ------
    InputError
        If none has this ending, as a plain ``.json``.

    Examples
    --------
    >>> format_of("chair.glb"), format_of("out/transforms.json"), format_of("chair.lines.ply")
    ('glb', 'nerfstudio', 'lines')
    """
    name = as_path(path).name.lower()
    found = [
        (len(ending), key)
        for key, each in FORMATS.items()
        for ending in each.endings
        if name.endswith(ending)
    ]
    if found:
        return max(found)[1]
    known = "; ".join(
        f"{key} ({', '.join(each.endings) or 'folder'})" for key, each in FORMATS.items()
    )
    raise InputError(
        "the name does not tell the format",
        where=printable(Path(path)),
        fix=f"give the format: {known}",
    )


def export_object(
    path: str | os.PathLike[str],
    exported: AlignedObject,
    *,
    format: str | None = None,
    options: ExportOptions | None = None,
) -> Path:
    """Write an aligned object for another tool.

    Parameters
    ----------
    path : path-like
        The file, or for a format of several files their folder; folders above it are made.
    exported : AlignedObject
    format : str, optional
        One of `FORMATS`; by default what the path's ending means.
    options : ExportOptions, optional

    Returns
    -------
    Path
        What was written.

    Raises
    ------
    InputError
        If the format or frame is not known, an option has no place in the format, or the object
        lacks what it needs.
    DataError
        If a photo cannot be read, or the file cannot be written or is one that the object was read
        from.
    """
    path = as_path(path)
    refuse_nul(path)
    name = format_of(path) if format is None else format
    if name not in FORMATS:
        fix = f"known are {', '.join(FORMATS)}"
        raise InputError(f"unknown format {quote(name)}", where="format", fix=fix)
    options = options or ExportOptions()
    others = {each.name for each in fields(options)}.difference(FORMATS[name].options)
    refuse_unused(options, others, f"on the format {name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = error.strerror or error
        raise DataError(f"the folder cannot be made ({reason})", where=str(path.parent)) from None
    photos = (view.image for view in exported.views if isinstance(view.image, Path))
    with keeping([*exported.sources, *photos]):
        refuse_input(path)  # first: files beside it are written before it
        FORMATS[name].write(path, exported, options)
    return path
