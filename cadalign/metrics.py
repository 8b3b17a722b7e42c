"""Errors between an estimate and the truth: the public names of `cadalign.geometry.metrics`."""

from cadalign.geometry.metrics import *  # noqa: F403
from cadalign.geometry.metrics import __all__ as __all__
