"""Evidence of a photo beside its pairs: what a file has, what is marked, and what pixels say."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import DataError, InputError
from cadalign.geometry.camera import Camera
from cadalign.geometry.conventions import vertical_direction
from cadalign.io.evidence import LENGTHS, ImageEvidence, Size
from cadalign.io.images import read_mask
from cadalign.io.observation import Observation
from cadalign.io.observation_file import StartFields

Point2 = tuple[float, float]
Segment = tuple[Point2, Point2]

_LONGEST_CUT = 800  # side of the photo in which a box is cut out [px]
_LEAST_BOX = 4.0  # [px]
_CUT_ROUNDS = 5
_END_SIGMA = 1.0  # of the ends of a vertical edge [px]
_ANY_PITCH = 1e6  # standard deviation of a camera's pitch of which nothing is known [degrees]
_LEAST_UP_SIGMA = 0.5  # objects stand on floors that are not quite level [degrees]
_MOST_UP_SIGMA = 20.0  # [degrees]


@dataclass(frozen=True)
class MarkedMask:
    """A mask: that of a file, or a drawn one, as the runs of `encode_runs`."""

    file: str | None = None
    sigma: float | None = None  # of its contour [px]
    runs: tuple[int, ...] = ()

    def pixels(self, width: int, height: int) -> BoolArray:
        """The mask (h, w); raises DataError if its file is none of that size."""
        if self.file is None:
            return decode_runs(self.runs, width, height)
        mask = read_mask(Path(self.file))
        if mask.shape != (height, width):
            raise DataError(
                f"the mask has {mask.shape[1]} x {mask.shape[0]} pixels, the photo "
                f"{width} x {height}",
                where=self.file,
                fix="give a mask of the photo's size",
            )
        return mask


@dataclass(frozen=True)
class MarkedLengths:
    """Known lengths of the object along x, y, z; relative standard deviations of all or of each."""

    width: float | None = None
    height: float | None = None
    length: float | None = None
    sigmas: tuple[float, ...] = ()

    @classmethod
    def of(cls, size: Size | None) -> MarkedLengths | None:
        """The lengths of an observation."""
        if size is None:
            return None
        sigmas = () if size.sigma is None else tuple(np.atleast_1d(size.sigma).tolist())
        return cls(size.width, size.height, size.length, sigmas)

    @property
    def size(self) -> Size:
        """The lengths as an observation holds them."""
        sigma = list(self.sigmas) if len(self.sigmas) > 1 else next(iter(self.sigmas), None)
        return Size(width=self.width, height=self.height, length=self.length, sigma=sigma)

    def checked(self) -> MarkedLengths | None:
        """The lengths, None if there are none; raises InputError if one is not positive."""
        given = {name: getattr(self, name) for name in LENGTHS}
        if all(value is None for value in given.values()):
            return None
        for name, value in given.items():
            if value is not None and not value > 0:
                what = f"{value:g} is no length"
                raise InputError(what, where=name, fix="give a positive number")
        for value in self.sigmas:
            if not 0 < value < 1:
                raise InputError(
                    f"{100 * value:g} % is no standard deviation of a length",
                    where="sigma",
                    fix="give more than 0 and less than 100 %",
                )
        return self


@dataclass(frozen=True)
class MarkedEvidence:
    """Marks in a photo beside its pairs.

    ``up`` is the model's up axis in the camera, with its standard deviation [degrees], from a file;
    vertical edges take its place. ``photo`` says that the photo itself counts, ``start`` is where
    the search begins while there are few pairs.
    """

    mask: MarkedMask | None = None
    verticals: tuple[Segment, ...] = ()
    up: tuple[float, float, float] | None = None
    up_sigma_deg: float | None = None
    lengths: MarkedLengths | None = None
    photo: bool = False
    start: StartFields | None = None

    @classmethod
    def of(cls, observation: Observation) -> Self:
        """The marks that stand for the evidence of an observation."""
        known, start = observation.evidence, observation.init
        x, y, z = (0.0, 0.0, 0.0) if known.up is None else known.up.tolist()
        return cls(
            mask=None if known.mask is None else MarkedMask(str(known.mask), known.mask_sigma),
            up=None if known.up is None else (x, y, z),
            up_sigma_deg=known.up_sigma_deg,
            lengths=MarkedLengths.of(observation.size),
            photo=bool(observation.fit_options.get("image")),
            start=None if start is None else StartFields.of(start),
        )

    def in_place_of(self, known: ImageEvidence, camera: Camera, mask: Path | None) -> ImageEvidence:
        """The evidence with these marks in place of its own; ``mask`` is the file of theirs.

        Vertical edges tell the upward direction.
        """
        up = None if self.up is None else np.array(self.up)
        found = find_up(self.verticals, camera) or (up, self.up_sigma_deg)
        return replace(
            known,
            mask=mask,
            mask_sigma=None if self.mask is None else self.mask.sigma,
            up=found[0],
            up_sigma_deg=None if found[0] is None else found[1],
        )


def find_up(verticals: tuple[Segment, ...], camera: Camera) -> tuple[FloatArray, float] | None:
    """Direction of vertical edges in the camera, upwards, and its standard deviation [degrees].

    The deviation is that of the worst direction, larger where the edges disagree by more than the
    noise of their ends. None for fewer than two edges, or edges that don't determine it.

    Examples
    --------
    >>> camera = Camera.from_fov(640, 480, fov_x=60.0)
    >>> edges = (((100.0, 100.0), (100.0, 400.0)), ((500.0, 90.0), (500.0, 380.0)))
    >>> up, sigma = find_up(edges, camera)
    >>> np.round(up, 6).tolist()
    [0.0, -1.0, 0.0]
    """
    redundancy = len(verticals) - 2
    if redundancy < 0:
        return None
    try:
        up, covariance, chi_square = vertical_direction(camera, verticals, _END_SIGMA, _ANY_PITCH)
    except InputError:
        return None
    factor = max(1.0, chi_square / redundancy) if redundancy else 1.0
    sigma = math.sqrt(factor * float(np.linalg.eigvalsh(covariance)[-1]))
    return None if sigma > _MOST_UP_SIGMA else (up, max(_LEAST_UP_SIGMA, sigma))


def encode_runs(mask: BoolArray) -> tuple[int, ...]:
    """The numbers of pixels outside and inside in turn, row by row."""
    flat = np.concatenate([[False], mask.ravel()])
    changes = np.flatnonzero(flat[1:] != flat[:-1])
    return tuple(np.diff(np.concatenate([[0], changes, [mask.size]])).tolist())


def decode_runs(runs: tuple[int, ...], width: int, height: int) -> BoolArray:
    """The pixels (h, w) of `encode_runs`; raises InputError if there are more or fewer."""
    if any(run < 0 for run in runs) or sum(runs) != width * height:
        raise InputError(
            f"not the {width} x {height} pixels of the photo",
            where="mask",
            fix="give a mask of the photo's size",
        )
    inside = np.arange(len(runs)) % 2 == 1
    return np.repeat(inside, runs).reshape(height, width)


def cut_out(photo: npt.NDArray[np.uint8], corners: npt.NDArray[np.float64]) -> BoolArray:
    """Segment the object in a box of the photo (h, w, 3) by its colours; see `grab_cut`.

    ``corners`` (2, 2) are two of the box [px]. Raises InputError if the box is too small, fills the
    photo, or holds nothing that differs.
    """
    height, width = photo.shape[:2]
    scale = min(1.0, _LONGEST_CUT / max(width, height))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    small = cv2.resize(photo, size, interpolation=cv2.INTER_AREA)
    low, high = np.clip(np.sort(corners, axis=0), 0, (width - 1, height - 1))
    if (high - low).min() < _LEAST_BOX:
        raise InputError("the box is too small", where="box", fix="draw it around the object")
    left, top = np.floor(low * scale).astype(int).tolist()
    right, bottom = np.ceil(high * scale).astype(int).tolist()
    labels = np.full(small.shape[:2], cv2.GC_BGD, dtype=np.uint8)
    labels[top : bottom + 1, left : right + 1] = cv2.GC_PR_FGD
    if not (labels == cv2.GC_BGD).any():
        raise InputError(
            "the box fills the photo", where="box", fix="draw it close around the object"
        )
    found = grab_cut(small, labels).astype(np.uint8)
    if not found.any():
        raise InputError(
            "nothing in the box differs from what is around it",
            where="box",
            fix="draw it closer around the object",
        )
    whole = cv2.resize(255 * found, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(whole >= 128)


def grab_cut(pixels: npt.NDArray[Any], labels: npt.NDArray[Any]) -> BoolArray:
    """Segment an image (h, w, 3) by its colours, from OpenCV's labels (h, w) of a part of it.

    Rother, Kolmogorov, Blake, "GrabCut: interactive foreground extraction using iterated graph
    cuts" (2004).
    """
    cv2.setRNGSeed(0)
    bgr = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
    colors = np.zeros((2, 1, 65))
    whole = (0, 0, 1, 1)  # not used with labels
    cv2.grabCut(bgr, labels, whole, colors[0], colors[1], _CUT_ROUNDS, cv2.GC_INIT_WITH_MASK)
    return np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD))
