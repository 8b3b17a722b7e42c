"""Views and keypoint visibility of models without a mesh, from the keypoints alone.

The rule: a keypoint counts as visible if a face of the keypoints' convex hull next to it faces the
camera. Next to it are the faces that it lies on, for one inside the hull those nearest to it, with
a slack of 1 % of the keypoints' extent. Keypoints in one plane, or fewer than 4, all count as
visible. The hull has no holes and no parts that stand before others, so the rule is kinder to
things such as chairs than rays cast at a mesh.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import TooFewVisibleError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera

# The ranges of `cadalign.render.sample_view`: azimuth, the elevation's sine, share of the image.
_LOWEST = np.array([-np.pi, 0.0, 0.7])
_HIGHEST = np.array([np.pi, np.sin(np.radians(60.0)), 0.95])
_ATTEMPTS = 100
_SLACK = 0.01
_CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) - 0.5


@dataclass(frozen=True, eq=False)
class KeypointHull:
    """The convex hull of a model's keypoints (k, 3) [model units]."""

    xyz: FloatArray

    @cached_property
    def bounds(self) -> FloatArray:
        """The keypoints' lowest and highest coordinates, (2, 3) float."""
        return np.array([self.xyz.min(axis=0), self.xyz.max(axis=0)])

    def visible_from(self, position: FloatArray) -> BoolArray:
        """Mask (k,) of the keypoints that count as visible from a place (3,) of the model."""
        if self._faces is None:
            return np.ones(len(self.xyz), dtype=bool)
        faces, beside = self._faces
        facing = faces[:, :3] @ position + faces[:, 3] > 0
        return np.asarray(beside @ facing)  # of truth values: is any of both

    @cached_property
    def _faces(self) -> tuple[FloatArray, BoolArray] | None:
        """Planes (f, 4) of the faces, outward, and a mask (k, f) of those next to each keypoint."""
        from scipy.spatial import ConvexHull, QhullError

        if len(self.xyz) < 4:
            return None
        try:
            planes = ConvexHull(self.xyz).equations
        except QhullError:  # all in one plane
            return None
        depth = -(self.xyz @ planes[:, :3].T + planes[:, 3])
        low, high = self.bounds
        slack = _SLACK * float(np.linalg.norm(high - low))
        return planes, depth <= depth.min(axis=1, keepdims=True) + slack


HullView = tuple[Alignment, BoolArray]
"""A view: the pose, and a mask (k,) of the keypoints that count as visible."""


def sample_hull_view(
    hull: KeypointHull, camera: Camera, *, rng: np.random.Generator, min_visible: int
) -> HullView:
    """Draw a view, as `cadalign.render.sample_view` does, in which enough keypoints count as seen.

    The camera has no lens distortion.

    Raises TooFewVisibleError if no view shows enough of the keypoints.
    """
    (found,) = sample_hull_views([hull], camera, rngs=[rng], min_visible=min_visible)
    if isinstance(found, TooFewVisibleError):
        raise found
    return found


def sample_hull_views(
    hulls: Sequence[KeypointHull],
    camera: Camera,
    *,
    rngs: Sequence[np.random.Generator],
    min_visible: int,
) -> list[HullView | TooFewVisibleError]:
    """Draw a view of each hull as `sample_hull_view` does, from its own random stream."""
    counts = [len(hull.xyz) for hull in hulls]
    found: dict[int, HullView] = {}
    best = [0] * len(hulls)
    left = [k for k, count in enumerate(counts) if count >= min_visible]
    for _ in range(_ATTEMPTS if left else 0):
        draws = np.array([rngs[k].random(3) for k in left])
        bounds = np.array([hulls[k].bounds for k in left])
        poses = _framed_poses(_LOWEST + (_HIGHEST - _LOWEST) * draws, bounds, camera)
        for k, rotation, translation, position in zip(left, *poses, strict=True):
            visible = hulls[k].visible_from(position)
            best[k] = max(best[k], int(np.count_nonzero(visible)))
            if best[k] >= min_visible:
                pose = Alignment(rotation, translation, np.ones(3), is_valid=True)
                found[k] = (pose, visible)
        left = [k for k in left if k not in found]
        if not left:
            break
    return [found.get(k) or _too_few(count, best[k], min_visible) for k, count in enumerate(counts)]


def _too_few(count: int, best: int, min_visible: int) -> TooFewVisibleError:
    found = f"the best of {_ATTEMPTS} views shows {best}" if best else f"there are only {count}"
    return TooFewVisibleError(
        f"{min_visible} keypoints should be visible, but {found}",
        where="keypoints",
        fix="lower min_visible, or leave this model out",
    )


def _framed_poses(
    drawn: FloatArray, bounds: FloatArray, camera: Camera
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Rotations (n, 3, 3), translations (n, 3) and camera positions (n, 3) of framed views.

    ``drawn`` (n, 3) are azimuth, sine of the elevation, and share of the image to fill; ``bounds``
    (n, 2, 3) those of the models.
    """
    low, high = bounds[:, 0], bounds[:, 1]
    rotations = _upright_rotations(drawn[:, 0], np.arcsin(drawn[:, 1]))
    corners = (high - low)[:, None] * _CORNERS @ rotations.transpose(0, 2, 1)
    centers = _framed_centers(corners, camera, fill=drawn[:, 2])
    middles = ((low + high) / 2)[:, :, None]
    translations = centers - (rotations @ middles)[:, :, 0]
    positions = -(rotations.transpose(0, 2, 1) @ translations[:, :, None])[:, :, 0]
    return rotations, translations, positions


def _upright_rotations(azimuths: FloatArray, elevations: FloatArray) -> FloatArray:
    """Model to camera (n, 3, 3), the model's y axis up in the image; angles [rad] of `look_at`."""
    sin_a, cos_a = np.sin(azimuths), np.cos(azimuths)
    sin_e, cos_e = np.sin(elevations), np.cos(elevations)
    rows = [
        *(cos_a, np.zeros_like(sin_a), -sin_a),
        *(sin_e * sin_a, -cos_e, sin_e * cos_a),
        *(-cos_e * sin_a, -sin_e, -cos_e * cos_a),
    ]
    return np.stack(rows, axis=-1).reshape(-1, 3, 3)


def _framed_centers(corners: FloatArray, camera: Camera, *, fill: FloatArray) -> FloatArray:
    """Places (n, 3) in the camera frame of boxes' centres, to fill shares (n,) of the image.

    ``corners`` (n, 8, 3) are relative to the centres. The corner X of a box at depth d on the ray a
    through the image's centre lies f |X - a X_z| / (X_z + d) off it; solved for d, for each corner
    and direction, the largest d keeps all of them inside.
    """
    size = np.array([camera.width, camera.height])
    focal = np.array([camera.fx, camera.fy])
    ray = ((size - 1) / 2 - (camera.cx, camera.cy)) / focal
    across = np.abs(corners[..., :2] - ray * corners[..., 2:])
    depths = 2 * focal * across / (size * fill[:, None, None]) - corners[..., 2:]
    return np.asarray(depths.max(axis=(1, 2))[:, None] * np.append(ray, 1.0))
