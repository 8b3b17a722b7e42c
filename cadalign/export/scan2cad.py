"""Scan2CAD's JSON: models placed in a scene by translation, rotation and scale along each axis."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from cadalign.export.aligned_object import AlignedObject, Frame
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.rotations import quat_wxyz_from_rotation
from cadalign.io.files import write_json


def write_scan2cad(
    path: Path,
    exported: AlignedObject,
    *,
    frame: Frame,
    scan_id: str,
    category_id: str,
) -> None:
    """Write an aligned object as Scan2CAD's annotations are: a list of one scan with one model.

    The scene's coordinates are those of the frame, in metres, and the scan's own are the same. The
    stretch is ``trs.scale``. A mesh that was warped is not the CAD model any more, and is not
    part of the file: it holds the model's id alone.

    Parameters
    ----------
    path : Path
    exported : AlignedObject
        Its ``name`` is the model's id.
    frame : {"camera", "rig", "world", "model"}
    scan_id : str
        The scan's id, such as ``scene0470_00``.
    category_id : str
        The model's synset.
    """
    pose = exported.frame_from_model(frame)
    in_metres = Alignment(
        pose.rotation, pose.translation * exported.metres, pose.scale * exported.metres
    )
    low, high = exported.bounds
    model = {
        "trs": _trs(in_metres),
        "id_cad": exported.name,
        "catid_cad": category_id,
        "sym": "__SYM_NONE",
        "bbox": ((high - low) / 2).tolist(),
        "center": ((high + low) / 2).tolist(),
    }
    scan = {
        "id_scan": scan_id,
        "trs": _trs(Alignment.identity()),
        "n_aligned_models": 1,
        "aligned_models": [model],
    }
    write_json(path, [scan])


def _trs(alignment: Alignment) -> dict[str, Any]:
    return {
        "translation": alignment.translation.tolist(),
        "rotation": np.asarray(quat_wxyz_from_rotation(alignment.rotation)).tolist(),
        "scale": alignment.scale.tolist(),
    }
