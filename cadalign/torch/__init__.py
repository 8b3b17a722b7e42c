"""Alignment in PyTorch programs: fits with gradients, losses, and a loss over the posterior.

Needs the extra ``torch``: ``pip install "cadalign[torch]"``. Fits run in the compiled kernels,
on the processor; gradients are those of the optimum, by the implicit function theorem.
"""

from typing import TYPE_CHECKING

from cadalign.names import lazy_names

if TYPE_CHECKING:
    from cadalign.torch.fits import align, fit
    from cadalign.torch.poses import PoseBatch, box_loss, reprojection_loss, rotation_loss
    from cadalign.torch.posterior import posterior_loss

__all__ = [
    "PoseBatch",
    "align",
    "box_loss",
    "fit",
    "posterior_loss",
    "reprojection_loss",
    "rotation_loss",
]

__getattr__ = lazy_names(__name__)
