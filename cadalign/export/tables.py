"""Rows of tables of results."""

from __future__ import annotations

from typing import Any

import numpy as np

from cadalign.geometry.rotations import quat_wxyz_from_rotation

RESULT_COLUMNS: tuple[tuple[str, type], ...] = (
    *(("status", str), ("reason", str), ("method", str)),
    *(("views", int), ("keypoints", int), ("inliers", int)),
    *((f"q{axis}", float) for axis in "wxyz"),
    *((f"t{axis}", float) for axis in "xyz"),
    *((f"scale_{axis}", float) for axis in "xyz"),
    *(("focal_length", float), ("sigma", float), ("rotation_std_deg", float)),
    *((f"t{axis}_std", float) for axis in "xyz"),
    *((f"scale_{axis}_std", float) for axis in "xyz"),
    *(("focal_length_std", float), ("rms_px", float), ("cost", float)),
    *(("alternatives", int), ("uncertain", str)),
    *(("warning_count", int), ("warning_kinds", str), ("warnings", str)),
)
"""Names and types of the cells of a result in every table."""


def failed_row(reason: str) -> dict[str, Any]:
    """The cells of a problem without solution."""
    texts = ("method", "uncertain", "warning_kinds", "warnings")
    return {"status": "failed", "reason": reason, **dict.fromkeys(texts, "")}


def row_of(result: Any) -> dict[str, Any]:
    """The cells of a `cadalign.Result`, by the names of `RESULT_COLUMNS`."""
    pose, std, warnings = result.alignment, result.std, result.warnings
    sigma: Any = result.sigma
    if sigma is None and result.options is not None:
        sigma = result.options.sigma
    row: dict[str, Any] = {
        "status": "ok",
        "reason": "",
        "method": result.method,
        "views": len(result.views),
        "keypoints": len(result.inliers),
        "inliers": int(result.inliers.sum()),
        "focal_length": result.camera.fx,
        "sigma": None if sigma is None or np.ndim(sigma) else float(sigma),
        "rms_px": result.rms,
        "cost": result.cost,
        "alternatives": len(result.alternatives),
        "uncertain": "; ".join(result.uncertain),
        "warning_count": len(warnings),
        "warning_kinds": "; ".join(each.kind for each in warnings),
        "warnings": "; ".join(each.text for each in warnings),
    }
    by_axis: dict[str, Any] = {"t{}": pose.translation, "scale_{}": pose.scale}
    if std is not None:
        by_axis |= {"t{}_std": std.translation, "scale_{}_std": std.scale}
        row |= {"rotation_std_deg": std.rotation_deg, "focal_length_std": std.focal}
    for name, values in by_axis.items():
        row |= {name.format(axis): float(each) for axis, each in zip("xyz", values, strict=True)}
    quaternion = quat_wxyz_from_rotation(pose.rotation).tolist()
    row |= {f"q{axis}": value for axis, value in zip("wxyz", quaternion, strict=True)}
    return row
