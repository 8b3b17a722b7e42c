"""A result as text for terminals."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from cadalign.estimation.result import Result


def text_of(result: Result) -> str:
    """Keypoints, rotation, translation, stretch, focal length, alternatives, warnings."""
    count, of = int(result.inliers.sum()), len(result.inliers)
    some = f"{count}" if count == of else f"{count} of {of}"
    views = "" if len(result.views) == 1 else f" in {len(result.views)} views"
    std, pose = result.std, result.alignment
    angle = np.degrees(np.arccos(np.clip((np.trace(pose.rotation) - 1) / 2, -1, 1)))
    rotation = f"{angle:.4g} deg from the camera's axes"
    translation = f"({', '.join(f'{value:.4g}' for value in pose.translation)})"
    stretch = [f"{value:.4g}" for value in result.stretch]
    known_to = ""
    if std is not None:
        rotation += f", +- {std.rotation_deg:.2g} deg"
        translation += f" +- ({', '.join(f'{value:.2g}' for value in std.translation)})"
        stretch = [
            text if deviation == 0 else f"{text} +- {100 * deviation:.2g} %"
            for text, deviation in zip(stretch, std.scale, strict=True)
        ]
        known_to = f" +- {100 * std.focal:.2g} %"
    lines = [
        f"{result.method}: {some} keypoints{views}, rms {result.rms:.3g} px",
        f"  rotation     {rotation}",
        f"  translation  {translation}",
        f"  stretch      ({', '.join(stretch)})",
    ]
    if result.equal_under_symmetry:
        lines.append(f"  symmetry     {result.equal_under_symmetry}")
    if result.focal == "estimate":
        lines.append(f"  focal length {result.camera.fx:.4g} px{known_to}")
    lines.extend(
        f"  also likely  ({other.relative_likelihood:.2g} x): scale "
        f"({', '.join(f'{value:.4g}' for value in other.alignment.scale)})"
        for other in result.alternatives
    )
    lines.extend(f"  warning      {text}" for text in result.warnings)
    return "\n".join(lines)
