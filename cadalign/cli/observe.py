"""`cadalign observe`: pair a detector's keypoints with a model's."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from cadalign.cli.output import make_folder, new_console

if TYPE_CHECKING:
    from cadalign.datasets import ImageKeypoints
    from cadalign.geometry.camera import Camera
    from cadalign.io.observation import Observation


@dataclass(frozen=True)
class Observe:
    """Pair the keypoints of a detector in a photo with a model's.

    Writes an observation for `cadalign fit`. Keypoints are paired by name, otherwise by semantic
    id, otherwise by order. Without --camera the focal length is unknown. The mask that stands
    beside COCO keypoints is written as PNG beside the observation where the camera and the model's
    mesh are known, which a fit to it needs.
    """

    keypoints: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="KEYPOINTS")]
    """COCO keypoint JSON (MMPose, Detectron2, ultralytics), or CSV with the columns name, u, v."""
    model_keypoints: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL_KEYPOINTS")]
    """The model's keypoints: model.keypoints.json."""
    image: Path | None = None
    """The photo; its name selects among the file's images."""
    camera: Path | None = None
    """JSON file with the camera in COLMAP's form: model, width, height, params."""
    out: Path | None = None
    """Observation file to write; by default <keypoints>.observation.json beside the keypoints."""
    object: int | None = None
    """Number of the object in the photo, from 0; by default the one with the highest score."""
    min_score: float = 0.0
    """Least score of a keypoint that is kept."""
    weigh: bool = False
    """Use the scores as weights: half the score is twice the standard deviation."""
    sigma: float = 1.0
    """With --weigh, the standard deviation of a keypoint with score 1 [px]."""
    ignore_unknown: bool = False
    """Leave out keypoints that the model does not have."""
    mask: Path | None = None
    """Mask of the object, a grey PNG of the photo's size, in place of the one in the file."""
    mask_sigma: float | None = None
    """Standard deviation of the mask's contour [px]; estimated by default."""
    segmentation: bool = True
    """Take the mask beside the keypoints, COCO's polygons or run lengths."""
    depth: Path | None = None
    """Depth image that is registered to the photo, a PNG of 16 bits; 0 where unknown."""
    depth_scale: float | None = None
    """Units per count of the depth image; 0.001 by default, millimetres to metres."""
    depth_sigma: float | None = None
    """Relative standard deviation of the depths; 0.01 by default."""
    up: tuple[float, float, float] | None = None
    """Upward direction in the camera's frame, whose y points down: 0 -1 0 for a level camera."""
    up_sigma_deg: float | None = None
    """Standard deviation of this direction [degrees]; 1 by default."""
    camera_height: float | None = None
    """Height of the camera above the plane that the object stands on."""
    size: Annotated[dict[str, float] | None, tyro.conf.arg(metavar="NAME LENGTH ...")] = None
    """Known lengths of the object: width, height, length (along the model's x, y, z) and sigma,
    their relative standard deviation, as in --size height 0.91 sigma 0.005."""

    def run(self) -> int:
        """Write the observation; returns the exit code."""
        from cadalign.datasets import (
            ModelKeypoints,
            choose_object,
            join_keypoints,
            read_image_keypoints,
        )

        objects = read_image_keypoints(self.keypoints)
        name = None if self.image is None else self.image.name
        found = choose_object(objects, image=name, number=self.object)
        observation = join_keypoints(
            found,
            ModelKeypoints.load(self.model_keypoints),
            self._camera(found),
            image=None if self.image is None else self.image.resolve(),
            min_score=self.min_score,
            ignore_unknown=self.ignore_unknown,
            sigma_from_scores=self.sigma if self.weigh else None,
        )
        out = self.out or self.keypoints.with_suffix(".observation.json")
        make_folder(out.parent)
        observation = self._with_evidence(observation, found, out)
        observation.save(out)
        text = f"{len(observation.points_2d)} of {len(found)} keypoints: {out}"
        if observation.evidence.mask is not None:
            text += f"; mask: {observation.evidence.mask}"
        new_console(stderr=False).print(text, markup=False)
        return 0

    def _with_evidence(
        self, observation: Observation, found: ImageKeypoints, out: Path
    ) -> Observation:
        """The observation with what the options tell beyond keypoints, and the file's mask."""
        from cadalign.cli.options import named_as_flags
        from cadalign.io.documents import convert
        from cadalign.io.observation_file import SizeFields, read_size
        from cadalign.io.observed_image import ImageEvidence

        mask = self.mask or self._write_mask(observation, found, out)
        with named_as_flags(self):
            evidence = ImageEvidence(
                mask=_absolute(mask),
                mask_sigma=self.mask_sigma,
                depth=_absolute(self.depth),
                depth_scale=self.depth_scale,
                depth_sigma=self.depth_sigma,
                up=None if self.up is None else np.array(self.up),
                up_sigma_deg=self.up_sigma_deg,
                camera_height=self.camera_height,
            )
            with_evidence = replace(observation, evidence=evidence)
        size = None if self.size is None else convert(self.size, SizeFields, where="--size")
        return replace(with_evidence, size=read_size(size))

    def _write_mask(
        self, observation: Observation, found: ImageKeypoints, out: Path
    ) -> Path | None:
        """Write the mask beside the keypoints, if there is one that a fit can use; its path."""
        from cadalign.datasets.detections.coco_masks import decode_segmentation
        from cadalign.io.documents import in_file
        from cadalign.io.images import write_image

        if found.segmentation is None or not self.segmentation:
            return None
        camera = observation.camera
        if not camera.focal_known or observation.model is None:
            missing = "--camera" if not camera.focal_known else "a model in MODEL_KEYPOINTS"
            text = f"The mask is left out: a fit to it needs {missing}."
            new_console().print(text, markup=False)
            return None
        with in_file(found.source):
            mask = decode_segmentation(found.segmentation, width=camera.width, height=camera.height)
        path = out.with_suffix(".mask.png")
        write_image(path, np.where(mask, 255, 0).astype(np.uint8))
        return path

    def _camera(self, found: ImageKeypoints) -> Camera:
        """Read the camera, or make one of the photo's size without focal length."""
        from cadalign.errors import DataError
        from cadalign.geometry.camera import Camera
        from cadalign.io.documents import in_file, read_json
        from cadalign.io.images import photo_size

        sizes: dict[str, tuple[int, int]] = {}
        camera = None
        if self.camera is not None:
            data = read_json(self.camera)
            with in_file(self.camera):
                camera = Camera.from_dict(data)
            sizes[str(self.camera)] = camera.width, camera.height
        if self.image is not None:
            sizes[str(self.image)] = photo_size(self.image)
        for path in (self.mask, self.depth):
            if path is not None:
                sizes[str(path)] = photo_size(path)
        if found.size is not None:
            sizes[found.source] = found.size
        if not sizes:
            raise DataError(
                "the photo's size is unknown", where=found.source, fix="give --image or --camera"
            )
        (first, size), *others = sizes.items()
        for name, other in others:
            if other != size:
                raise DataError(
                    f"the image has {other[0]} x {other[1]} pixels, that of {first} "
                    f"{size[0]} x {size[1]}",
                    where=name,
                    fix="give keypoints, photo and camera of one image",
                )
        return camera or Camera.without_focal(*size)


def _absolute(path: Path | None) -> Path | None:
    return None if path is None else path.resolve()
