"""Options of an annotation session; the command line shows the text below each field."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal


@dataclass(frozen=True, kw_only=True)
class SessionOptions:
    """Photos, model, the files beside them, and the object's shape."""

    image: Path
    """A photo, or a folder of photos."""
    model: Path
    """OBJ, PLY, GLB, glTF, STL or OFF file."""
    observation: Path | None = None
    """Observation file of a single photo, continued if it exists; by default beside the photo."""
    out: Path | None = None
    """Folder for the observations; by default the photos'."""
    camera: Path | None = None
    """File of the calibrated camera: a matrix K (text or JSON), or JSON in COLMAP's form.
    Without one the focal length is estimated."""
    focal: float | None = None
    """Focal length of the photos [px], where no file has it, or in its place."""
    fov: float | None = None
    """Horizontal field of view of the photos [degrees], in the place of the focal length."""
    keypoints: Path | None = None
    """The model's keypoints: model.keypoints.json."""
    up_axis: Literal["x", "y", "z"] | None = None
    """The model's axis that points up, for its view and for gravity; by default the observation
    file's, or y."""
    shape: Path | None = None
    """File of `cadalign shape learn`: estimate the object's own shape, of that category, from
    keypoints that it knows by semantic id or name."""
    shape_sigma: float | None = None
    """Estimate the object's own shape from the model's: standard deviation of the keypoints'
    positions on the object about those on the stretched model [model units]."""
