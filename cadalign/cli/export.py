"""`cadalign export`: a fit in the format of another tool."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from cadalign.cli.options import OptionError, named_as_flags
from cadalign.cli.output import new_console
from cadalign.datasets.photos.scannet import read_matrix
from cadalign.export.formats import FORMATS, ExportOptions, export_object, format_of


@dataclass(frozen=True)
class _Options(ExportOptions):
    """Coordinates, and ids that formats ask for."""

    def __post_init__(self) -> None:
        with named_as_flags(self, kind=OptionError):
            super().__post_init__()


@dataclass(frozen=True)
class Export:
    """Write a fit for another tool.

    GLB and USD hold the textured model, stretched or warped, the cameras and the photos behind it:
    they open in Blender, three.js and viewers as the overlay shows it. OBJ and PLY hold the mesh,
    .lines.ply the box and cameras for Open3D, .csv and scene_gt.json poses for BOP with the
    stretched mesh beside them, transforms.json and COLMAP's text files the cameras.
    """

    fit: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FIT.JSON")]
    """Result of `cadalign fit` or `cadalign annotate`."""
    to: Path
    """File to write, or folder of a format of several files."""
    format: str | None = None
    """Format, by default what the name's ending tells: glb, usd, obj, ply, lines, bop-results, bop,
    scan2cad, nerfstudio, colmap, open3d-camera, coco."""
    observation: Path | None = None
    """Observation that was fitted; by default photo.json of photo_fit/fit.json."""
    shape: Path | None = None
    """Learned shape that was fitted; by default the observation's."""
    metres: float = 1.0
    """Length of one unit of the model [m]. Written are metres, of BOP's files millimetres."""
    world: Path | None = None
    """Text file of the first camera's pose in the world, 4 x 4, as ScanNet's pose files; for
    --frame world."""
    options: Annotated[
        _Options, tyro.conf.OmitArgPrefixes, tyro.conf.arg(help=_Options.__doc__)
    ] = _Options()

    def run(self) -> int:
        """Write the file; returns the exit code."""
        from cadalign.cli.exported import read_exported

        with named_as_flags(self, self.options):
            name = self.format or format_of(self.to)
            exported = read_exported(
                self.fit,
                observation=self.observation,
                shape=self.shape,
                world_from_cam=None if self.world is None else read_matrix(self.world, (4, 4)),
                metres=self.metres,
            )
            path = export_object(self.to, exported, format=name, options=self.options)
        new_console().print(f"{path}: {FORMATS[name].about}", markup=False)
        return 0
