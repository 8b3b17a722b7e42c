"""How metrics and methods are named, scaled and coloured in a report."""

from __future__ import annotations

import colorsys
from dataclasses import asdict, dataclass
from typing import Any

from cadalign.evaluation.accuracy.methods import LIMIT
from cadalign.evaluation.accuracy.style import look_of

LOW, HIGH = "low", "high"
"""Which values are better."""
_INK, _INK_ON_DARK = "#1b1d21", "#e8e9ec"
_LEAST_LIGHTNESS_ON_DARK = 0.62


@dataclass(frozen=True)
class Metric:
    """A column of a result table.

    Parameters
    ----------
    key : str
        The column's name.
    label : str
    unit : str
        Empty for pure numbers.
    factor : float
        Shown is the value times this.
    digits : int
        Shown after the point.
    better : {"low", "high"}
    log : bool
        Whether it is best seen on a logarithmic axis.
    limit : float
        Where cumulative curves end, in the unit.
    """

    key: str
    label: str
    unit: str = ""
    factor: float = 1.0
    digits: int = 2
    better: str = LOW
    log: bool = True
    limit: float = 1.0

    def to_dict(self) -> dict[str, Any]:
        """The metric for the page."""
        return asdict(self)


METRICS = (
    Metric("rotation_error_deg", "rotation error", "deg", limit=20.0),
    Metric("translation_error", "translation error", "diagonals", digits=4, limit=0.2),
    Metric("scale_y_error", "error of s_y", "%", factor=100.0, limit=20.0),
    Metric("scale_z_error", "error of s_z", "%", factor=100.0, limit=20.0),
    Metric("box_iou", "box IoU", digits=3, better=HIGH, log=False),
    Metric("sym_rotation_error_deg", "rotation error, symmetry-aware", "deg", limit=20.0),
    Metric(
        "sym_translation_error",
        "translation error, symmetry-aware",
        "diagonals",
        digits=4,
        limit=0.2,
    ),
    Metric("sym_box_iou", "box IoU, symmetry-aware", digits=3, better=HIGH, log=False),
    Metric("rms_px", "reprojection error", "px", limit=5.0),
)
"""The metrics of runs over views of models."""


def method_dict(name: str) -> dict[str, Any]:
    """A method for the page."""
    look = look_of(name)
    is_limit = name == LIMIT
    return {
        "key": name,
        "label": look.label,
        "color": _INK if is_limit else look.color,
        "color_dark": _INK_ON_DARK if is_limit else _on_dark(look.color),
        "dash": "dash" if is_limit else "solid",
        "is_limit": is_limit,
    }


def _on_dark(color: str) -> str:
    """The colour, made lighter if it would hardly be seen on a dark ground."""
    red, green, blue = (int(color[place : place + 2], 16) / 255 for place in (1, 3, 5))
    hue, lightness, saturation = colorsys.rgb_to_hls(red, green, blue)
    lighter = colorsys.hls_to_rgb(hue, max(lightness, _LEAST_LIGHTNESS_ON_DARK), saturation)
    return "#" + "".join(f"{round(255 * part):02x}" for part in lighter)
