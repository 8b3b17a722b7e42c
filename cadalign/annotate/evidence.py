"""Marks in a photo beside pairs: a mask, vertical edges, and known lengths."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np

from cadalign.annotate.further import FurtherEvidence
from cadalign.arrays import FloatArray
from cadalign.errors import InputError
from cadalign.geometry.camera import Camera
from cadalign.io.evidence import LENGTHS, Size

Point2 = tuple[float, float]
Segment = tuple[Point2, Point2]

_END_SIGMA = 1.0  # of the ends of a vertical edge [px]
_LEAST_UP_SIGMA = 0.5  # objects stand on floors that are not quite level [degrees]
_MOST_UP_SIGMA = 20.0  # [degrees]


@dataclass(frozen=True)
class Stroke:
    """A part of a mask: a polygon, a brush stroke of a ``radius`` [px], or ``runs``.

    Those are the numbers of pixels outside and inside in turn, row by row.
    """

    points: tuple[Point2, ...] = ()
    radius: float | None = None
    runs: tuple[int, ...] = ()
    adds: bool = True  # False to take the part away


@dataclass(frozen=True)
class MaskDrawing:
    """A mask: that of a file, if there is one, with strokes over it in turn."""

    base: str | None = None
    base_sigma: float | None = None  # of its contour [px]
    strokes: tuple[Stroke, ...] = ()


@dataclass(frozen=True)
class MarkedLengths:
    """Known lengths of the object along x, y, z, and relative deviations: of all, or of each."""

    width: float | None = None
    height: float | None = None
    length: float | None = None
    sigmas: tuple[float, ...] = ()

    @classmethod
    def of(cls, size: Size | None) -> MarkedLengths | None:
        """Those of an observation."""
        if size is None:
            return None
        sigmas = () if size.sigma is None else tuple(np.atleast_1d(size.sigma).tolist())
        return cls(size.width, size.height, size.length, sigmas)

    @property
    def size(self) -> Size:
        """Those of an observation."""
        sigma = list(self.sigmas) if len(self.sigmas) > 1 else next(iter(self.sigmas), None)
        return Size(width=self.width, height=self.height, length=self.length, sigma=sigma)


@dataclass(frozen=True)
class MarkedEvidence:
    """Evidence of a photo beside its pairs.

    ``up`` is the model's up axis in the camera with its deviation [degrees], from a file; vertical
    edges take its place.
    """

    mask: MaskDrawing | None = None
    verticals: tuple[Segment, ...] = ()
    up: tuple[float, float, float] | None = None
    up_sigma_deg: float | None = None
    lengths: MarkedLengths | None = None

    @classmethod
    def of(cls, further: FurtherEvidence) -> Self:
        """That of an observation."""
        image = further.image
        x, y, z = (0.0, 0.0, 0.0) if image.up is None else image.up.tolist()
        return cls(
            mask=None if image.mask is None else MaskDrawing(str(image.mask), image.mask_sigma),
            up=None if image.up is None else (x, y, z),
            up_sigma_deg=image.up_sigma_deg,
            lengths=MarkedLengths.of(further.size),
        )

    def added_to(
        self, further: FurtherEvidence, camera: Camera, drawn: Path | None
    ) -> FurtherEvidence:
        """An observation's evidence with this in place of its own.

        ``drawn`` is the file of a mask with strokes, None if nothing is left of it.
        """
        image = further.image
        mask, sigma = (drawn, None)
        if self.mask is not None and not self.mask.strokes:
            mask, sigma = Path(self.mask.base or ""), self.mask.base_sigma
        image = replace(image, mask=mask, mask_sigma=sigma)
        gravity = find_up(self.verticals, camera)
        if gravity is not None:
            image = replace(image, up=gravity[0], up_sigma_deg=gravity[1])
        elif self.up is None:
            image = replace(image, up=None, up_sigma_deg=None)
        else:
            image = replace(image, up=np.array(self.up), up_sigma_deg=self.up_sigma_deg)
        size = None if self.lengths is None else self.lengths.size
        return replace(further, image=image, size=size)


def find_up(verticals: tuple[Segment, ...], camera: Camera) -> tuple[FloatArray, float] | None:
    """The direction of vertical edges in the camera, upwards, and its deviation [degrees].

    Each edge and the camera's centre span a plane that holds the direction: it is the least
    singular vector of the planes' normals, weighted by the edges' lengths. None for fewer than two
    edges, or edges that don't determine it.

    Examples
    --------
    >>> camera = Camera.from_fov(640, 480, fov_x=60.0)
    >>> edges = (((100.0, 100.0), (100.0, 400.0)), ((500.0, 90.0), (500.0, 380.0)))
    >>> up, sigma = find_up(edges, camera)
    >>> np.round(up, 6).tolist()
    [0.0, -1.0, 0.0]
    """
    if len(verticals) < 2:
        return None
    ends = np.array(verticals, dtype=float)
    rays = np.ones((len(ends), 2, 3))
    rays[:, :, :2] = camera.normalize(ends.reshape(-1, 2)).reshape(-1, 2, 2)
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    normals = np.cross(rays[:, 0], rays[:, 1])
    angle = np.linalg.norm(normals, axis=1, keepdims=True)
    # A plane turns about its edge by the noise of both ends over the edge's length.
    sigma = math.sqrt(2) * _END_SIGMA / camera.fx / np.maximum(angle, 1e-12)
    _, values, directions = np.linalg.svd(normals / np.maximum(angle, 1e-12) / sigma)
    redundancy = len(ends) - 2
    if len(values) < 2 or not values[1] > 0:
        return None
    least = values[2] if len(values) > 2 else 0.0
    factor = math.sqrt(max(1.0, least**2 / redundancy)) if redundancy else 1.0
    deviation = max(_LEAST_UP_SIGMA, math.degrees(factor / values[1]))
    if deviation > _MOST_UP_SIGMA:
        return None
    up = directions[2] * (-1.0 if directions[2][1] > 0 else 1.0)
    return up, float(deviation)


def check_lengths(lengths: MarkedLengths) -> MarkedLengths | None:
    """The lengths, None if there are none; raises InputError if one is not positive."""
    given = {name: getattr(lengths, name) for name in LENGTHS}
    if all(value is None for value in given.values()):
        return None
    for name, value in given.items():
        if value is not None and not value > 0:
            raise InputError(f"{value:g} is no length", where=name, fix="give a positive number")
    for value in lengths.sigmas:
        if not 0 < value < 1:
            raise InputError(
                f"{100 * value:g} % is no deviation of a length",
                where="sigma",
                fix="give more than 0 and less than 100 %",
            )
    return lengths
