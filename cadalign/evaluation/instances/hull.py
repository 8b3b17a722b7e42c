"""Views and keypoint visibility of models without a mesh, from the keypoints alone.

The rule: a keypoint counts as visible if a face of the keypoints' convex hull next to it faces the
camera. Next to it are the faces that it lies on, for one inside the hull those nearest to it, with
a slack of 1 % of the keypoints' extent. Keypoints in one plane, or fewer than 4, all count as
visible. The hull has no holes and no parts that stand before others, so the rule is kinder to
things such as chairs than rays cast at a mesh.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.errors import TooFewVisibleError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera

# The ranges of `cadalign.render.sample_view`.
_ELEVATION_DEG = (0.0, 60.0)
_FILL = (0.7, 0.95)
_ATTEMPTS = 100
_SLACK = 0.01
_SIGNS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])


@dataclass(frozen=True, eq=False)
class KeypointHull:
    """The convex hull of a model's keypoints (k, 3) [model units]."""

    xyz: FloatArray

    @cached_property
    def bounds(self) -> FloatArray:
        """The keypoints' lowest and highest coordinates, (2, 3) float."""
        return np.array([self.xyz.min(axis=0), self.xyz.max(axis=0)])

    @cached_property
    def corners(self) -> FloatArray:
        """The corners of the keypoints' box, from its middle, (8, 3) float."""
        low, high = self.bounds
        return np.asarray((high - low) * (_SIGNS - 0.5))

    def visible_from(self, position: FloatArray) -> npt.NDArray[np.bool_]:
        """Mask (k,) of the keypoints that count as visible from a place (3,) of the model."""
        if self._faces is None:
            return np.ones(len(self.xyz), dtype=bool)
        faces, beside = self._faces
        facing = faces[:, :3] @ position + faces[:, 3] > 0
        return np.asarray((beside & facing).any(axis=1))

    @cached_property
    def _faces(self) -> tuple[FloatArray, npt.NDArray[np.bool_]] | None:
        """Planes (f, 4) of the faces, outward, and a mask (k, f) of those next to each keypoint."""
        from scipy.spatial import ConvexHull, QhullError

        if len(self.xyz) < 4:
            return None
        try:
            planes = ConvexHull(self.xyz).equations
        except QhullError:  # all in one plane
            return None
        depth = -(self.xyz @ planes[:, :3].T + planes[:, 3])
        slack = _SLACK * float(np.linalg.norm(np.ptp(self.xyz, axis=0)))
        return planes, depth <= depth.min(axis=1, keepdims=True) + slack


def sample_hull_view(
    hull: KeypointHull, camera: Camera, *, rng: np.random.Generator, min_visible: int
) -> tuple[Alignment, npt.NDArray[np.bool_]]:
    """Draw a view, as `cadalign.render.sample_view` does, in which enough keypoints count as seen.

    Returns the pose and a mask (k,) of the visible keypoints; raises TooFewVisibleError if no view
    shows enough of them. The camera has no lens distortion.
    """
    count = len(hull.xyz)
    best = 0
    if count >= min_visible:
        low, high = np.sin(np.radians(_ELEVATION_DEG))
        middle = hull.bounds.mean(axis=0)
        for _ in range(_ATTEMPTS):
            azimuth = rng.uniform(-np.pi, np.pi)
            rotation = _upright_rotation(azimuth, float(np.arcsin(rng.uniform(low, high))))
            center = _framed_center(hull.corners @ rotation.T, camera, fill=rng.uniform(*_FILL))
            translation = center - rotation @ middle
            visible = hull.visible_from(-rotation.T @ translation)
            if visible.sum() >= min_visible:
                return Alignment(rotation, translation, np.ones(3), is_valid=True), visible
            best = max(best, int(visible.sum()))
    found = f"the best of {_ATTEMPTS} views shows {best}" if best else f"there are only {count}"
    raise TooFewVisibleError(
        f"{min_visible} keypoints should be visible, but {found}",
        where="keypoints",
        fix="lower min_visible, or leave this model out",
    )


def _upright_rotation(azimuth: float, elevation: float) -> FloatArray:
    """Model to camera, the model's y axis up in the image; angles [rad] as in `look_at`."""
    sin_a, cos_a = np.sin(azimuth), np.cos(azimuth)
    sin_e, cos_e = np.sin(elevation), np.cos(elevation)
    return np.array(
        [
            [cos_a, 0.0, -sin_a],
            [sin_e * sin_a, -cos_e, sin_e * cos_a],
            [-cos_e * sin_a, -sin_e, -cos_e * cos_a],
        ]
    )


def _framed_center(corners: FloatArray, camera: Camera, *, fill: float) -> FloatArray:
    """Place in the camera frame of a box's centre, for its corners to fill a share of the image.

    ``corners`` (8, 3) are relative to the centre. The corner X of a box at depth d on the ray a
    through the image's centre lies f |X - a X_z| / (X_z + d) off it; solved for d, for each corner
    and direction, the largest d keeps all of them inside.
    """
    size = np.array([camera.width, camera.height])
    focal = np.array([camera.fx, camera.fy])
    ray = ((size - 1) / 2 - (camera.cx, camera.cy)) / focal
    across = np.abs(corners[:, :2] - ray * corners[:, 2:])
    depth = float((2 * focal * across / (size * fill) - corners[:, 2:]).max())
    return depth * np.append(ray, 1.0)
