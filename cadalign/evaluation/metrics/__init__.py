"""Table of metrics: key, label, unit and direction of every number that experiments report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

LOW, HIGH = "low", "high"
_HUGE = 1e9  # larger numbers are formatted by powers of ten


@dataclass(frozen=True)
class Metric:
    """A metric: a column of a result table or of a summary."""

    key: str  # name of the column or field
    label: str  # name in figures and on pages
    unit: str = ""  # empty for dimensionless numbers
    digits: int = 2  # decimals
    better: str | None = LOW
    """Direction, low or high; None for numbers that are no measure of quality."""
    factor: float = 1.0  # converts values to the unit
    head: str = ""  # column head without unit; the label by default
    symbol: str = ""
    """Short column head with unit, for the console; the head by default."""
    log: bool = True  # plotted on a logarithmic axis

    def __post_init__(self) -> None:
        object.__setattr__(self, "head", self.head or self.label)
        object.__setattr__(self, "symbol", self.symbol or self.head)

    @property
    def axis(self) -> str:
        """Label with unit."""
        return f"{self.label} [{self.unit}]" if self.unit else self.label

    @property
    def heading(self) -> str:
        """Head with unit."""
        return f"{self.head} [{self.unit}]" if self.unit else self.head

    def shown(self, value: Any) -> float | None:
        """Convert a value to the unit; None if it is missing or not finite."""
        return None if value is None or not np.isfinite(value) else self.factor * value

    def text(self, value: Any) -> str:
        """Convert a value to the unit and format it; a dash if it is missing or not finite."""
        shown = self.shown(value)
        if shown is None:
            return "-"
        return f"{shown:.3g}" if abs(shown) >= _HUGE else f"{shown:.{self.digits}f}"

    def page(self) -> dict[str, Any]:
        """Fields of the metric for pages."""
        names = ("key", "label", "unit", "factor", "digits", "better", "log")
        return {name: getattr(self, name) for name in names}

    def column(self) -> dict[str, Any]:
        """Fields of the metric for a page's headline table, whose cells are in the unit."""
        rest = {name: getattr(self, name) for name in ("unit", "digits", "better")}
        return {"key": self.key, "label": self.head, **rest}


def has_values(metric: Metric, numbers: Sequence[float | None]) -> bool:
    """True if a column has a number to show; missing ones are None or NaN."""
    known = [number for number in numbers if number is not None and not np.isnan(number)]
    return any(known) if metric == SKIPPED else bool(known)


def metric_named(name: str) -> Metric:
    """The metric of a user's function."""
    return Metric(name, name.replace("_", " "), digits=3, log=False)


def rate(key: str, label: str, symbol: str = "", *, head: str = "", **look: Any) -> Metric:
    """A share of objects in percent."""
    shown = {"digits": 1, "better": HIGH, **look}
    return Metric(key, label, "%", factor=100.0, head=head, symbol=symbol, log=False, **shown)


def _copy_as(metric: Metric, key: str, label: str, head: str = "", symbol: str = "") -> Metric:
    head = head or label
    return replace(metric, key=key, label=label, head=head, symbol=symbol or head)


INSTANCES = Metric("instances", "instances", digits=0, better=None, symbol="n")
FAILED = Metric("failed", "failed", digits=0, better=None)
SKIPPED = Metric("skipped", "skipped", digits=0, better=None, symbol="skip")
"""Shown only if instances were skipped."""
LEFT_OUT = _copy_as(FAILED, "left_out", "left out", symbol="out")
KEYPOINTS = Metric("keypoints", "keypoints", digits=1, better=None, symbol="kpts")

ROTATION = Metric("rotation_error_deg", "rotation error", "deg", 3, head="R error", symbol="R deg")
TRANSLATION = Metric(
    "translation_error", "translation error", "diagonals", 4, head="t error", symbol="t diag"
)
"""In diagonals of the model's bounding box."""
TRANSLATION_IN_UNITS = replace(TRANSLATION, unit="model units", symbol="t units")
"""For the simulation's random points, which have no bounding box."""
TRANSLATION_OF_DISTANCE = replace(
    TRANSLATION, unit="% of distance", digits=2, factor=100.0, symbol="t %"
)
"""Relative to the distance from the camera to the mean of the points."""
SCALE_Y = Metric(
    "scale_y_error", "scale error s_y", "%", factor=100.0, head="s_y error", symbol="s_y %"
)
SCALE_Z = _copy_as(SCALE_Y, "scale_z_error", "scale error s_z", "s_z error", "s_z %")
BOX_IOU = Metric("box_iou", "box IoU", digits=3, better=HIGH, symbol="IoU", log=False)
TRANSLATION_UP_TO_SCALE = _copy_as(
    TRANSLATION,
    "translation_error_up_to_scale",
    "translation error, up to scale",
    "t error, up to scale",
    "t diag scaled",
)
"""The estimate is first scaled about the camera centre: one image does not determine the size."""
BOX_IOU_UP_TO_SCALE = _copy_as(
    BOX_IOU, "box_iou_up_to_scale", "box IoU, up to scale", symbol="IoU scaled"
)
RMS = Metric("rms_px", "reprojection error", "px", symbol="rms px")

# Relative to the nearest of the poses that symmetry makes equal to the truth.
SYM_ROTATION = _copy_as(
    ROTATION, "sym_rotation_error_deg", "rotation error, symmetry-aware", "R error, sym.", "R deg*"
)
SYM_TRANSLATION = replace(
    TRANSLATION, key="sym_translation_error", label="translation error, symmetry-aware"
)
SYM_BOX_IOU = replace(BOX_IOU, key="sym_box_iou", label="box IoU, symmetry-aware")

SUCCESS = rate("success", "success", "succ %")
SUCCESS_5 = rate("success_5deg_5pct", "within 5 deg, 5 %", "5/5 %*")
OVER_BOUND = Metric("over_limit", "R error / Cramer-Rao bound", better=None)

RANK_1 = rate("rank_1", "true model first", "first %")
RECIPROCAL_RANK = Metric(
    "reciprocal_rank", "mean reciprocal rank", digits=3, better=HIGH, symbol="MRR", log=False
)
NONE = rate("none", "none of the models", "none %", head="none of these", better=None)
"""Should be 0 % in the protocol leave-in and 100 % in leave-out."""
SHAPE_DISTANCE = Metric(
    "shape_distance", "shape distance", "%", factor=100.0, symbol="shape %", log=False
)
QUERY_MILLISECONDS = Metric("milliseconds", "time per instance", "ms", 1, symbol="ms")

KEYPOINT_ERROR = Metric("keypoint_error", "keypoint error", "diagonals", 4, symbol="kp diag")
"""Root mean square distance of all estimated keypoints to the true ones, up to scale."""
# Shares of truths inside stated regions of 68 % and 95 % probability.
_COVERED: dict[str, Any] = {"digits": 0, "better": None}
ROTATION_IN_68 = rate("rotation_in_68", "rotations within 68 %", "R in 68%", **_COVERED)
ROTATION_IN_95 = rate("rotation_in_95", "rotations within 95 %", "R in 95%", **_COVERED)
STRETCH_IN_68 = rate("stretch_in_68", "stretches within 68 %", "s in 68%", **_COVERED)
STRETCH_IN_95 = rate("stretch_in_95", "stretches within 95 %", "s in 95%", **_COVERED)
KEYPOINTS_IN_68 = rate("keypoints_within_68", "keypoints within 68 %", "kp in 68%", **_COVERED)
KEYPOINTS_IN_95 = rate("keypoints_within_95", "keypoints within 95 %", "kp in 95%", **_COVERED)
COVERED = rate("covered", "truths inside the region", **_COVERED)

# Columns that group tasks.
CATEGORY = Metric("category", "category", better=None)
QUERIES = replace(CATEGORY, label="queries", head="queries")
OUTLIERS = Metric("outliers", "outliers", "%", better=None, factor=100.0, log=False)
OUTLIER_SHARE = replace(OUTLIERS, key="outlier_share")
NOISE = Metric("noise_px", "keypoint noise", "px", better=None, log=False)
POINTS = Metric("points", "number of points", better=None)

INSTANCE_METRICS = (
    *(ROTATION, TRANSLATION, SCALE_Y, SCALE_Z, BOX_IOU),
    *(SYM_ROTATION, SYM_TRANSLATION, SYM_BOX_IOU, RMS, TRANSLATION_UP_TO_SCALE),
)
"""Error columns of runs on views of models."""
