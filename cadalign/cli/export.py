"""`cadalign export`: a fit in the format of another tool."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from cadalign.cli.common import SOME_FAILED, SUCCESS, say
from cadalign.cli.options import named_as_flags
from cadalign.datasets.photos.dataset import read_matrix
from cadalign.errors import refuse_unused
from cadalign.export.aligned_object import Frame
from cadalign.export.formats import FORMATS, export_object, format_of

_MOST_LISTED = 10


@dataclass(frozen=True)
class Export:
    """Write a fit for another tool.

    GLB holds the textured model, stretched or warped, the cameras and the photos behind it: it
    opens in Blender, three.js and viewers as the overlay shows it. OBJ and PLY hold the mesh.
    A run of many fits becomes a folder with a file of each.
    """

    fit: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FIT.JSON|RUN")]
    """Result of `cadalign fit` or `cadalign annotate`; their folder; or the folder of a run of many
    fits."""
    to: Path
    """File to write. For a run the folder, whose name is the format's unless one is given."""
    format: str | None = None
    """Format, by default what the name's ending tells: glb, obj, ply."""
    observation: Path | None = None
    """Observation that was fitted; by default the one that the fit's file names."""
    shape: Path | None = None
    """Learned shape that was fitted; by default the observation's."""
    metres: float = 1.0
    """Length of one unit of the model [m]. Written are metres."""
    frame: Frame = "camera"
    """Frame of the exported coordinates: the first photo's camera, the frame that cameras of known
    motion share, the world, or the stretched model's own."""
    world: Path | None = None
    """Text file of the first camera's pose in the world, 4 x 4, as ScanNet's pose files; for
    --frame world."""

    def run(self) -> int:
        """Write the file; returns the exit code."""
        from cadalign.batch.exported import read_exported

        fit = self.fit
        if (fit / "fit.json").is_file():  # the folder that a fit of one observation writes
            fit = fit / "fit.json"
        if fit.is_dir():
            return self._export_run()
        with named_as_flags(self, world_from_cam="--world"):
            if self.frame != "world":
                refuse_unused(self, ["world"], "without --frame world")
            name = self.format or format_of(self.to)
            exported = read_exported(
                fit,
                observation=self.observation,
                shape=self.shape,
                world_from_cam=None if self.world is None else read_matrix(self.world, (4, 4)),
                metres=self.metres,
            )
            path = export_object(self.to, exported, format=name, frame=self.frame)
        say(f"{path}: {FORMATS[name].about}")
        return 0

    def _export_run(self) -> int:
        """Write a run; returns the exit code, 3 where some objects are left out."""
        from cadalign.batch.exported import export_run

        with named_as_flags(self):
            refuse_unused(self, ["observation", "shape", "world", "frame"], "on a run")
            count, left_out = export_run(self.fit, self.to, format=self.format, metres=self.metres)
        for error in left_out[:_MOST_LISTED]:
            say(f"left out: {error}")
        say(f"{self.to}: {count:,} objects, {len(left_out):,} left out")
        return SOME_FAILED if left_out else SUCCESS
