"""Aligned models in the formats of other tools, and poses of other tools read back."""

from cadalign.export.aligned_object import AlignedObject, ExportView
from cadalign.export.formats import FORMATS, ExportOptions, export_object, format_of

__all__ = ["FORMATS", "AlignedObject", "ExportOptions", "ExportView", "export_object", "format_of"]
