"""`cadalign observe`: pair a detector's keypoints with a model's."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from cadalign.cli.common import (
    answer,
    beside,
    exit_code,
    file_stem,
    file_stems,
    make_folder,
    make_folder_of,
    say,
)
from cadalign.cli.options import CameraOptions, EvidenceOptions, named_as_flags
from cadalign.datasets import (
    ImageKeypoints,
    ModelKeypoints,
    choose_object,
    join_keypoints,
    read_image_keypoints,
)
from cadalign.datasets.detections.coco import decode_segmentation
from cadalign.datasets.detections.image_keypoints import photo_in
from cadalign.errors import CadalignError, DataError, InputError, brief, refuse_unused
from cadalign.geometry.camera import Camera
from cadalign.io.documents import in_file, read_json
from cadalign.io.files import keeping, listed
from cadalign.io.images import photo_size, read_grey, read_mask, require_one_size, write_image
from cadalign.io.kinds import OBSERVATION, kind_of
from cadalign.io.meshes.files import check_keypoints
from cadalign.io.observation import Observation, with_lens

# Arguments of the library's functions, and their names on the command line.
_FLAGS = {"image": "--image", "number": "--object", "sigma_from_scores": "--sigma"}


@dataclass(frozen=True)
class Observe(CameraOptions, EvidenceOptions):
    """Pair the keypoints of a detector in a photo with a model's.

    Writes an observation for `cadalign fit`, or with --every one of each object of every photo.
    Keypoints are paired by name, otherwise by semantic id, otherwise by order. Without --camera,
    --focal or --fov the focal length is unknown. The mask that stands beside COCO keypoints is
    written as PNG beside the observation where the camera and the model's mesh are known, which a
    fit to it needs.
    """

    keypoints: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="KEYPOINTS")]
    """COCO keypoint JSON (MMPose, Detectron2, ultralytics), or CSV with the columns name, u, v."""
    model_keypoints: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL_KEYPOINTS")]
    """The model's keypoints: model.keypoints.json."""
    image: Path | None = None
    """The photo; its name selects among the file's images."""
    out: Path | None = None
    """Observation file to write; by default <keypoints>.observation.json beside the keypoints. With
    --every the folder to write to; by default <keypoints>_observations."""
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
    segmentation: bool = True
    """Take the mask beside the keypoints, COCO's polygons or run lengths."""
    every: bool = False
    """Write an observation of every object of every photo, instead of one; --image is then the
    photos' folder."""

    def run(self) -> int:
        """Write the observation, or those of all objects; returns the exit code."""
        if not self.weigh:
            with named_as_flags(self):
                fix = "give both, or the fit `--sigma`"
                refuse_unused(self, ["sigma"], "without --weigh", fix=fix)
        objects = read_image_keypoints(self.keypoints)
        model = ModelKeypoints.load(self.model_keypoints)
        with in_file(self.model_keypoints):
            check_keypoints(model.xyz, model.model, where="keypoints.xyz")
        inputs = [self.keypoints, self.model_keypoints, model.model, self.camera, self.image]
        inputs += [value for value in self.given.values() if isinstance(value, Path)]
        with keeping(inputs):
            return self._observe(objects, model)

    def _observe(self, objects: Sequence[ImageKeypoints], model: ModelKeypoints) -> int:
        """Write the observation, or those of all objects; returns the exit code."""
        if self.every:
            return _observe_all(self, objects, model)
        name = None if self.image is None else str(self.image)
        with named_as_flags(self, others=_FLAGS):
            found = choose_object(objects, image=name, number=self.object)
        out = self.out or self.keypoints.with_suffix(".observation.json")
        observation = self.observe(found, model, self.image, out)
        called = found.image or ""
        if name is not None and Path(called).suffix and not found.is_of(name):
            say(f"{self.keypoints} calls the photo {called}; its keypoints count for {name}")
        text = f"{len(observation.points_2d)} of {len(found)} keypoints: {out}"
        if observation.not_found:
            say(f"{found.source}: {observation.text_of_not_found}")
        if observation.evidence.mask is not None:
            text += f"; mask: {observation.evidence.mask}"
        answer(text)
        return 0

    def observe(
        self, found: ImageKeypoints, model: ModelKeypoints, image: Path | None, out: Path
    ) -> Observation:
        """Write the observation of one object in a photo."""
        observation = self._joined(found, model, image)
        make_folder_of(out)
        drawn = None if "mask" in self.given else self._write_mask(observation, found, out)
        observation = self.add_to(observation, mask=drawn)
        observation.save(out)
        return observation

    def _joined(
        self, found: ImageKeypoints, model: ModelKeypoints, image: Path | None
    ) -> Observation:
        with named_as_flags(self, others=_FLAGS):
            return join_keypoints(
                found,
                model,
                self._camera(found, image),
                image=None if image is None else image.resolve(),
                min_score=self.min_score,
                ignore_unknown=self.ignore_unknown,
                sigma_from_scores=self.sigma if self.weigh else None,
            )

    def _write_mask(
        self, observation: Observation, found: ImageKeypoints, out: Path
    ) -> Path | None:
        """Write the mask beside the keypoints, if there is one that a fit can use; its path."""
        if found.segmentation is None or not self.segmentation:
            return None
        camera = observation.camera
        if not camera.focal_known or observation.model is None:
            missing = "--camera" if not camera.focal_known else "a model in MODEL_KEYPOINTS"
            say(f"The mask is left out: a fit to it needs {missing}.")
            return None
        size = {"width": camera.width, "height": camera.height}
        try:
            mask = decode_segmentation(found.segmentation, **size)
        except DataError as error:
            say(f"{found.source}: the mask is left out: {error}")
            return None
        path = out.with_suffix(".mask.png")
        write_image(path, np.where(mask, 255, 0).astype(np.uint8))
        return path

    def _camera(self, found: ImageKeypoints, image: Path | None) -> Camera:
        """Read the camera, or make one of the photo's size without focal length."""
        given = self.given
        sizes = {} if image is None else {str(image): photo_size(image)}
        for name, read in (("mask", read_mask), ("depth", read_grey)):
            if name in given:  # read as a fit reads it, which refuses others
                height, width = read(given[name]).shape
                sizes[str(given[name])] = (width, height)
        if found.size is not None:
            sizes[found.source] = found.size
        camera = self.read_camera(next(iter(sizes.values()), None))
        if camera is not None:
            sizes = {str(self.camera): (camera.width, camera.height), **sizes}
        if not sizes:
            raise DataError(
                "the photo's size is unknown", where=found.source, fix="give --image or --camera"
            )
        require_one_size(sizes, image)
        size = next(iter(sizes.values()))
        changes = self.of_camera
        return with_lens(camera or Camera.without_focal(*size), changes.focal, fov=changes.fov)


def _observe_all(command: Observe, objects: Sequence[ImageKeypoints], model: ModelKeypoints) -> int:
    """Write an observation of each object; returns the exit code, 3 where some are left out."""
    from cadalign.cli.runs import tracked

    for name, given in {"object": command.object, **command.given}.items():
        if name in ("object", "mask", "depth") and given is not None:
            raise InputError("is for one photo", where=f"--{name}", fix="leave out --every")
    if command.image is not None and not command.image.is_dir():
        what = f"{command.image} is not a folder of photos"
        raise InputError(what, where="--image", fix="give the photos' folder, or leave out --every")
    folder = command.out or beside(command.keypoints, "_observations")
    make_folder(folder)
    failed, written = 0, set[Path]()
    named = zip(objects, _names([each.image for each in objects]), strict=True)
    for found, name in tracked(named, "observing", total=len(objects)):
        out = folder / f"{name}.json"
        try:
            command.observe(found, model, _photo(found, command.image), out)
        except CadalignError as error:
            failed += 1
            say(f"left out: {name}: {error}")
        else:
            written.add(out)
    others = [path.name for path in listed(folder, "*.json") if path not in written]
    others = [name for name in others if _is_observation(folder / name)]
    if others:
        names = brief(", ".join(others))
        say(f"Not written now, but in the folder, too, which a fit takes whole: {names}")
    answer(f"{len(objects) - failed} of {len(objects)} objects: {folder}")
    return exit_code(failed, len(objects))


def _is_observation(path: Path) -> bool:
    try:
        return kind_of(read_json(path)) == OBSERVATION
    except DataError:
        return False


def _photo(found: ImageKeypoints, folder: Path | None) -> Path | None:
    """The photo of an object in a folder, if it is there."""
    if folder is None or found.image is None:
        return None
    return photo_in(folder, found.image)


def _names(images: Sequence[str | None]) -> list[str]:
    """File names of images' objects, numbered where several are of one image."""
    stems = [file_stem(Path(image or "").stem or "photo", "photo") for image in images]
    counts, seen = Counter(stems), Counter[str]()
    names = []
    for stem in stems:
        names.append(stem if counts[stem] == 1 else f"{stem}_{seen[stem]}")
        seen[stem] += 1
    return file_stems(names, "photo")
