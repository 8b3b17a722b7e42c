"""Parts that the scripts of pictures share."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from cadalign.io.images import write_image

COMMAND = (sys.executable, "-c", "import sys; from cadalign.cli import main; sys.exit(main())")
"""What runs `cadalign`, wherever it is installed."""


def write_row(path: Path, pictures: Sequence[np.ndarray], *, width: int) -> None:
    """Write pictures of one height side by side, shrunk to a width [px] in all."""
    row = np.hstack(pictures)
    height = round(row.shape[0] * width / row.shape[1])
    path.parent.mkdir(parents=True, exist_ok=True)
    write_image(path, cv2.resize(row, (width, height), interpolation=cv2.INTER_AREA))
