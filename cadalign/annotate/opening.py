"""Opening of a session: photos, model, camera and keypoints are read and checked."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from cadalign.annotate.choosing.choice import ModelChoice
from cadalign.annotate.files import AnnotationFiles, model_named_in
from cadalign.annotate.further import FurtherEvidence
from cadalign.annotate.names import (
    file_name,
    keypoints_file,
    object_files,
    observation_file,
    refuse_collisions,
    unfinished_file,
)
from cadalign.annotate.object_shape import ObjectShape
from cadalign.annotate.objects.models import Models
from cadalign.annotate.objects.opening import ModelOpener, open_object
from cadalign.annotate.objects.state import PhotoState
from cadalign.annotate.options import SessionOptions
from cadalign.annotate.photos import PhotoFile, find_photos, read_camera
from cadalign.annotate.proposals import read_proposals
from cadalign.annotate.session import Session
from cadalign.annotate.worklist import WorkList
from cadalign.errors import DataError, InputError
from cadalign.geometry.camera import Camera
from cadalign.io.documents import convert
from cadalign.io.observation_file import SizeFields, read_size

logger = logging.getLogger("cadalign")


@dataclass(frozen=True)
class SessionFiles:
    """Photos of a session, and the files that it writes."""

    photos: tuple[PhotoFile, ...]
    observations: tuple[Path, ...]  # one for each photo, in one folder
    keypoints: Path  # of the model

    @property
    def written(self) -> tuple[Path, ...]:
        """Files that the session writes."""
        unfinished = (unfinished_file(path) for path in self.observations)
        return (self.keypoints, *self.observations, *unfinished)


def find_session_files(options: SessionOptions) -> SessionFiles:
    """Find the photos and name the session's files; raises an error where files would collide."""
    image, observation = options.image, options.observation
    paths = find_photos(image)
    in_folder = image.is_dir()
    if observation is not None and (in_folder or options.out is not None):
        raise InputError(
            "names the file of a single photo, but a folder is given too",
            where="--observation",
            fix="use --out for a folder of photos, and not both options",
        )
    if observation is not None and observation.name != file_name(
        observation.stem, observation.suffix
    ):
        raise InputError(
            "the name is too long for a file", where="--observation", fix="give a shorter one"
        )
    photos = _readable(paths) if in_folder else [PhotoFile.open(paths[0])]
    listed = {photo.path.resolve() for photo in photos}
    photos += [
        PhotoFile.open(path) for path in options.further_photos if path.resolve() not in listed
    ]
    photos[0].encoded()  # refuses a damaged photo now, not when the page asks for it
    out = options.out or paths[0].parent
    if observation is not None:
        out = observation.parent
    observations = [
        observation_file(photo.path, out) for photo in photos[observation is not None :]
    ]
    observations[:0] = [observation] if observation is not None else []
    keypoints = keypoints_file(options.model, observations[0].parent)
    files = SessionFiles(tuple(photos), tuple(observations), keypoints)
    given = [options.keypoints] if options.keypoints not in (None, keypoints) else []
    read = [
        options.model,
        options.camera,
        options.mask,
        options.detections,
        options.library,
        *given,
        *options.models,
        *(photo.path for photo in photos),
    ]
    refuse_collisions(files.written, [path for path in read if path is not None])
    return files


def open_session(
    options: SessionOptions,
    files: SessionFiles | None = None,
    *,
    before_saving: Callable[[], None] = lambda: None,
    reserve: Callable[[Sequence[Path]], None] = lambda paths: None,
) -> Session:
    """Open an annotation session.

    ``before_saving`` is called before files are written, ``reserve`` with those of an object; both
    prevent it by a CadalignError.
    """
    files = files or find_session_files(options)
    first = files.photos[0]
    size = first.width, first.height
    camera = None if options.camera is None else read_camera(options.camera, size)
    shape, choice = ObjectShape.open(options), ModelChoice.open(options)
    opener = ModelOpener(files.keypoints.parent, options.keypoints, shape, choice)
    models = Models([options.model, *options.models], opener.open)
    objects = [
        _open_objects(photo, file, options, camera, models, shape, is_first=photo is first)
        for photo, file in zip(files.photos, files.observations, strict=True)
    ]
    if options.detections is not None:
        found = read_proposals(options.detections, files.photos, models[0].registry)
        for states, proposals in zip(objects, found, strict=True):
            states[0].proposals = proposals
    worklist = WorkList.open(files.keypoints.parent)
    for view in [view for states in objects for state in states for view in state.views]:
        place = next((row for row in objects if row[0].key == view.key), None)
        if place is None:  # a photo that is nothing but a further view
            file = observation_file(view.photo.path, files.keypoints.parent)
            place = _open_objects(view.photo, file, options, None, models, shape)
            objects.append(place)
        place.append(view)
    return Session(models, objects, before_saving, worklist, shape, choice, reserve=reserve)


def _open_objects(
    photo: PhotoFile,
    file: Path,
    options: SessionOptions,
    camera: Camera | None,
    models: Models,
    shape: ObjectShape | None,
    *,
    is_first: bool = False,
) -> list[PhotoState]:
    """The objects of a photo, the first one first; options give evidence of the first photo."""

    def with_options(further: FurtherEvidence) -> FurtherEvidence:
        return _with_options(further, options) if is_first else further

    model = models[0]
    if options.library is not None and file.exists():  # another one may have been chosen
        model = models[models.number_of(model_named_in(file, options.model))]
    own = AnnotationFiles(file, photo.path, model.path)
    first = open_object(own, photo, model, camera=camera, shape=shape, with_options=with_options)
    others = []
    for path in object_files(file, photo.path):
        model = models[models.number_of(model_named_in(path, options.model))]
        further = AnnotationFiles(path, photo.path, model.path)
        others.append(open_object(further, photo, model, camera=camera, shape=shape))
    return [first, *others]


def _with_options(further: FurtherEvidence, options: SessionOptions) -> FurtherEvidence:
    """The evidence with the mask and the lengths that the options give."""
    if options.mask is None and options.size is None:
        return further
    if options.image.is_dir():
        raise InputError(
            "is of a single photo, but a folder is given",
            where="--size" if options.mask is None else "--mask",
            fix="give one photo",
        )
    mask, size = options.mask, options.size
    if mask is not None:
        image = replace(further.image, mask=mask.resolve(), mask_sigma=None)
        further = replace(further, image=image)
    if size is not None:
        given = convert(size, SizeFields, where="--size")
        further = replace(further, size=read_size(given))
    return further


def _readable(paths: list[Path]) -> list[PhotoFile]:
    """Open the files that are photos, with a warning about the others."""
    photos = []
    for path in paths:
        try:
            photos.append(PhotoFile.open(path))
        except DataError as error:
            logger.warning("left out: %s", error)
    if not photos:
        raise DataError("none of the photos in this folder can be read", where=str(paths[0].parent))
    return photos
