"""Layers of pictures: model, edges, keypoints and their uncertainty; contact sheets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from cadalign.arrays import FloatArray, as_floats, as_points
from cadalign.errors import InputError
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.render.canvas import (
    CASING,
    ByteImage,
    Canvas,
    Color,
    LegendEntry,
    composite,
)
from cadalign.render.scene import LIGHT_GREY, Frame, Geometry
from cadalign.render.viewpoints import seen_in_image

_SHADED_OPACITY, _VEIL_OPACITY = 0.6, 0.5
# Share of the shading in the veil's colour, which makes the model's parts distinguishable.
_OWN_SHARE = 0.45
_LINE_OPACITY = 0.9
_CASING_OPACITY = 0.45
# Least angle between the normals of neighbouring pixels on both sides of an edge [degrees].
_EDGE_ANGLE = 25.0
# Least difference of their depths, as a share of the depth.
_DEPTH_STEP = 0.02


def blend_model(image: ByteImage, geometry: Geometry, color: Color) -> ByteImage:
    """Blend a model over an image: a `Frame` in its own colours, other geometry as a coloured veil.

    Raises InputError if the sizes differ.
    """
    if geometry.depth.shape != image.shape[:2]:
        rows, columns = geometry.depth.shape
        raise InputError(
            f"it is {columns} x {rows} px, the image {image.shape[1]} x {image.shape[0]}",
            where="est_frame",
            fix="render the model with the image's camera",
        )
    if isinstance(geometry, Frame):
        front = geometry.color.astype(np.float32)
        front[:, :, 3] *= _SHADED_OPACITY
        return composite((front + np.float32(0.5)).astype(np.uint8), image)
    grey = np.float32(0.35) + np.float32(0.65) * np.abs(geometry.normal[:, :, 2:])
    # White in the light, the colour itself in between, dark in the shade.
    tinted = np.minimum(2 * grey, 1) * np.array(color, np.float32) + np.maximum(2 * grey - 1, 0) * (
        255 - np.array(color, np.float32)
    )
    front = _OWN_SHARE * 255 * grey + (1 - _OWN_SHARE) * tinted
    share = _VEIL_OPACITY * geometry.mask.astype(np.float32)[:, :, None]
    return np.asarray(image * (1 - share) + front * share + 0.5, dtype=np.uint8)


def feature_lines(geometry: Geometry) -> npt.NDArray[np.bool_]:
    """Pixels on the object's outline, or on a crease or depth step of its surface, (h, w) bool."""
    lines = np.zeros(geometry.depth.shape, dtype=bool)
    for first, second in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        one, other = geometry.mask[first], geometry.mask[second]
        both = one & other
        cosine = np.einsum("rck,rck->rc", geometry.normal[first], geometry.normal[second])
        near, far = geometry.depth[first], geometry.depth[second]
        # The depth of a surface seen at a grazing angle changes quickly without a step.
        slope = np.maximum(np.abs(geometry.normal[first][:, :, 2]), 0.05)
        step = np.abs(near - far) * slope > _DEPTH_STEP * np.minimum(near, far)
        changes = both & ((cosine < np.cos(np.radians(_EDGE_ANGLE))) | step)
        # The line is on the nearer side of a step, and on the object's side of an outline.
        lines[first] |= (one & ~other) | (changes & (near <= far))
        lines[second] |= (other & ~one) | (changes & (near > far))
    return lines


def draw_lines(canvas: Canvas, geometry: Geometry, color: Color) -> None:
    """Draw a model's outline and edges on a canvas, with a dark casing."""
    lines = feature_lines(geometry).astype(np.float32)
    rows, columns = canvas.image.shape[:2]
    thick = max(1, round(canvas.unit * geometry.depth.shape[0] / rows))
    if thick > 1:
        lines = np.asarray(cv2.dilate(lines, np.ones((thick, thick), np.uint8)), np.float32)
    wide = cv2.dilate(lines, np.ones((3, 3), np.uint8))
    for share, shade, opacity in ((wide, CASING, _CASING_OPACITY), (lines, color, _LINE_OPACITY)):
        soft = cv2.resize(share, (columns, rows), interpolation=cv2.INTER_LINEAR)
        weight = opacity * soft[:, :, None]
        mixed = canvas.image * (1 - weight) + np.array(shade, np.float32) * weight
        canvas.image = np.asarray(mixed + 0.5, dtype=np.uint8)


# Keypoints ----------------------------------------------------------------------------------------

OBSERVED_COLOR: Color = (255, 255, 255)
REPROJECTED_COLOR: Color = (255, 222, 40)
OUTLIER_COLOR: Color = (140, 140, 140)
UNSEEN_COLOR: Color = (255, 150, 225)

REGION_SHARE = 0.95
"""Probability that a region of uncertainty holds its keypoint."""
_REGION_OPACITY = 0.6
_REGION_POINTS = 48
_LEAST_REGION = 3.0  # px across; smaller ones are hidden by the markers


@dataclass(frozen=True, eq=False)
class KeypointMarks:
    """Keypoints to draw [px]; arrays are empty where there is nothing to draw.

    ``observed`` (k, 2), ``reprojected`` (m, 2), ``unseen`` (n, 2) and ``outliers`` (o, 2) are
    points, ``residuals`` (r, 2, 2) lines between two points, ``regions`` (q, j, 2) closed curves.
    """

    observed: FloatArray
    reprojected: FloatArray
    unseen: FloatArray
    regions: FloatArray
    outliers: FloatArray
    residuals: FloatArray

    @classmethod
    def from_arrays(
        cls,
        observed: npt.ArrayLike | None,
        reprojected: npt.ArrayLike | None,
        unseen: npt.ArrayLike | None,
        regions: npt.ArrayLike | None,
        outliers: npt.ArrayLike | None,
    ) -> KeypointMarks:
        """Convert arguments of `draw_overlay`; raises InputError if their shapes don't match."""
        given = {"observed": observed, "unseen": unseen, "outliers": outliers}
        points = {
            name: as_points(np.empty((0, 2)) if each is None else each, name=name, dimension=2)
            for name, each in given.items()
        }
        seen = points["observed"]
        back = np.full_like(seen, np.inf)
        if reprojected is not None:
            back = as_floats(reprojected, name="reprojected", shape=(None, 2), finite=False)
            if observed is None:
                seen = np.full_like(back, np.inf)
        if len(seen) != len(back):
            what = f"{len(back)} keypoints, but {len(seen)} observed ones"
            raise InputError(what, where="reprojected")
        curves = np.empty((0, 1, 2)) if regions is None else regions
        return cls(
            **points,
            reprojected=_finite(back),
            regions=as_floats(curves, name="regions", shape=(None, None, 2)),
            residuals=_finite(np.stack([seen, back], axis=1)),
        )

    @property
    def _markers(self) -> list[tuple[FloatArray, LegendEntry, float]]:
        """Points, legend entry and radius of each kind, in drawing order."""
        return [
            (self.observed, ("observed", OBSERVED_COLOR, "ring"), 5),
            (self.reprojected, ("reprojected", REPROJECTED_COLOR, "cross"), 3.5),
            (self.outliers, ("left out", OUTLIER_COLOR, "ring"), 5),
            (self.unseen, ("not observed", UNSEEN_COLOR, "ring"), 2.5),
        ]

    def draw(self, canvas: Canvas) -> None:
        """Draw regions, residuals, rings and crosses."""
        before = canvas.image.copy()
        for region in self.regions:
            canvas.line(np.concatenate([region, region[:1]]), UNSEEN_COLOR, width=0.7)
        canvas.fade(before, opacity=_REGION_OPACITY)
        for pair in self.residuals:
            canvas.line(pair, REPROJECTED_COLOR, width=1.0)
        for points, (_, color, marker), radius in self._markers:
            draw = canvas.ring if marker == "ring" else canvas.cross
            for point in points:
                draw(point, color, radius=radius)

    @property
    def legend(self) -> list[LegendEntry]:
        """Legend entries of what is drawn."""
        entries = [entry for points, entry, _ in self._markers if len(points)]
        if len(self.regions):
            entries.append((f"{100 * REGION_SHARE:.0f} % region", UNSEEN_COLOR, "line"))
        return entries

    @property
    def pixels(self) -> FloatArray:
        """Pixels of the keypoints, (n, 2)."""
        return np.concatenate([points for points, *_ in self._markers])


def confidence_regions(points_2d: FloatArray, covariances: FloatArray) -> FloatArray:
    """Outlines (k, 48, 2) of confidence ellipses, with the probability `REGION_SHARE`.

    ``points_2d`` (n, 2) [px] are the centres, ``covariances`` (n, 2, 2) [px squared]. Ellipses less
    than 3 px across are omitted.

    Examples
    --------
    >>> (ellipse,) = confidence_regions(np.zeros((1, 2)), np.diag([4.0, 9.0])[None])
    >>> np.abs(ellipse).max(axis=0).round(2).tolist()  # 2.45 standard deviations
    [4.9, 7.34]
    """
    values, vectors = np.linalg.eigh(covariances)
    # The quantile of chi-square with two degrees of freedom.
    reach = np.sqrt(-2 * np.log(1 - REGION_SHARE) * np.maximum(values, 0.0))
    kept = 2 * reach[:, -1] >= _LEAST_REGION
    angles = np.linspace(0, 2 * np.pi, _REGION_POINTS, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles)])
    axes = vectors[kept] * reach[kept, None, :]
    return np.asarray(points_2d[kept, None] + (axes @ circle).swapaxes(1, 2))


def _finite(points: FloatArray) -> FloatArray:
    """Rows that are finite, which means in front of the camera."""
    return np.asarray(points[np.isfinite(points).all(axis=tuple(range(1, points.ndim)))])


# Pictures of the model alone ----------------------------------------------------------------------

_TEXT_COLOR = (70, 76, 84)
_HIDDEN_COLOR = (150, 160, 175)


def keypoint_picture(
    image: ByteImage,
    camera: Camera,
    points_3d: FloatArray,
    cam_from_model: Alignment,
    visible: npt.NDArray[np.bool_],
) -> ByteImage:
    """Draw numbered keypoints (k, 3) on a picture: ``visible`` ones (k,) yellow, others grey."""
    canvas = Canvas(image)
    in_camera = cam_from_model.apply(points_3d)
    inside = seen_in_image(camera, in_camera)
    # Visible ones last, on top of the others.
    for row in sorted(np.flatnonzero(inside), key=lambda row: bool(visible[row])):
        color = REPROJECTED_COLOR if visible[row] else _HIDDEN_COLOR
        (place,) = camera.project(in_camera[row : row + 1])
        canvas.ring(place, color, radius=4)
        canvas.label(str(row), place + np.array([11, -9]) * canvas.unit, color)
    return canvas.finish()


def contact_sheet(pictures: Mapping[str, ByteImage]) -> ByteImage:
    """Arrange pictures of one size in a grid, each above its name."""
    height, width = next(iter(pictures.values())).shape[:2]
    across = int(np.ceil(np.sqrt(len(pictures))))
    down = -(-len(pictures) // across)
    gap = max(4, min(height, width) // 40)
    line = max(14, height // 16)
    size = (across * (width + gap) + gap, down * (height + line + gap) + gap)
    sheet = Image.new("RGB", size, LIGHT_GREY)
    pen = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(size=0.72 * line)
    for number, (label, image) in enumerate(pictures.items()):
        left = gap + number % across * (width + gap)
        top = gap + number // across * (height + line + gap)
        sheet.paste(Image.fromarray(image), (left, top))
        middle = (left + width / 2, top + height + line / 2)
        pen.text(middle, label, fill=_TEXT_COLOR, font=font, anchor="mm")
    return np.array(sheet)
