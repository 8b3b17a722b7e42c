"""Data sets' habits: which metrics they are evaluated by, and how accurate their keypoints are."""

from __future__ import annotations

from dataclasses import dataclass

from cadalign.datasets.photos.bop import Bop
from cadalign.datasets.photos.kitti import KittiCars
from cadalign.datasets.photos.objectron import Objectron
from cadalign.datasets.photos.pascal3d import Pascal3D, Pascal3DDetections
from cadalign.datasets.photos.pix3d import Pix3D
from cadalign.datasets.photos.posed_photos import PosedPhotos
from cadalign.datasets.photos.scan2cad import Scan2CAD
from cadalign.evaluation.metrics.bop import BOP
from cadalign.evaluation.metrics.kitti import KITTI
from cadalign.evaluation.metrics.nine_dof import NINE_DOF
from cadalign.evaluation.metrics.pascal3d import VIEWPOINT
from cadalign.evaluation.metrics.scan2cad import SCAN2CAD
from cadalign.evaluation.metrics.sets import MetricSet
from cadalign.evaluation.photos.options import PRIOR, RIGID, SHAPE, SIMILAR, STRETCHED

SETS = (VIEWPOINT, NINE_DOF, SCAN2CAD, KITTI, BOP)
"""All sets of metrics, in the order of the result table's columns."""


@dataclass(frozen=True)
class Protocol:
    """Evaluation of a data set: its metrics, and what it is given.

    Parameters
    ----------
    metrics : tuple of MetricSet
    best : str
        The method whose estimates are drawn, and which gets the evidence besides the rigid one.
    up_axis : str
        The upward axis of its models.
    sigma_of_side : float
        Standard deviation of its keypoints as a share of the longer side of the object's rectangle:
        networks' heatmaps have 64 cells.
    sigma_of_width : float, optional
        The same as a share of the image's width.
    marks_are_truth : bool
        Its keypoints are projections of the truth: noise is added.
    """

    metrics: tuple[MetricSet, ...]
    best: str
    up_axis: str = "y"
    sigma_of_side: float = 1 / 64
    sigma_of_width: float | None = None
    marks_are_truth: bool = False


_EXACT = Protocol((VIEWPOINT, BOP, NINE_DOF), RIGID, up_axis="z")
_PROTOCOLS = {
    # Annotators' points on scan and model are about 5 cm apart, 8 px in an image of 480.
    Scan2CAD.kind: Protocol((VIEWPOINT, SCAN2CAD, NINE_DOF), SIMILAR, sigma_of_width=1 / 60),
    Pix3D.kind: Protocol((VIEWPOINT, NINE_DOF), RIGID),
    Bop.kind: _EXACT,
    PosedPhotos.kind: _EXACT,
    KittiCars.kind: Protocol((VIEWPOINT, KITTI), SHAPE, up_axis="z"),
    Pascal3D.kind: Protocol((VIEWPOINT,), SIMILAR, up_axis="z"),
    Pascal3DDetections.kind: Protocol((VIEWPOINT,), SIMILAR, up_axis="z"),
    Objectron.kind: Protocol((VIEWPOINT, NINE_DOF), STRETCHED, marks_are_truth=True),
}
_OTHER = Protocol((VIEWPOINT, NINE_DOF), PRIOR)


def protocol_of(kind: str) -> Protocol:
    """The protocol of a data set's kind; of another one, viewpoint and box."""
    return _PROTOCOLS.get(kind, _OTHER)
