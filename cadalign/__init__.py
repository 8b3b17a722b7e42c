"""Align CAD models to photos from keypoints: pose and stretch from one calibrated image."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from cadalign.errors import CadalignError
from cadalign.fitting.focal.prior import FocalPrior
from cadalign.fitting.result import FitResult
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import Box
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Material, Mesh

if TYPE_CHECKING:
    from cadalign import datasets, errors, metrics, render, retrieval, solvers
    from cadalign.evaluation.api import evaluate, simulate
    from cadalign.fitting.batch import BatchResult
    from cadalign.fitting.fit import fit, fit_batch
    from cadalign.fitting.joint.align import align, align_batch
    from cadalign.fitting.joint.model import Model
    from cadalign.fitting.joint.reconstruction import views_from
    from cadalign.fitting.joint.result import AlignResult
    from cadalign.fitting.joint.size import Size
    from cadalign.fitting.joint.summary import Contribution, EvidenceSummary
    from cadalign.fitting.joint.view import View
    from cadalign.fitting.options import RansacOptions
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
    "RansacOptions",
    "ShapeModel",
    "Size",
    "View",
    "align",
    "align_batch",
    "datasets",
    "errors",
    "evaluate",
    "fit",
    "fit_batch",
    "metrics",
    "render",
    "retrieval",
    "simulate",
    "solvers",
    "views_from",
]

# Imported when first asked for, so that `import cadalign` stays quick.
_NAMES = {
    "AlignResult": "cadalign.fitting.joint.result",
    "Model": "cadalign.fitting.joint.model",
    "Contribution": "cadalign.fitting.joint.summary",
    "EvidenceSummary": "cadalign.fitting.joint.summary",
    "views_from": "cadalign.fitting.joint.reconstruction",
    "Size": "cadalign.fitting.joint.size",
    "View": "cadalign.fitting.joint.view",
    "align": "cadalign.fitting.joint.align",
    "align_batch": "cadalign.fitting.joint.align",
    "RansacOptions": "cadalign.fitting.options",
    "BatchResult": "cadalign.fitting.batch",
    "Library": "cadalign.retrieval.library",
    "Match": "cadalign.retrieval.match",
    "ShapeModel": "cadalign.shapes.model",
    "evaluate": "cadalign.evaluation.api",
    "fit": "cadalign.fitting.fit",
    "fit_batch": "cadalign.fitting.fit",
    "simulate": "cadalign.evaluation.api",
}
_MODULES = ("datasets", "metrics", "render", "retrieval", "solvers")


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return import_module(f"cadalign.{name}")
    if name in _NAMES:
        value = getattr(import_module(_NAMES[name]), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
