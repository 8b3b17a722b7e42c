"""From the command line's words to a session."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from cadalign.annotate.document import Document, FocalChoice
from cadalign.annotate.files import (
    SAME_PLACE,
    Sheet,
    keypoints_file,
    read_given_keypoints,
    read_own_keypoints,
)
from cadalign.annotate.history import History
from cadalign.annotate.keypoint_book import KeypointBook
from cadalign.annotate.lenses import lens_of, read_camera
from cadalign.annotate.model import CadModel
from cadalign.annotate.photos import Photo, find_photos
from cadalign.annotate.session import Session, Slide
from cadalign.datasets.meshes.load import load_mesh
from cadalign.datasets.models.model_keypoints import ModelKeypoint
from cadalign.errors import DataError, InputError
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh

logger = logging.getLogger("cadalign")


def open_session(
    *,
    image: Path,
    model: Path,
    observation: Path | None = None,
    camera: Path | None = None,
    keypoints: Path | None = None,
    out: Path | None = None,
) -> Session:
    """Read everything that is to be annotated.

    Parameters
    ----------
    image : Path
        A photo, or a folder of photos.
    model : Path
        The mesh file.
    observation : Path, optional
        Where a single photo's observation is kept.
    camera : Path, optional
        The calibrated camera of the photos.
    keypoints : Path, optional
        The model's keypoints.
    out : Path, optional
        The folder to write to; by default that of the observation, or of the photos.

    Raises
    ------
    CadalignError
        If a file is missing or not what it should be, or the words contradict each other.
    """
    paths = find_photos(image)
    if observation is not None and (image.is_dir() or out is not None):
        raise InputError(
            "names the file of a single photo",
            where="--observation",
            fix="with a folder of photos, or --out, leave it away",
        )
    photos = [Photo.open(paths[0])] if not image.is_dir() else _readable(paths)
    photos[0].encoded()  # a damaged one is refused now, not when the page asks for it
    if observation is None:
        files = _observation_files(photos, out or paths[0].parent)
    else:
        files = [observation]
    folder = files[0].parent
    given_camera = None if camera is None else read_camera(camera)
    mesh = load_mesh(model)
    cad = CadModel(mesh)
    book_file = keypoints_file(model, folder)
    book = _open_book(book_file, keypoints or keypoints_file(model, model.parent), model, mesh)
    slides = [
        _open_slide(photo, file, model, given_camera, book, cad.diagonal)
        for photo, file in zip(photos, files, strict=True)
    ]
    return Session(cad, book, slides, book_file)


def _open_book(own: Path, source: Path, model: Path, mesh: Mesh) -> KeypointBook:
    """The keypoints that came with the model, and those that were placed or renamed before."""
    came: tuple[ModelKeypoint, ...] = ()
    if source != own and (source.exists() or source != keypoints_file(model, model.parent)):
        came = read_given_keypoints(source, model, mesh)
    book = KeypointBook(came)
    if own.exists():
        low, high = mesh.bounds
        before = read_own_keypoints(own, model, mesh)
        book.take_in(before, tolerance=SAME_PLACE * float(np.linalg.norm(high - low)))
    return book


def _open_slide(
    photo: Photo,
    file: Path,
    model: Path,
    camera: Camera | None,
    book: KeypointBook,
    diagonal: float,
) -> Slide:
    sheet = Sheet(file, photo.path, model)
    document, own = sheet.read(Document(), book, diagonal)
    if own is not None and not own.focal_known:
        # The file says that it is to be estimated; the camera's is kept for when it is not.
        lens = lens_of(photo, camera or own)
        known = False
    else:
        lens = lens_of(photo, own or camera)
        known = lens.calibrated
    document = document.choose_focal(FocalChoice(known=known))
    return Slide(photo, sheet, lens, History(document))


def _readable(paths: list[Path]) -> list[Photo]:
    """The photos among files whose names say that they are; the others are warned of."""
    photos = []
    for path in paths:
        try:
            photos.append(Photo.open(path))
        except DataError as error:
            logger.warning("left out: %s", error)
    if not photos:
        raise DataError("none of its photos can be read", where=str(paths[0].parent))
    return photos


def _observation_files(photos: list[Photo], folder: Path) -> list[Path]:
    """A file for each photo; with its whole name where two differ only in the ending."""
    stems = [photo.path.stem for photo in photos]
    return [
        folder / f"{photo.path.name if stems.count(photo.path.stem) > 1 else photo.path.stem}.json"
        for photo in photos
    ]
