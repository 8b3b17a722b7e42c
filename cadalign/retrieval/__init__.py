"""Retrieval of CAD models: rank a library's models by an image's keypoints.

`Library` holds the models, `Library.retrieve` ranks them and returns each as a `Match`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cadalign.retrieval.library import Library
    from cadalign.retrieval.match import Match
    from cadalign.retrieval.models import LibraryModel

__all__ = ["Library", "LibraryModel", "Match"]

_LAZY = {"Library": "library", "LibraryModel": "models", "Match": "match"}


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(import_module(f"cadalign.retrieval.{_LAZY[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
