"""Bias of a contour's extraction: the model's silhouette, extracted as the mask's contour was.

Smoothing rounds corners off, and pixels quantise a contour. The silhouette that the model has in
the same pixels is displaced in the same way, so that the difference of the two contours is free of
both.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.fitting.contours.contour import Contour, Image, sampled, smoothed
from cadalign.fitting.contours.rims import Rims
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.projection import model_rays
from cadalign.geometry.raycaster import RayCaster

_REACH = 2.0  # [px], between a rim and the contour that is extracted from its silhouette
_STEP = 0.25
_BAND = 13  # [px], about the rims, that smoothing and reach depend on


class MaskImage(NamedTuple):
    """A mask (h, w) of probabilities, and the image whose level line is its contour."""

    inside: Image
    level: Image


def mask_image(mask: FloatArray | BoolArray) -> MaskImage:
    """A mask with its smoothed image."""
    inside = np.ascontiguousarray(mask, dtype=np.float32)
    return MaskImage(inside, smoothed(inside))


def extraction_bias(
    caster: RayCaster,
    camera: Camera,
    pose: Alignment,
    mask: MaskImage,
    contour: Contour,
    rims: Rims,
) -> FloatArray:
    """Distances (S,) [px] by which rims lie outside of the contour that extraction makes of them.

    Zero where there is no rim, or no such contour near it.
    """
    rows = np.flatnonzero(rims.found)
    bias = np.zeros(len(rims.found))
    if not len(rows):
        return bias
    some, offsets = contour.taken(rows), rims.offset[rows]
    rendered = smoothed(_rendered(caster, camera, pose, mask, some, offsets))
    own = _crossings(rendered, some, offsets) - _crossings(mask.level, some, np.zeros(len(rows)))
    bias[rows] = np.nan_to_num(offsets - own)
    return np.where(np.abs(bias) < _REACH, bias, 0.0)


def _rendered(
    caster: RayCaster,
    camera: Camera,
    pose: Alignment,
    mask: MaskImage,
    contour: Contour,
    offsets: FloatArray,
) -> Image:
    """The model's silhouette (h, w) near its rims, the mask elsewhere."""
    height, width = mask.inside.shape
    places = np.rint(contour.points + offsets[:, None] * contour.normals).astype(int)
    columns, rows = np.clip(places, 0, [width - 1, height - 1]).T
    near = np.zeros((height, width), dtype=np.uint8)
    near[rows, columns] = 1
    near = np.asarray(cv2.dilate(near, np.ones((_BAND, _BAND), np.uint8)), dtype=np.uint8)
    rows, columns = np.nonzero(near)
    rays, valid = camera.normalize_where_valid(np.stack([columns, rows], axis=1).astype(float))
    origin, model_from_ray = model_rays(pose)
    directions = rays @ model_from_ray[:, :2].T + model_from_ray[:, 2]
    rendered = mask.inside.copy()
    rendered[rows, columns] = caster.covered(origin, directions) & valid
    return rendered


def _crossings(level: Image, contour: Contour, offsets: FloatArray) -> FloatArray:
    """Places (S,) on the normals, next to ``offsets`` (S,), where a level line is left; or NaN."""
    steps = np.arange(-_REACH, _REACH + _STEP / 2, _STEP)
    places = offsets + steps[:, None]
    along = contour.points + places[..., None] * contour.normals
    values = sampled(level, along.reshape(-1, 2)).reshape(places.shape)
    falls = (values[:-1] >= 0.5) & (values[1:] < 0.5)
    distance = np.where(falls, np.abs(steps[:-1] + _STEP / 2)[:, None], np.inf)
    nearest = distance.argmin(axis=0)
    every = np.arange(len(offsets))
    before, after = values[nearest, every], values[nearest + 1, every]
    with np.errstate(divide="ignore", invalid="ignore"):
        found = places[nearest, every] + _STEP * (before - 0.5) / (before - after)
    return np.where(np.isfinite(distance[nearest, every]), found, np.nan)
