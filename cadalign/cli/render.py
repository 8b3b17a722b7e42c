"""`cadalign render`: images of one model."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from cadalign.cli.common import make_folder_of, say
from cadalign.cli.options import named_as_flags

if TYPE_CHECKING:
    from cadalign.cli.render_job import RenderJob


@dataclass(frozen=True)
class Render:
    """Draw a model: a still, or a contact sheet of several views.

    One view gives a still, several give a contact sheet.
    """

    model: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL")]
    """OBJ, PLY, GLB, glTF, STL or OFF file."""
    out: Path = Path("render.png")
    """File to write: .png or .jpg."""
    view: tuple[str, ...] = ("iso",)
    """Views: iso, front, right, back, left, top, bottom, azimuth,elevation[,roll] in
    degrees (write --view=-30,20 if it begins with a minus), or all."""
    size: str = "640x480"
    """Image size WIDTHxHEIGHT in pixels; of a contact sheet, each picture's."""
    keypoints: Path | None = None
    """JSON file with keypoints to draw: a list of [x, y, z], a model's .keypoints.json, or
    KeypointNet's annotations."""
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Stretch along the model's axes."""
    fov: float = 35.0
    """Horizontal field of view in degrees."""
    samples: int = 16
    """Rays per pixel at edges; 1 turns antialiasing off."""
    renderer: Literal["auto", "raycast", "pyrender", "open3d"] = "auto"
    """Renderer of the colour."""

    def run(self) -> int:
        """Draw and write; returns the exit code."""
        from cadalign.cli.render_job import RenderJob

        with named_as_flags(self, elevation="--view"):
            return self._draw(RenderJob.of(self))

    def _draw(self, job: RenderJob) -> int:
        from cadalign.io.images import write_image

        make_folder_of(self.out)
        write_image(self.out, job.picture())
        drawn_by = job.renderer.drawn_by(job.scene, samples=self.samples)
        say(f"Written: {self.out} (drawn by {drawn_by})")
        return 0
