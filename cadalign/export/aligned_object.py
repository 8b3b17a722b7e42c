"""Aligned objects, and the export formats by file extension."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError, quote
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.io.files import as_path, create_folder, printable, protect_inputs, refuse_nul
from cadalign.io.meshes.files import write_mesh

_SAME = 1e-6


@dataclass(frozen=True, eq=False)
class ExportView:
    """One photo of the object.

    Parameters
    ----------
    camera : Camera
    cam_from_model : Alignment
        Pose and stretch in this camera.
    image : path, optional
        File of the photo.
    """

    camera: Camera
    cam_from_model: Alignment
    image: Path | None = None

    def __post_init__(self) -> None:
        self.camera.require_focal()


@dataclass(frozen=True, eq=False)
class AlignedObject:
    """An object with its estimated pose, stretch and shape.

    Parameters
    ----------
    views : tuple of ExportView
        The photos, at least one. All have the same stretch.
    mesh : Mesh
        The object's mesh in the model's frame before the stretch, warped where a shape was
        estimated.
    name : str
        Name of the model.
    sources : tuple of Path
        Files that the object was read from. An export overwrites neither these nor the photos.

    Raises
    ------
    InputError
        If there is no view, or the views' stretches differ.
    """

    views: tuple[ExportView, ...]
    mesh: Mesh
    name: str = "model"
    sources: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        if not self.views:
            raise InputError("give at least one view", where="views")
        first, *scales = (view.cam_from_model.scale for view in self.views)
        for scale in scales:
            if np.abs(scale / first - 1).max() > _SAME:
                what = f"{scale.tolist()} in one view, {first.tolist()} in the first"
                raise InputError(what, where="scale", fix="all views show one object")

    def first_from_cam(self, number: int) -> FloatArray:
        """Rigid pose (4, 4) of a view's camera in the frame of the first camera."""
        there, here = self.views[0].cam_from_model, self.views[number].cam_from_model
        matrix = np.eye(4)
        matrix[:3, :3] = there.rotation @ here.rotation.T
        matrix[:3, 3] = there.translation - matrix[:3, :3] @ here.translation
        return matrix

    @property
    def placed_mesh(self) -> Mesh:
        """The mesh, stretched and in the first camera's frame."""
        pose = self.views[0].cam_from_model
        return replace(self.mesh, vertices=pose.apply(self.mesh.vertices))


class Format(NamedTuple):
    """An export format."""

    kind: Literal["glb", "obj", "ply"]
    about: str  # what is written


FORMATS: dict[str, Format] = {
    "glb": Format("glb", "textured model, cameras and photos, for viewers"),
    "obj": Format("obj", "the mesh, with vertex colours"),
    "ply": Format("ply", "the mesh, with vertex colours"),
}
"""The formats by file extension."""


def format_of(path: str | os.PathLike[str]) -> Format:
    """Export format of a path's extension; raises InputError for an unknown extension.

    Examples
    --------
    >>> format_of("out/chair.ply").about
    'the mesh, with vertex colours'
    """
    path = as_path(path)
    name = path.suffix.lower().removeprefix(".")
    if name not in FORMATS:
        fix = f"the formats are {', '.join(f'.{each}' for each in FORMATS)}"
        what = f"the ending {quote(path.suffix)} is not an export format"
        raise InputError(what, where=printable(path), fix=fix)
    return FORMATS[name]


def export_object(path: str | os.PathLike[str], exported: AlignedObject) -> Path:
    """Write an aligned object for another tool, in the frame of the first photo's camera.

    Parameters
    ----------
    path : path-like
        File to write; its extension selects the format: ``.glb``, ``.obj`` or ``.ply``. Missing
        folders are created.
    exported : AlignedObject

    Returns
    -------
    Path
        The file.

    Raises
    ------
    InputError
        If the extension is unknown.
    DataError
        If a photo cannot be read, or the file cannot be written or is one of the object's sources
        or photos.
    """
    path = as_path(path)
    refuse_nul(path)
    form = format_of(path)
    create_folder(path.parent)
    with protect_inputs([*exported.sources, *(view.image for view in exported.views)]):
        if form.kind == "glb":
            from cadalign.export.glb import write_glb  # loads trimesh

            write_glb(path, exported)
        else:
            write_mesh(path, exported.placed_mesh, kind=form.kind)
    return path
