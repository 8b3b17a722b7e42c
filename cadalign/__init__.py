"""Align CAD models to photos from keypoints: pose and stretch from one calibrated image."""

from typing import TYPE_CHECKING

from cadalign.lazy import lazy_names

if TYPE_CHECKING:
    from cadalign import datasets, errors, geometry, metrics, render, retrieval, shapes, solvers
    from cadalign.errors import CadalignError
    from cadalign.evaluation.api import evaluate, simulate
    from cadalign.fitting.batch import BatchResult
    from cadalign.fitting.fit import fit, fit_batch
    from cadalign.fitting.focal.prior import FocalPrior
    from cadalign.fitting.frames import to_dataframe
    from cadalign.fitting.joint.align import align, align_batch
    from cadalign.fitting.joint.model import Model
    from cadalign.fitting.joint.reconstruction import views_from
    from cadalign.fitting.joint.result import AlignResult
    from cadalign.fitting.joint.size import Size
    from cadalign.fitting.joint.summary import Contribution, EvidenceSummary
    from cadalign.fitting.joint.view import View
    from cadalign.fitting.options import RansacOptions
    from cadalign.fitting.result import FitResult
    from cadalign.geometry.alignment import Alignment
    from cadalign.geometry.box import Box
    from cadalign.geometry.camera import Camera
    from cadalign.geometry.mesh import Material, Mesh
    from cadalign.geometry.symmetry import Symmetry
    from cadalign.io.observation import Observation
    from cadalign.retrieval.library import Library
    from cadalign.retrieval.match import Match
    from cadalign.shapes.model import ShapeModel

__version__ = "0.1.0"

__all__ = [
    "AlignResult",
    "Alignment",
    "BatchResult",
    "Box",
    "CadalignError",
    "Camera",
    "Contribution",
    "EvidenceSummary",
    "FitResult",
    "FocalPrior",
    "Library",
    "Match",
    "Material",
    "Mesh",
    "Model",
    "Observation",
    "RansacOptions",
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
    "geometry",
    "metrics",
    "render",
    "retrieval",
    "shapes",
    "simulate",
    "solvers",
    "to_dataframe",
    "views_from",
]

__getattr__ = lazy_names(__name__)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
