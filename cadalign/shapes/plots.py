"""Small picture and table of a shape model in notebooks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cadalign.notebook import card, draw_picture
from cadalign.shapes.parts import BOX_ROWS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from cadalign.shapes.model import ShapeModel

_SHOWN_MODES = 5
# Rows are the picture's right and up for each up axis, seen obliquely.
_OBLIQUE = {"x": ((0, 1, 0.4), (1, 0, 0.3)), "y": ((1, 0, 0.4), (0, 1, 0.3)),
            "z": ((1, 0.4, 0), (0, 0.3, 1))}  # fmt: skip


def shape_html(model: ShapeModel) -> str:
    """HTML of a shape model: its mean keypoints and their standard deviations, and a table."""
    largest = max(model.components, key=lambda component: component.weight)
    total = max(float(np.trace(largest.covariance)), 1e-300)
    shares = ", ".join(f"{100 * share / total:.0f}" for share in largest.variance[:_SHOWN_MODES])
    rows = [
        ("category", model.category),
        ("keypoints", str(len(model.ids))),
        ("models", "given" if model.training is None else str(len(model.training))),
        ("components", str(len(model.components))),
        ("modes", f"{len(largest.modes)}; the first hold {shares or '0'} % of the variance"),
        ("up axis", model.up_axis or "unknown"),
        ("unit", model.unit),
    ]
    return card("ShapeModel", rows, picture=draw_picture(lambda axes: _draw(axes, model)))


def _draw(axes: Axes, model: ShapeModel) -> None:
    largest = max(model.components, key=lambda component: component.weight)
    view = np.array(_OBLIQUE[model.up_axis or "y"], dtype=float)
    keypoints = largest.mean[:-BOX_ROWS] @ view.T
    moved = largest.modes[:, :-BOX_ROWS] @ view.T
    spread = np.sqrt((moved**2).sum(axis=0) + largest.residual_sigma**2)
    x, y = keypoints.T
    x_std, y_std = spread.T
    axes.errorbar(x, y, xerr=x_std, yerr=y_std, fmt="o", color="#3366cc", ecolor="0.6")
    for label, place in zip(model.ids, keypoints, strict=True):
        axes.annotate(str(label), place, xytext=(4, 4), textcoords="offset points", fontsize=7)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.15)
    axes.set_axis_off()
