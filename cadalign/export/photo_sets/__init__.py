"""Annotated photos as data sets in the forms that `cadalign.datasets.open` reads."""

from cadalign.export.photo_sets.annotated import AnnotatedPhoto
from cadalign.export.photo_sets.forms import FORMS, write_photo_set

__all__ = ["FORMS", "AnnotatedPhoto", "write_photo_set"]
