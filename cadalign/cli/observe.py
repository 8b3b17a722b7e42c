"""`cadalign observe`: match a detector's keypoints to a model's keypoints."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from cadalign.cli.common import answer, create_parent, say
from cadalign.cli.options import CameraOptions, name_flags
from cadalign.datasets import ModelKeypoints, choose_object, read_image_keypoints
from cadalign.datasets.coco import decode_segmentation
from cadalign.datasets.image_keypoints import ImageKeypoints, observe_keypoints
from cadalign.errors import DataError
from cadalign.geometry.calibration import camera_doubts
from cadalign.io.documents import name_file
from cadalign.io.evidence import ImageEvidence
from cadalign.io.files import protect_inputs
from cadalign.io.images import write_image
from cadalign.io.meshes.files import check_keypoints
from cadalign.io.observation import Observation


@dataclass(frozen=True)
class Observe(CameraOptions):
    """Match a detector's keypoints to a model's keypoints.

    Writes an observation of one object for `cadalign fit`. To align all objects of a detector's
    file, give that file to `cadalign fit` directly. Keypoints are matched by name, otherwise by
    semantic id, otherwise by order. Without --camera or --focal the focal length is unknown. The
    mask of a COCO annotation is written as PNG beside the observation. It needs a known focal
    length and the model's mesh, and is left out otherwise.
    """

    keypoints: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="KEYPOINTS")]
    """The detector's file: COCO keypoint JSON (as from MMPose, Detectron2 or ultralytics), or CSV
    with the columns name, u, v."""
    model: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL")]
    """The model: its NAME.keypoints.json, or the mesh beside that file."""
    image: Path | None = None
    """The photo. Its name selects the image in the detector's file."""
    out: Path | None = None
    """Observation file to write; by default <keypoints>.observation.json beside KEYPOINTS."""
    object: int | None = None
    """Index of the object in the photo, from 0; by default the object with the highest score."""
    min_score: float = 0.0
    """Minimum score of a keypoint. Keypoints below it are left out."""
    ignore_unknown: bool = False
    """Leave out keypoints that the model lacks."""

    def run(self) -> int:
        """Write the observation; returns the exit code."""
        objects = read_image_keypoints(self.keypoints)
        model = ModelKeypoints.load(self.model)
        with name_file(self.model):
            check_keypoints(model.xyz, model.model, where="keypoints.xyz")
        name = None if self.image is None else str(self.image)
        with name_flags(self):
            found = choose_object(objects, image=name, number=self.object)
            observation = observe_keypoints(
                found,
                model,
                self.changes,
                image=None if self.image is None else self.image.resolve(),
                min_score=self.min_score,
                ignore_unknown=self.ignore_unknown,
            )
        out = self.out or self.keypoints.with_suffix(".observation.json")
        with protect_inputs([self.keypoints, self.model, model.model, self.camera, self.image]):
            create_parent(out)
            if found.segmentation is not None:
                mask = self._write_mask(observation, found, out.with_suffix(".mask.png"))
                observation = replace(observation, evidence=ImageEvidence(mask=mask))
            observation.save(out)
        called = found.image or ""
        if name is not None and Path(called).suffix and not found.matches_photo(name):
            say(f"{self.keypoints} names the photo {called}; its keypoints are used for {name}")
        if observation.not_found:
            say(f"{found.source}: {observation.text_of_not_found}")
        for doubt in camera_doubts(observation.camera):
            say(f"{out}: {doubt}")
        shown = observation.evidence.mask
        text = "" if shown is None else f"; mask: {shown}"
        answer(f"{len(observation.points_2d)} of {len(found)} keypoints: {out}{text}")
        return 0

    def _write_mask(
        self, observation: Observation, found: ImageKeypoints, path: Path
    ) -> Path | None:
        """Write the mask if a fit can use it; returns its path, or None."""
        camera = observation.camera
        if not camera.focal_known or observation.model is None:
            missing = "--camera" if not camera.focal_known else "the mesh of MODEL"
            say(f"The mask is left out: a fit to it needs {missing}.")
            return None
        size = {"width": camera.width, "height": camera.height}
        try:
            mask = decode_segmentation(found.segmentation, **size)
        except DataError as error:
            say(f"{found.source}: the mask is left out: {error}")
            return None
        write_image(path, np.where(mask, 255, 0).astype(np.uint8))
        return path
