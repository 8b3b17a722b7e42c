"""An aligned object, its shape and views; the export formats by their files' endings."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.io.files import as_path, keeping, made_folder, printable, refuse_nul
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
        The photo's file.
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
        Its photos, at least one. All have the same stretch.
    mesh : Mesh
        The object's mesh in the model's frame before the stretch, warped where a shape was
        estimated.
    name : str
        The model's name.
    sources : tuple of Path
        The files that it was read from, which no export writes over; nor over its photos.

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
        """The rigid pose (4, 4) of a view's camera in the first one, by the object both see."""
        there, here = self.views[0].cam_from_model, self.views[number].cam_from_model
        matrix = np.eye(4)
        matrix[:3, :3] = there.rotation @ here.rotation.T
        matrix[:3, 3] = there.translation - matrix[:3, :3] @ here.translation
        return matrix

    @property
    def placed_mesh(self) -> Mesh:
        """The mesh, stretched and placed in the first camera's frame."""
        pose = self.views[0].cam_from_model
        return replace(self.mesh, vertices=pose.apply(self.mesh.vertices))


class Format(NamedTuple):
    """An export format, whose name is the ending of its files."""

    about: str  # what is written
    write: Callable[[Path, AlignedObject], object]


def _glb(path: Path, exported: AlignedObject) -> None:
    from cadalign.export.glb import write_glb  # loads trimesh

    write_glb(path, exported)


FORMATS: dict[str, Format] = {
    "glb": Format("textured model, cameras and photos, for viewers", _glb),
    "obj": Format(
        "the mesh, with vertex colours",
        lambda path, exported: write_mesh(path, exported.placed_mesh, kind="obj"),
    ),
    "ply": Format(
        "the mesh, with vertex colours",
        lambda path, exported: write_mesh(path, exported.placed_mesh, kind="ply"),
    ),
}
"""The formats by name."""


def format_of(path: str | os.PathLike[str]) -> Format:
    """The format that a path's ending means; raises InputError if none has this ending.

    Examples
    --------
    >>> format_of("out/chair.ply").about
    'the mesh, with vertex colours'
    """
    path = as_path(path)
    name = path.suffix.lower().removeprefix(".")
    if name not in FORMATS:
        fix = f"give one that ends in {', '.join(f'.{each}' for each in FORMATS)}"
        raise InputError("the name does not tell the format", where=printable(path), fix=fix)
    return FORMATS[name]


def export_object(path: str | os.PathLike[str], exported: AlignedObject) -> Path:
    """Write an aligned object for another tool, in the frame of the first photo's camera.

    Parameters
    ----------
    path : path-like
        The file, whose ending tells the format: ``.glb``, ``.obj`` or ``.ply``; folders above it
        are made.
    exported : AlignedObject

    Returns
    -------
    Path
        What was written.

    Raises
    ------
    InputError
        If the ending is not known, or the object lacks what the format needs.
    DataError
        If a photo cannot be read, or the file cannot be written or is one that the object was read
        from.
    """
    path = as_path(path)
    refuse_nul(path)
    form = format_of(path)
    made_folder(path.parent)
    with keeping([*exported.sources, *(view.image for view in exported.views)]):
        form.write(path, exported)
    return path
