"""Evidence beside keypoints: how well each piece agrees with an estimate, and its equations."""

from __future__ import annotations

import numpy as np

from cadalign.estimation.prior import has_scale_prior
from cadalign.estimation.result_parts import EvidenceSummary
from cadalign.solvers.joint.evidence import (
    Evidence,
    State,
    depths_along_axes,
    distances_of,
    kept_rows,
    points_of,
    seen_in_cameras,
)

_OUTLIER = 8.0  # [sigma], of a depth: it is that of something else


def redundancy_of(evidence: Evidence) -> int:
    """Equations, those of priors on the lengths included, minus unknowns; what is exact is none."""
    whitening, depths = evidence.sightings.whitening, evidence.sightings.depths
    # Two of a keypoint's ray, one of a ray along a contour's normal.
    count = int(
        (whitening[:, 2] > 0).sum() + whitening.any(axis=1).sum() + (depths[:, 1] > 0).sum()
    )
    count += 2 * len(evidence.directions.image) + len(evidence.offsets.weight)
    if has_scale_prior(evidence.scales):
        count += int(np.linalg.matrix_rank(evidence.scales.precision))
    return count - 6 * int(evidence.rig.pose.max() + 1) - int(evidence.scales.free.sum())


def summaries_of(evidence: Evidence, state: State) -> list[EvidenceSummary]:
    """Root mean square residuals of all but keypoints and outlines, kind by kind."""
    points, poses = points_of(evidence.shape, state), state.poses
    some = kept_rows(evidence.sightings, evidence.sightings.depths[:, 1] > 0)
    depths = depths_along_axes(evidence, poses, points[some.point], some.image) - some.depths[:, 0]
    directions, offsets = evidence.directions, evidence.offsets
    seen = [
        seen_in_cameras(evidence, poses, ends, directions.image)
        for ends in (directions.model, 0.0 * directions.model)
    ]
    turned = seen[0] - seen[1] - directions.camera
    across = np.linalg.norm(np.einsum("nij,nj->ni", directions.whitening, turned), axis=1)
    angles = np.degrees(2 * np.arcsin(np.minimum(np.linalg.norm(turned, axis=1) / 2, 1.0)))
    lengths = distances_of(evidence, poses, points) - offsets.value
    tables = (
        ("depth", some.image, depths, depths * some.depths[:, 1], "", 1),
        ("gravity", directions.image, angles, across, "deg", 2),
        ("length", offsets.image, lengths, lengths * offsets.weight, "", 1),
    )
    found = []
    for kind, image, errors, whitened, unit, equations in tables:
        for view in np.unique(image).tolist():
            rows = image == view
            counted = rows & (np.abs(whitened) < _OUTLIER)
            rows = counted if counted.any() else rows
            count = int(rows.sum())
            in_sigmas = float(np.sqrt((whitened[rows] ** 2).sum() / (equations * count)))
            rms = float(np.sqrt((errors[rows] ** 2).mean()))
            name = kind if kind != "length" else "size" if view < 0 else "camera height"
            number = None if view < 0 else view
            found.append(EvidenceSummary(name, number, count, in_sigmas, rms, unit))
    return found
