"""Export of aligned objects to GLB, OBJ and PLY."""

from cadalign.export.aligned_object import (
    FORMATS,
    AlignedObject,
    ExportView,
    export_object,
    format_of,
)
from cadalign.export.results import object_of

__all__ = ["FORMATS", "AlignedObject", "ExportView", "export_object", "format_of", "object_of"]
