"""Aligned models in the formats of other tools."""

from cadalign.export.aligned_object import (
    FORMATS,
    AlignedObject,
    ExportView,
    export_object,
    format_of,
)
from cadalign.export.results import object_of

__all__ = ["FORMATS", "AlignedObject", "ExportView", "export_object", "format_of", "object_of"]
