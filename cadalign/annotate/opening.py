"""Opening of a session: photos, model, camera and keypoints are read and checked."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from cadalign.annotate.document import FocalChoice, History
from cadalign.annotate.files import SAME_PLACE, AnnotationFiles, refuse_other_model
from cadalign.annotate.keypoint_registry import KeypointRegistry
from cadalign.annotate.model import CadModel
from cadalign.annotate.names import (
    file_name,
    keypoints_file,
    observation_file,
    refuse_collisions,
    unfinished_file,
)
from cadalign.annotate.object_shape import ObjectShape
from cadalign.annotate.options import SessionOptions
from cadalign.annotate.photos import Photo, find_photos, intrinsics_of, read_camera
from cadalign.annotate.session import PhotoState, Session
from cadalign.datasets.meshes.load import load_mesh
from cadalign.datasets.models.model_keypoints import ModelKeypoint, ModelKeypoints
from cadalign.errors import DataError, InputError
from cadalign.geometry.camera import Camera

logger = logging.getLogger("cadalign")


@dataclass(frozen=True)
class SessionFiles:
    """Photos of a session, and the files that it writes."""

    photos: tuple[Photo, ...]
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
    photos = _readable(paths) if in_folder else [Photo.open(paths[0])]
    photos[0].encoded()  # refuses a damaged photo now, not when the page asks for it
    out = options.out or paths[0].parent
    if observation is not None:
        observations = [observation]
    else:
        observations = [observation_file(photo.path, out) for photo in photos]
    keypoints = keypoints_file(options.model, observations[0].parent)
    files = SessionFiles(tuple(photos), tuple(observations), keypoints)
    given = [options.keypoints] if options.keypoints not in (None, keypoints) else []
    read = [options.model, options.camera, *given, *(photo.path for photo in photos)]
    refuse_collisions(files.written, [path for path in read if path is not None])
    return files


def open_session(
    options: SessionOptions,
    files: SessionFiles | None = None,
    *,
    before_saving: Callable[[], None] = lambda: None,
) -> Session:
    """Open an annotation session.

    ``before_saving`` is called before files are written, and prevents it by a CadalignError.
    """
    files = files or find_session_files(options)
    model = options.model
    camera = None if options.camera is None else read_camera(options.camera)
    cad = CadModel(load_mesh(model))
    source = options.keypoints or keypoints_file(model, model.parent)
    shape = ObjectShape.open(options)
    registry = _open_registry(files.keypoints, source, model, cad, shape)
    photo_states = [
        _open_photo_state(photo, file, model, camera, registry, cad.diagonal, shape)
        for photo, file in zip(files.photos, files.observations, strict=True)
    ]
    return Session(cad, registry, photo_states, files.keypoints, before_saving, shape)


def _open_registry(
    own: Path, source: Path, model: Path, cad: CadModel, shape: ObjectShape | None
) -> KeypointRegistry:
    """Read the keypoints given with the model and those of earlier sessions."""
    mesh = cad.scene.mesh
    given: tuple[ModelKeypoint, ...] = ()
    if source != own and (source != keypoints_file(model, model.parent) or source.exists()):
        given = ModelKeypoints.load(source, mesh=mesh, model=model).keypoints
    registry = KeypointRegistry(given, reserved=() if shape is None else shape.reserved)
    if own.exists():
        earlier = ModelKeypoints.load(own, mesh=mesh, model=model)
        refuse_other_model(earlier.model, model, where=own)
        registry.merge(earlier.keypoints, tolerance=SAME_PLACE * cad.diagonal)
    return registry


def _open_photo_state(
    photo: Photo,
    file: Path,
    model: Path,
    camera: Camera | None,
    registry: KeypointRegistry,
    diagonal: float,
    shape: ObjectShape | None,
) -> PhotoState:
    files = AnnotationFiles(file, photo.path, model)
    document, own = files.read(registry, diagonal, shape)
    if own is not None and not own.focal_known:
        # The file leaves it to be estimated; the given camera's is kept for the user to choose.
        intrinsics = intrinsics_of(photo, camera or own)
        known = False
    else:
        intrinsics = intrinsics_of(photo, own or camera)
        known = intrinsics.calibrated
    document = replace(document, focal=FocalChoice(known=known))
    return PhotoState(photo, files, intrinsics, History(document))


def _readable(paths: list[Path]) -> list[Photo]:
    """Open the files that are photos, with a warning about the others."""
    photos = []
    for path in paths:
        try:
            photos.append(Photo.open(path))
        except DataError as error:
            logger.warning("left out: %s", error)
    if not photos:
        raise DataError("none of the photos in this folder can be read", where=str(paths[0].parent))
    return photos
