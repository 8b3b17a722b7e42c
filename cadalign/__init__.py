"""Align CAD models to photos from keypoints: pose and stretch from one calibrated image."""

from typing import TYPE_CHECKING

from cadalign.names import lazy_names

if TYPE_CHECKING:
    from cadalign import datasets, errors, metrics, render
    from cadalign.batch.runs import fit_many
    from cadalign.errors import CadalignError
    from cadalign.estimation.align import align, align_batch
    from cadalign.estimation.fit import fit, fit_batch
    from cadalign.estimation.model import Model
    from cadalign.estimation.options import RansacOptions
    from cadalign.estimation.result import Result
    from cadalign.estimation.results import Results
    from cadalign.estimation.view import View
    from cadalign.evaluation.api import evaluate
    from cadalign.geometry.alignment import Alignment, Box
    from cadalign.geometry.camera import Camera
    from cadalign.geometry.mesh import Mesh
    from cadalign.geometry.symmetry import Symmetry
    from cadalign.io.evidence import Size
    from cadalign.io.focal import FocalPrior
    from cadalign.io.meshes.files import load_mesh
    from cadalign.io.observation import Observation
    from cadalign.retrieval.library import Library
    from cadalign.shapes.examples import Example
    from cadalign.shapes.model import ShapeModel

__version__ = "0.1.0"

__all__ = [
    "Alignment",
    "Box",
    "CadalignError",
    "Camera",
    "Example",
    "FocalPrior",
    "Library",
    "Mesh",
    "Model",
    "Observation",
    "RansacOptions",
    "Result",
    "Results",
    "ShapeModel",
    "Size",
    "Symmetry",
    "View",
    "align",
    "align_batch",
    "datasets",
    "errors",
    "evaluate",
    "fit",
    "fit_batch",
    "fit_many",
    "load_mesh",
    "metrics",
    "render",
]

__getattr__ = lazy_names(__name__)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
