"""The table of metrics: name, label, unit and direction of every number that experiments report.

Result tables, figures, pages, Markdown, CSV and the console all read it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

LOW, HIGH = "low", "high"
_HUGE = 1e9  # as shown; all digits of more would be as long as a line


@dataclass(frozen=True)
class Metric:
    """A number of a result table or of a summary."""

    key: str  # name of the column or field
    label: str  # name in figures and on pages
    unit: str = ""  # empty for pure numbers
    digits: int = 2  # shown after the point
    better: str | None = LOW
    """Low or high, direction; None for what is no quality, such as a count."""
    factor: float = 1.0  # shown is the value times this
    head: str = ""  # name at the head of tables; the label by default
    symbol: str = ""
    """Name, with unit, at the head of the console's narrow tables; the head by default."""
    log: bool = True  # best seen on a logarithmic axis

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
        """Convert a value to the unit; None for what is missing or not finite."""
        return None if value is None or not np.isfinite(value) else self.factor * value

    def text(self, value: Any) -> str:
        """Format a value in the unit, rounded; a dash for what is missing or not finite."""
        return self.rounded(self.shown(value))

    def rounded(self, shown: float | None) -> str:
        """Format a value that is in the unit, or None; a huge one by its power of ten."""
        if shown is None:
            return "-"
        return f"{shown:.3g}" if abs(shown) >= _HUGE else f"{shown:.{self.digits}f}"

    def page(self) -> dict[str, Any]:
        """The metric for the page."""
        names = ("key", "label", "unit", "factor", "digits", "better", "log")
        return {name: getattr(self, name) for name in names}

    def column(self) -> dict[str, Any]:
        """The metric as a column of the page's headline table, whose cells are as shown."""
        rest = {name: getattr(self, name) for name in ("unit", "digits", "better")}
        return {"key": self.key, "label": self.head, **rest}


def told(metric: Metric, numbers: Sequence[float | None]) -> bool:
    """True for a column worth showing, of these numbers, None or NaN where there is none."""
    known = [number for number in numbers if number is not None and not np.isnan(number)]
    return any(known) if metric == SKIPPED else bool(known)


def metric_named(name: str) -> Metric:
    """The metric of a user's function of this name."""
    return Metric(name, name.replace("_", " "), digits=3, log=False)


def rate(key: str, label: str, symbol: str = "", *, head: str = "", **look: Any) -> Metric:
    """A share of objects, in per cent."""
    shown = {"digits": 1, "better": HIGH, **look}
    return Metric(key, label, "%", factor=100.0, head=head, symbol=symbol, log=False, **shown)


def _like(metric: Metric, key: str, label: str, head: str = "", symbol: str = "") -> Metric:
    head = head or label
    return replace(metric, key=key, label=label, head=head, symbol=symbol or head)


INSTANCES = Metric("instances", "instances", digits=0, better=None, symbol="n")
FAILED = Metric("failed", "failed", digits=0, better=None)
SKIPPED = Metric("skipped", "skipped", digits=0, better=None, symbol="skip")
"""Shown only where something was skipped."""
LEFT_OUT = _like(FAILED, "left_out", "left out", symbol="out")
KEYPOINTS = Metric("keypoints", "keypoints", digits=1, better=None, symbol="kpts")

ROTATION = Metric("rotation_error_deg", "rotation error", "deg", 3, head="R error", symbol="R deg")
TRANSLATION = Metric(
    "translation_error", "translation error", "diagonals", 4, head="t error", symbol="t"
)
"""In diagonals of the model's bounding box."""
TRANSLATION_IN_UNITS = replace(TRANSLATION, unit="model units")
"""Metrics of models that have no bounding box: the simulation's random points."""
TRANSLATION_OF_DISTANCE = replace(
    TRANSLATION, unit="% of distance", digits=2, factor=100.0, symbol="t %"
)
"""Over the distance from the camera to the mean of the points."""
SCALE_Y = Metric(
    "scale_y_error", "error of s_y", "%", factor=100.0, head="s_y error", symbol="s_y %"
)
SCALE_Z = _like(SCALE_Y, "scale_z_error", "error of s_z", "s_z error", "s_z %")
BOX_IOU = Metric("box_iou", "box IoU", digits=3, better=HIGH, symbol="IoU", log=False)
TRANSLATION_UP_TO_SCALE = _like(
    TRANSLATION,
    "translation_error_up_to_scale",
    "translation error, up to scale",
    "t error, up to scale",
    "t scaled",
)
"""After the estimate was scaled about the camera centre: one image leaves the size open."""
BOX_IOU_UP_TO_SCALE = _like(
    BOX_IOU, "box_iou_up_to_scale", "box IoU, up to scale", symbol="IoU scaled"
)
RMS = Metric("rms_px", "reprojection error", "px")

# From the nearest truth that looks the same.
SYM_ROTATION = _like(
    ROTATION, "sym_rotation_error_deg", "rotation error, symmetry-aware", "R error, sym.", "R deg*"
)
SYM_TRANSLATION = replace(
    TRANSLATION, key="sym_translation_error", label="translation error, symmetry-aware"
)
SYM_BOX_IOU = replace(BOX_IOU, key="sym_box_iou", label="box IoU, symmetry-aware")

SUCCESS = rate("success", "success", "succ%")
SUCCESS_5 = rate("success_5deg_5pct", "within 5 deg, 5 %", "5/5 %*")
OVER_BOUND = Metric("over_limit", "R error over Cramer-Rao bound", better=None)

RANK_1 = rate("rank_1", "true model first", "first%")
RECIPROCAL_RANK = Metric(
    "reciprocal_rank", "mean reciprocal rank", digits=3, better=HIGH, symbol="MRR", log=False
)
NONE = rate("none", "none of the models", "none%", head="none of these", better=None)
"""More likely none of the library's models than one: false in one protocol, true in the other."""
SHAPE_DISTANCE = Metric(
    "shape_distance", "shape distance", "%", factor=100.0, symbol="shape%", log=False
)
QUERY_MILLISECONDS = Metric("milliseconds", "time of a query", "ms", 1, symbol="ms")

KEYPOINT_ERROR = Metric("keypoint_error", "keypoint error", "diagonals", 4, symbol="kp")
"""Root mean square, up to scale, of a method's estimate of all keypoints."""
# Shares of the truths within regions of a stated probability.
_COVERED: dict[str, Any] = {"digits": 0, "better": None}
ROTATION_IN_68 = rate("rotation_in_68", "rotations within 68 %", "R in 68%", **_COVERED)
ROTATION_IN_95 = rate("rotation_in_95", "rotations within 95 %", "95%", **_COVERED)
STRETCH_IN_68 = rate("stretch_in_68", "stretches within 68 %", "s in 68%", **_COVERED)
STRETCH_IN_95 = rate("stretch_in_95", "stretches within 95 %", "95%", **_COVERED)
KEYPOINTS_IN_68 = rate("keypoints_within_68", "keypoints within 68 %", "kp in 68%", **_COVERED)
KEYPOINTS_IN_95 = rate("keypoints_within_95", "keypoints within 95 %", "95%", **_COVERED)
COVERED = rate("covered", "truths within the region", **_COVERED)

# What tasks are grouped by.
CATEGORY = Metric("category", "category", better=None)
QUERIES = replace(CATEGORY, label="queries", head="queries")
OUTLIERS = Metric("outliers", "outliers", "%", better=None, factor=100.0, symbol="outl", log=False)
OUTLIER_SHARE = replace(OUTLIERS, key="outlier_share")
NOISE = Metric("noise_px", "noise of the keypoints", "px", better=None, log=False)
POINTS = Metric("points", "number of points", better=None)

INSTANCE_METRICS = (
    *(ROTATION, TRANSLATION, SCALE_Y, SCALE_Z, BOX_IOU),
    *(SYM_ROTATION, SYM_TRANSLATION, SYM_BOX_IOU, RMS, TRANSLATION_UP_TO_SCALE),
)
"""Columns of runs over views of models."""
