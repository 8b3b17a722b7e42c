"""BOP's form: one scene of photos, with the stretched meshes [mm] as its models.

Each photo has a model of its own, ``obj_000001`` and so on: poses have no stretch.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from cadalign.errors import InputError
from cadalign.export.bop import write_bop_model, write_scene_gt
from cadalign.export.estimates import PoseEstimate
from cadalign.export.photo_sets.annotated import AnnotatedPhoto
from cadalign.geometry.alignment import Alignment
from cadalign.io.files import write_json, writing

_MM = 1000.0
_SCENE = Path("test", "000001")


def write_bop(folder: Path, numbered: Iterable[tuple[int, AnnotatedPhoto]]) -> list[InputError]:
    """Write the photos that the form can hold; returns why the others were left out."""
    scene = folder / _SCENE
    with writing(scene):
        scene.mkdir(parents=True, exist_ok=True)
    cameras, infos, poses, problems = {}, {}, [], []
    for number, photo in numbered:
        try:
            photo.require_plain_camera("BOP")
        except InputError as error:
            problems.append(error)
            continue
        object_id = number + 1
        write_bop_model(folder, photo.exported, object_id=object_id)
        photo.copy_image(scene / "rgb" / f"{number:06d}")
        photo.copy_mask(scene / "mask_visib" / f"{number:06d}_000000.png")
        pose = photo.pose
        in_mm = Alignment(pose.rotation, pose.translation * _MM, np.ones(3))
        poses.append(PoseEstimate("1", str(number), str(object_id), in_mm))
        k = photo.camera.matrix.ravel().tolist()
        cameras[str(number)] = {"cam_K": k, "depth_scale": 1.0}
        left, top, right, bottom = photo.bbox.tolist()
        infos[str(number)] = [{"bbox_obj": [left, top, right - left, bottom - top]}]
    write_scene_gt(scene / "scene_gt.json", poses)
    write_json(scene / "scene_camera.json", cameras)
    write_json(scene / "scene_gt_info.json", infos)
    return problems
