"""The files that the README's snippets read: a photo, and the OBJ of a similar chair."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np

README = Path(__file__).resolve().parents[2] / "README.md"
OBJ = """
v -.2 0 .2
v .2 0 .2
v .2 .1 -.2
v -.2 .1 -.2
v .18 .5 -.25
v -.18 .55 -.25
f 1 2 3 4
f 4 3 5 6
"""


def write_files(folder: Path) -> None:
    """Write chair.obj, a seat and a back, and photo.jpg, which shows them at the clicked pixels."""
    (folder / "chair.obj").write_text(OBJ.lstrip())
    listed = re.search(r"^photo = (\[\[.*?\]\])", README.read_text("utf-8"), re.DOTALL | re.M)
    assert listed is not None
    clicks = np.array(eval(re.sub(r"#.*", "", listed[1])), np.int32)
    photo = np.full((480, 640, 3), 210, np.uint8)
    cv2.fillPoly(photo, [clicks[[3, 2, 4, 5]]], (90, 110, 160))
    cv2.fillPoly(photo, [clicks[[0, 1, 2, 3]]], (120, 140, 190))
    cv2.imwrite(str(folder / "photo.jpg"), photo)
