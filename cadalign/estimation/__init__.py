"""Estimation of pose, stretch and shape of an object, with their uncertainty.

Inputs are models, views and options; the output is a `Result`. `cadalign.fit` and `cadalign.align`
are in the modules with their names.
"""

from typing import TYPE_CHECKING

from cadalign.names import lazy_names

if TYPE_CHECKING:
    from cadalign.estimation.align import align_batch
    from cadalign.estimation.fit import fit_batch
    from cadalign.estimation.model import Model
    from cadalign.estimation.options import FitOptions, RansacOptions
    from cadalign.estimation.result import Result
    from cadalign.estimation.result_parts import (
        Alternative,
        EstimateWarning,
        EvidenceSummary,
        FitStats,
        ViewResult,
    )
    from cadalign.estimation.results import Results
    from cadalign.estimation.view import View
    from cadalign.geometry.alignment import Uncertainty
    from cadalign.io.evidence import Size
    from cadalign.io.focal import FocalPrior

__all__ = [
    "Alternative",
    "EstimateWarning",
    "EvidenceSummary",
    "FitOptions",
    "FitStats",
    "FocalPrior",
    "Model",
    "RansacOptions",
    "Result",
    "Results",
    "Size",
    "Uncertainty",
    "View",
    "ViewResult",
    "align_batch",
    "fit_batch",
]

__getattr__ = lazy_names(__name__)
