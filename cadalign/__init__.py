"""Align CAD models to photos from keypoints: pose and stretch from one calibrated image."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from cadalign.alignment import Alignment
from cadalign.box import Box
from cadalign.camera import Camera
from cadalign.errors import CadalignError
from cadalign.focal import FocalPrior
from cadalign.mesh import Material, Mesh
from cadalign.result import FitResult

if TYPE_CHECKING:
    from cadalign.batch import BatchResult
    from cadalign.evaluation.api import evaluate, simulate
    from cadalign.fitting import fit, fit_batch
    from cadalign.retrieval.library import Library
    from cadalign.retrieval.match import Match
    from cadalign.robust import RansacOptions

__version__ = "0.1.0"

__all__ = [
    "Alignment",
    "BatchResult",
    "Box",
    "CadalignError",
    "Camera",
    "FitResult",
    "FocalPrior",
    "Library",
    "Match",
    "Material",
    "Mesh",
    "RansacOptions",
    "evaluate",
    "fit",
    "fit_batch",
    "simulate",
]

# What needs the compiler is imported when it is first asked for: `import cadalign` stays quick.
_LAZY = {
    "RansacOptions": "cadalign.robust",
    "BatchResult": "cadalign.batch",
    "Library": "cadalign.retrieval.library",
    "Match": "cadalign.retrieval.match",
    "evaluate": "cadalign.evaluation.api",
    "fit": "cadalign.fitting",
    "fit_batch": "cadalign.fitting",
    "simulate": "cadalign.evaluation.api",
}


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        value = getattr(import_module(_LAZY[name]), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
