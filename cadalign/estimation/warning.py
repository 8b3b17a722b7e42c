"""Warnings of an estimate as values: kind, text, view and keypoints.

This module alone lists the kinds. Whoever chooses, counts or stores warnings does so by kind.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Kind = Literal[
    "mistake",
    "outlier",
    "misfit",
    "noise",
    "chance",
    "untested",
    "outside-image",
    "camera",
    "stretch",
    "contradiction",
    "unit",
    "mask",
    "photo",
    "left-out",
    "focal",
    "alternative",
]


@dataclass(frozen=True, repr=False)
class EstimateWarning:
    """A warning about an estimate.

    ``str(warning)`` is its text, and warnings are printed as their texts.

    Parameters
    ----------
    kind : str
        What is doubtful:

        - "mistake": a usual mistake in the data explains them better, a mirrored model for example;
        - "outlier": keypoints do not fit the others;
        - "misfit": residuals are larger than the stated noise explains, and no few keypoints are to
          blame;
        - "noise": the estimated noise is as large as the keypoints' spread;
        - "chance": keypoints at random would agree as well;
        - "untested": no equation is left that tests the estimate;
        - "outside-image": keypoints lie outside of the image;
        - "camera": the focal length is contradicted, or the camera is implausible;
        - "stretch": the constraint on the stretch is contradicted, or the stretch implausible;
        - "contradiction": a piece of evidence contradicts the rest;
        - "unit": depths or distances are in another unit, or keypoints are no pixels;
        - "mask", "photo": it is left out, or agrees in part;
        - "left-out": a view is, or a keypoint that was not found or given twice;
        - "focal": the estimated focal length contradicts its prior;
        - "alternative": another pose is likely, too.
    text : str
        A sentence for the user.
    view : int, optional
        Number of the view that it is about; None for all of them together.
    keypoints : tuple of int
        Rows, among the view's keypoints, of those that it is about; empty where it is about no few.

    Examples
    --------
    >>> warning = EstimateWarning("left-out", "views[1] is left out", view=1)
    >>> print(warning)
    views[1] is left out
    """

    kind: Kind
    text: str
    view: int | None = None
    keypoints: tuple[int, ...] = ()

    def __str__(self) -> str:
        return self.text

    def __repr__(self) -> str:
        return repr(self.text)


Warnings = tuple[EstimateWarning, ...]

MISFIT_KINDS: frozenset[Kind] = frozenset({"misfit", "outlier", "stretch", "camera", "mistake"})
"""Kinds about keypoints that do not fit."""
