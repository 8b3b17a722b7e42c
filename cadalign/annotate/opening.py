"""Opening of a session: photos, model, camera and earlier annotations are read and checked."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path

from cadalign.annotate.annotation import Annotation
from cadalign.annotate.document import AnnotationDocument, History, Priors
from cadalign.annotate.evidence import MarkedMask
from cadalign.annotate.files import NOTHING, AnnotationFiles, stored_priors
from cadalign.annotate.models import ObjectShape, open_model
from cadalign.annotate.names import (
    file_name,
    keypoints_file,
    observation_file,
    refuse_collisions,
)
from cadalign.annotate.options import SessionOptions
from cadalign.annotate.photos import (
    FocalChoice,
    Intrinsics,
    PhotoFile,
    find_photos,
    intrinsics_of,
    read_camera,
)
from cadalign.annotate.problem import LIKELY_STRETCH
from cadalign.annotate.session import Session
from cadalign.errors import DataError, InputError
from cadalign.geometry.camera import Camera
from cadalign.io.documents import convert
from cadalign.io.observation import Observation, with_lens
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
        return (self.keypoints, *self.observations)


def find_session_files(options: SessionOptions) -> SessionFiles:
    """Find the photos and name the session's files; raises an error where files would collide."""
    image, given = options.image, options.observation
    paths = find_photos(image)
    in_folder = image.is_dir()
    if given is not None and (in_folder or options.out is not None):
        what = "names the file of a single photo, but a folder is given too"
        fix = "use --out for a folder of photos, and not both options"
        raise InputError(what, where="--observation", fix=fix)
    if given is not None and given.name != file_name(given.stem, given.suffix):
        what = "the name is too long for a file"
        raise InputError(what, where="--observation", fix="give a shorter one")
    photos = _readable(paths) if in_folder else [PhotoFile.open(paths[0])]
    photos[0].encoded()  # refuses a damaged photo now, not when the page asks for it
    out = options.out or paths[0].parent if given is None else given.parent
    observations = [] if given is None else [given]
    for photo in photos[len(observations) :]:
        observations.append(observation_file(photo.path, out, observations))
    keypoints = keypoints_file(options.model, out)
    files = SessionFiles(tuple(photos), tuple(observations), keypoints)
    read = [options.model, options.camera, options.mask]
    read += [photo.path for photo in photos]
    if options.keypoints != keypoints:
        read.append(options.keypoints)
    refuse_collisions(files.written, [path for path in read if path is not None])
    return files


def open_session(options: SessionOptions, files: SessionFiles | None = None) -> Session:
    """Open an annotation session."""
    files = files or find_session_files(options)
    folder = files.keypoints.parent
    shape = ObjectShape.open(options)
    model = open_model(options.model, folder, keypoints=options.keypoints, shape=shape)
    size = files.photos[0].width, files.photos[0].height
    camera = None if options.camera is None else read_camera(options.camera, size)
    session = Session(model, shape)
    for photo, file in zip(files.photos, files.observations, strict=True):
        session.photos.append(_open_annotation(session, options, photo, camera, file))
    return session


def _open_annotation(
    session: Session,
    options: SessionOptions,
    photo: PhotoFile,
    camera: Camera | None,
    file: Path,
) -> Annotation:
    """An annotation of a photo; options add evidence to the first one."""
    if options.focal is not None or options.fov is not None:
        camera = camera or Camera.without_focal(photo.width, photo.height)
        camera = with_lens(camera, options.focal, fov=options.fov)
    files = AnnotationFiles(file)
    stored, document = files.read(photo.path, session.model, session.shape)
    intrinsics, focal = _intrinsics(photo, None if stored is None else stored.camera, camera)
    priors = Priors(LIKELY_STRETCH, intrinsics.likely_focal)
    if stored is None:
        stored = Observation(*NOTHING, intrinsics.camera)
    else:
        priors = stored_priors(stored, priors)
    if session.shape.is_estimated:  # with a prior of its own on the stretch
        priors = replace(priors, stretch=None)
    if options.up_axis is not None:
        stored = replace(stored, up_axis=options.up_axis)
    document = replace(document, focal=focal, priors=priors)
    if not session.photos:
        stored, document = _with_evidence(stored, document, options, photo)
    return Annotation(session, photo, intrinsics, files, stored, History(document))


def _with_evidence(
    stored: Observation, document: AnnotationDocument, options: SessionOptions, photo: PhotoFile
) -> tuple[Observation, AnnotationDocument]:
    """The observation and its marks with the mask and the lengths that the options give."""
    mask, size = options.mask, options.size
    if options.image.is_dir() and not (mask is None and size is None):
        where = "--size" if mask is None else "--mask"
        what = "is of a single photo, but a folder is given"
        raise InputError(what, where=where, fix="give one photo")
    if mask is not None:
        given = MarkedMask(str(mask.resolve()))
        given.pixels(photo.width, photo.height)  # refuses another file now, not in the page
        document = replace(document, evidence=replace(document.evidence, mask=given))
    if size is not None:
        stored = replace(stored, size=read_size(convert(size, SizeFields, where="--size")))
    return stored, document


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


def _intrinsics(
    photo: PhotoFile, own: Camera | None, given: Camera | None
) -> tuple[Intrinsics, FocalChoice]:
    """The camera of a photo from its observation, or else the given one."""
    if own is not None and not own.focal_known:
        # The file leaves it to be estimated; the given camera's is kept for the user to choose.
        return intrinsics_of(photo, given or own), FocalChoice(known=False)
    intrinsics = intrinsics_of(photo, own or given)
    return intrinsics, FocalChoice(known=intrinsics.calibrated)
