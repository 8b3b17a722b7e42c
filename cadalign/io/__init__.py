"""Read and write files: whole or not at all, with errors that say what is wrong and where."""

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
