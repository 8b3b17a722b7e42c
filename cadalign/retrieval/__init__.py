"""Retrieval of CAD models: rank a library's models by an image's keypoints.

`Library` holds the models, `Library.retrieve` ranks them and returns each as a `Match`.
"""

from typing import TYPE_CHECKING

from cadalign.names import lazy_names

if TYPE_CHECKING:
    from cadalign.retrieval.library import Library
    from cadalign.retrieval.match import Match
    from cadalign.retrieval.models import LibraryModel

__all__ = ["Library", "LibraryModel", "Match"]

__getattr__ = lazy_names(__name__)
