"""Masks of objects: files, and what is cut out of a box of the photo."""

from __future__ import annotations

from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray
from cadalign.errors import DataError, InputError
from cadalign.io.images import open_picture, read_mask

_LONGEST_CUT = 800  # side of the photo in which a box is cut out [px]
_LEAST_BOX = 4.0  # [px]
_CUT_ROUNDS = 5


@dataclass(frozen=True)
class MarkedMask:
    """A mask: that of a file, or a drawn one, as the bytes of a PNG file."""

    file: Path | None = None
    sigma: float | None = None  # of its contour [px]
    png: bytes = b""

    @classmethod
    def of(cls, inside: BoolArray) -> MarkedMask:
        """A drawn mask of pixels (h, w)."""
        return cls(png=cv2.imencode(".png", 255 * inside.astype(np.uint8))[1].tobytes())

    def pixels(self, width: int, height: int) -> BoolArray:
        """The mask (h, w); raises DataError if its file is none of that size."""
        if self.file is None:
            with open_picture(BytesIO(self.png), len(self.png), where="mask") as image:
                return np.asarray(image) > 0
        mask = read_mask(self.file)
        if mask.shape != (height, width):
            raise DataError(
                f"the mask has {mask.shape[1]} x {mask.shape[0]} pixels, the photo "
                f"{width} x {height}",
                where=str(self.file),
                fix="give a mask of the photo's size",
            )
        return mask


def cut_out(photo: npt.NDArray[np.uint8], corners: npt.NDArray[np.float64]) -> BoolArray:
    """Segment the object in a box of the photo (h, w, 3) by its colours, by GrabCut.

    ``corners`` (2, 2) are two of the box [px]. Raises InputError if the box is too small, fills the
    photo, or holds nothing that differs.

    Rother, Kolmogorov, Blake, "GrabCut: interactive foreground extraction using iterated graph
    cuts" (2004).
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
        fix = "draw it close around the object"
        raise InputError("the box fills the photo", where="box", fix=fix)
    cv2.setRNGSeed(0)
    bgr = cv2.cvtColor(small, cv2.COLOR_RGB2BGR)
    colors = np.zeros((2, 1, 65))
    whole = (0, 0, 1, 1)  # not used with labels
    cv2.grabCut(bgr, labels, whole, colors[0], colors[1], _CUT_ROUNDS, cv2.GC_INIT_WITH_MASK)
    found = (255 * np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD))).astype(np.uint8)
    if not found.any():
        what = "nothing in the box differs from what is around it"
        raise InputError(what, where="box", fix="draw it closer around the object")
    return np.asarray(cv2.resize(found, (width, height), interpolation=cv2.INTER_LINEAR) >= 128)
