"""Files of keypoints in images, of any kind that is known."""

from __future__ import annotations

import os
from pathlib import Path

from cadalign.datasets.detections.coco_keypoints import read_coco_keypoints
from cadalign.datasets.detections.csv_keypoints import read_csv_keypoints
from cadalign.datasets.detections.image_keypoints import ImageKeypoints


def read_image_keypoints(path: str | os.PathLike[str]) -> list[ImageKeypoints]:
    """Read a file of keypoints: COCO's JSON and its relatives, or CSV.

    Parameters
    ----------
    path : str or path-like
        A .csv file, see `cadalign.datasets.detections.csv_keypoints`, or JSON, see
        `cadalign.datasets.detections.coco_keypoints`.

    Returns
    -------
    list of ImageKeypoints
        One for each object in each image, in file order.

    Raises
    ------
    DataError
        If the file is missing, malformed or of no known kind; names file and field.
    """
    path = Path(path)
    return read_csv_keypoints(path) if path.suffix.lower() == ".csv" else read_coco_keypoints(path)
