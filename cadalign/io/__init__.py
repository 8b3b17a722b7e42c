"""Read files, with errors that name the place of a problem, and write files atomically."""

from typing import TYPE_CHECKING

from cadalign.names import lazy_names

if TYPE_CHECKING:
    from cadalign.io.evidence import ImageEvidence, ObservedImage, Size
    from cadalign.io.meshes.files import load_mesh
    from cadalign.io.observation import Observation, read_camera

__all__ = [
    "ImageEvidence",
    "Observation",
    "ObservedImage",
    "Size",
    "load_mesh",
    "read_camera",
]

__getattr__ = lazy_names(__name__)
