"""Former name of `cadalign.estimation.exporting`."""

from cadalign.estimation.exporting import object_of_align, object_of_fit

__all__ = ["object_of_align", "object_of_fit"]
