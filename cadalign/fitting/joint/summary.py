"""Summaries of the pieces of evidence that a joint estimate rests on."""

from __future__ import annotations

from dataclasses import dataclass

from cadalign.fitting.uncertainty import Uncertainty

KINDS = ("keypoints", "mask", "depth", "gravity", "size", "camera height", "rig")
"""Kinds of evidence."""
_FIELDS = {
    "keypoints": "points_2d",
    "mask": "mask",
    "depth": "depth",
    "gravity": "up",
    "camera height": "camera_height",
    "rig": "cam_from_rig",
}


@dataclass(frozen=True)
class EvidenceSummary:
    """Agreement of one piece of evidence with a joint estimate.

    Parameters
    ----------
    kind : str
        "keypoints", "mask", "depth", "gravity", "size", "camera height" or "rig".
    view : int, optional
        Number of the view; None for the object's size.
    count : int
        Number of measurements: keypoints, contour pixels, depths, directions, lengths.
    rms_sigmas : float
        Root mean square residual, in standard deviations of the measurements.
    rms : float
        Root mean square residual in ``unit``.
    unit : str
        "px", "deg" or "" (the unit of lengths). A camera's motion has no residual of its own.
    """

    kind: str
    view: int | None
    count: int
    rms_sigmas: float
    rms: float
    unit: str

    @property
    def name(self) -> str:
        """The argument that gave it.

        Examples
        --------
        >>> EvidenceSummary("gravity", 1, 1, 0.5, 0.5, "deg").name
        'views[1].up'
        """
        return name_of(self.kind, self.view)


@dataclass(frozen=True)
class Contribution:
    """Deviations of a joint estimate with all evidence but one piece.

    Parameters
    ----------
    kind, view
        As of `EvidenceSummary`.
    without : Uncertainty
        Standard deviations without the piece, infinite for what nothing else determines.
    """

    kind: str
    view: int | None
    without: Uncertainty

    @property
    def name(self) -> str:
        """The argument that gave the piece."""
        return name_of(self.kind, self.view)


def name_of(kind: str, view: int | None) -> str:
    """The argument that gives a piece of evidence.

    Examples
    --------
    >>> name_of("size", None), name_of("depth", 0)
    ('size', 'views[0].depth')
    """
    return kind if view is None else f"views[{view}].{_FIELDS[kind]}"
