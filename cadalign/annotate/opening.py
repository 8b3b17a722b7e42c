"""Opening of a session: photos, model, camera and keypoints are read and checked."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

from cadalign.annotate.document import FocalChoice, History
from cadalign.annotate.files import SAME_PLACE, AnnotationFiles, keypoints_file, refuse_other_model
from cadalign.annotate.keypoint_registry import KeypointRegistry
from cadalign.annotate.model import CadModel
from cadalign.annotate.options import SessionOptions
from cadalign.annotate.photos import Photo, find_photos, intrinsics_of, read_camera
from cadalign.annotate.session import PhotoState, Session
from cadalign.datasets.meshes.load import load_mesh
from cadalign.datasets.models.model_keypoints import ModelKeypoint, ModelKeypoints
from cadalign.errors import DataError, InputError
from cadalign.geometry.camera import Camera

logger = logging.getLogger("cadalign")


def open_session(options: SessionOptions) -> Session:
    """Open an annotation session."""
    image, model, observation = options.image, options.model, options.observation
    paths = find_photos(image)
    if observation is not None and (image.is_dir() or options.out is not None):
        raise InputError(
            "names the file of a single photo, but a folder is given too",
            where="--observation",
            fix="use --out for a folder of photos, and not both options",
        )
    photos = [Photo.open(paths[0])] if not image.is_dir() else _readable(paths)
    photos[0].encoded()  # refuses a damaged photo now, not when the page asks for it
    out = options.out or paths[0].parent
    files = [observation] if observation is not None else _observation_files(photos, out)
    folder = files[0].parent
    camera = None if options.camera is None else read_camera(options.camera)
    cad = CadModel(load_mesh(model))
    registry_file = keypoints_file(model, folder)
    source = options.keypoints or keypoints_file(model, model.parent)
    registry = _open_registry(registry_file, source, model, cad)
    photo_states = [
        _open_photo_state(photo, file, model, camera, registry, cad.diagonal)
        for photo, file in zip(photos, files, strict=True)
    ]
    return Session(cad, registry, photo_states, registry_file)


def _open_registry(own: Path, source: Path, model: Path, cad: CadModel) -> KeypointRegistry:
    """Read the keypoints given with the model and those of earlier sessions."""
    mesh = cad.scene.mesh
    given: tuple[ModelKeypoint, ...] = ()
    if source != own and (source.exists() or source != keypoints_file(model, model.parent)):
        given = ModelKeypoints.load(source, mesh=mesh, model=model).keypoints
    registry = KeypointRegistry(given)
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
) -> PhotoState:
    files = AnnotationFiles(file, photo.path, model)
    document, own = files.read(registry, diagonal)
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


def _observation_files(photos: list[Photo], folder: Path) -> list[Path]:
    """Name a file for each photo, with its suffix if two photos differ only in that."""
    stems = [photo.path.stem for photo in photos]
    return [
        folder / f"{photo.path.name if stems.count(photo.path.stem) > 1 else photo.path.stem}.json"
        for photo in photos
    ]
