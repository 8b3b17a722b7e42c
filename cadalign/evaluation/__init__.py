"""Evaluation of methods on data sets: instances x methods x metrics."""

from typing import TYPE_CHECKING

from cadalign.names import lazy_names

if TYPE_CHECKING:
    from cadalign.evaluation.api import evaluate, simulate
    from cadalign.evaluation.methods.registry import register_method
    from cadalign.evaluation.metrics.registry import register_metric

__all__ = ["evaluate", "register_method", "register_metric", "simulate"]

__getattr__ = lazy_names(__name__)
