"""Options of an annotation session; the command line shows the text below each field."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class SessionOptions:
    """Photos, model, and the files beside them."""

    image: Path
    """A photo, or a folder of photos."""
    model: Path
    """OBJ, PLY, GLB, glTF, STL or OFF file."""
    observation: Path | None = None
    """Observation file of a single photo, continued if it exists; by default beside the photo."""
    out: Path | None = None
    """Folder for the observations; by default the photos'."""
    camera: Path | None = None
    """JSON file of the calibrated camera (COLMAP's form, Open3D's or NeRF's). Without one the focal
    length is estimated."""
    keypoints: Path | None = None
    """The model's keypoints: model.keypoints.json, or KeypointNet's annotations."""
    shape: Path | None = None
    """File of `cadalign shape learn`: estimate the object's own shape, of that category, from
    keypoints that it knows by semantic id or name."""
    shape_sigma: float | None = None
    """Estimate the object's own shape from the model's: standard deviation of the keypoints'
    positions on the object about those on the stretched model [model units]."""
