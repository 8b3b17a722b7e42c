"""The export formats, by name and by the endings of their files."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from cadalign.errors import DataError, InputError, quote
from cadalign.export.aligned_object import FRAMES, AlignedObject, Frame
from cadalign.geometry.mesh import Mesh
from cadalign.io.files import as_path, keeping, printable, refuse_input, refuse_nul
from cadalign.io.meshes.files import write_obj_mesh, write_ply_mesh


class Format(NamedTuple):
    """An export format, whose name is the ending of its files."""

    about: str  # what is written
    write: Callable[[Path, AlignedObject, Frame], object]


def _glb(path: Path, exported: AlignedObject, frame: Frame) -> None:
    from cadalign.export.glb import write_glb  # loads trimesh

    write_glb(path, exported, frame=frame)


def _mesh_in_metres(exported: AlignedObject, frame: Frame) -> Mesh:
    return exported.placed_mesh(frame).stretched(exported.metres)


FORMATS: dict[str, Format] = {
    "glb": Format("textured model, cameras and photos, for viewers", _glb),
    "obj": Format(
        "the mesh, with materials and textures",
        lambda path, *given: write_obj_mesh(path, _mesh_in_metres(*given)),
    ),
    "ply": Format(
        "the mesh, with vertex colours",
        lambda path, *given: write_ply_mesh(path, _mesh_in_metres(*given)),
    ),
}
"""The formats by name."""


def format_of(path: str | os.PathLike[str]) -> str:
    """Name of the format that a path's ending means.

    Raises
    ------
    InputError
        If none has this ending.

    Examples
    --------
    >>> format_of("out/chair.glb")
    'glb'
    """
    path = as_path(path)
    name = path.suffix.lower().removeprefix(".")
    if name not in FORMATS:
        what, fix = "the name does not tell the format", f"give the format: {', '.join(FORMATS)}"
        raise InputError(what, where=printable(path), fix=fix)
    return name


def export_object(
    path: str | os.PathLike[str],
    exported: AlignedObject,
    *,
    format: str | None = None,
    frame: Frame = "camera",
) -> Path:
    """Write an aligned object for another tool.

    Parameters
    ----------
    path : path-like
        The file; folders above it are made.
    exported : AlignedObject
    format : {"glb", "obj", "ply"}, optional
        By default what the path's ending means.
    frame : {"camera", "rig", "world", "model"}
        Frame of the exported coordinates: the first photo's camera, the frame that cameras of known
        motion share, the world, or the stretched model's own.

    Returns
    -------
    Path
        What was written.

    Raises
    ------
    InputError
        If the format or frame is not known, or the object lacks what it needs.
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
    if frame not in FRAMES:
        fix = f"known are {', '.join(FRAMES)}"
        raise InputError(f"unknown frame {quote(frame)}", where="frame", fix=fix)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = error.strerror or error
        raise DataError(f"the folder cannot be made ({reason})", where=str(path.parent)) from None
    photos = (view.image for view in exported.views if isinstance(view.image, Path))
    with keeping([*exported.sources, *photos]):
        refuse_input(path)  # first: files beside it are written before it
        FORMATS[name].write(path, exported, frame)
    return path
