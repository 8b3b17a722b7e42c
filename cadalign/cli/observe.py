"""`cadalign observe`: pair a detector's keypoints with a model's."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from cadalign.cli.output import make_folder, new_console

if TYPE_CHECKING:
    from cadalign.datasets import ImageKeypoints
    from cadalign.geometry.camera import Camera


@dataclass(frozen=True)
class Observe:
    """Pair the keypoints of a detector in a photo with a model's.

    Writes an observation for `cadalign fit`. Keypoints are paired by name, otherwise by semantic
    id, otherwise by order. Without --camera the focal length is unknown.
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
        observation.save(out)
        new_console(stderr=False).print(
            f"{len(observation.points_2d)} of {len(found)} keypoints: {out}", markup=False
        )
        return 0

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
