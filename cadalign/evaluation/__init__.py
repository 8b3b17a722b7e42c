"""Evaluation of methods on data sets: instances x methods x metrics."""

from typing import TYPE_CHECKING

from cadalign.names import lazy_names

if TYPE_CHECKING:
    from cadalign.evaluation.api import evaluate

__all__ = ["evaluate"]

__getattr__ = lazy_names(__name__)
