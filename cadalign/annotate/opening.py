"""Opening of a session: photos, models, camera and earlier annotations are read and checked."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cadalign.annotate.detected import read_detected
from cadalign.annotate.document import History, Priors, history_path, read_history
from cadalign.annotate.evidence import MarkedEvidence, MarkedLengths, MaskDrawing, draw_mask
from cadalign.annotate.files import AnnotationFiles, StoredView
from cadalign.annotate.library import ModelChoice
from cadalign.annotate.models import Models, ObjectShape
from cadalign.annotate.names import (
    file_name,
    keypoints_file,
    named_model,
    object_files,
    observation_file,
    refuse_collisions,
)
from cadalign.annotate.objects import AnnotatedObject, PhotoState, has_evidence
from cadalign.annotate.options import SessionOptions
from cadalign.annotate.photos import (
    FocalChoice,
    Intrinsics,
    PhotoFile,
    WorkList,
    find_photos,
    intrinsics_of,
    read_camera,
)
from cadalign.annotate.problem import LIKELY_STRETCH
from cadalign.annotate.session import Session
from cadalign.errors import CadalignError, DataError, InputError
from cadalign.geometry.camera import Camera
from cadalign.io.documents import convert
from cadalign.io.evidence import ImageEvidence, ObservedImage
from cadalign.io.observation import with_lens
from cadalign.io.observation_file import SizeFields, read_size

logger = logging.getLogger("cadalign")

_SAME_DIRECTION = 1e-6


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
    listed = {photo.path.resolve() for photo in photos}
    for path in options.further_photos:
        if path.resolve() not in listed:
            photos.append(PhotoFile.open(path))
            listed.add(path.resolve())
    photos[0].encoded()  # refuses a damaged photo now, not when the page asks for it
    out = options.out or paths[0].parent if given is None else given.parent
    observations = [] if given is None else [given]
    for photo in photos[len(observations) :]:
        observations.append(observation_file(photo.path, out, observations))
    keypoints = keypoints_file(options.model, out)
    files = SessionFiles(tuple(photos), tuple(observations), keypoints)
    read = [options.model, options.camera, options.mask, options.detections, options.library]
    read += [*options.models, *(photo.path for photo in photos)]
    if options.keypoints != keypoints:
        read.append(options.keypoints)
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
    folder, first = files.keypoints.parent, files.photos[0]
    shape, choice = ObjectShape.open(options), ModelChoice.open(options)
    models = Models(
        [options.model, *options.models],
        folder,
        keypoints=options.keypoints,
        shape=shape,
        choice=choice,
    )
    size = first.width, first.height
    camera = None if options.camera is None else read_camera(options.camera, size)
    session = Session(models, WorkList.open(folder), shape, choice, before_saving, reserve)
    for photo, file in zip(files.photos, files.observations, strict=True):
        session.objects.append(_open_photo(session, options, photo, file, camera, photo is first))
    if options.detections is not None:
        found = read_detected(options.detections, files.photos, models[0].registry)
        for state, detected in zip(session.photos, found, strict=True):
            state.detected = detected
    for view in [view for owner in session.owners for view in owner.states[1:]]:
        place = next((row for row in session.objects if row[0].key == view.key), None)
        if place is None:  # a photo that is nothing but a further view
            file = observation_file(view.photo.path, folder)
            place = _open_photo(session, options, view.photo, file, None, False)
            session.objects.append(place)
        place.append(view)
    return session


def _open_photo(
    session: Session,
    options: SessionOptions,
    photo: PhotoFile,
    file: Path,
    camera: Camera | None,
    is_first: bool,
) -> list[PhotoState]:
    """The objects of a photo, the first one first; options give evidence of the first photo."""
    model = options.model
    if options.library is not None and file.exists():  # another one may have been chosen
        model = named_model(file) or model
    if options.focal is not None or options.fov is not None:
        camera = camera or Camera.without_focal(photo.width, photo.height)
        camera = with_lens(camera, options.focal, fov=options.fov)
    objects = [(file, model, is_first)]
    for path in object_files(file, photo.path):
        objects.append((path, named_model(path) or options.model, False))
    return [_open_object(session, options, photo, camera, *each) for each in objects]


def _open_object(
    session: Session,
    options: SessionOptions,
    photo: PhotoFile,
    camera: Camera | None,
    file: Path,
    mesh: Path,
    is_first: bool,
) -> PhotoState:
    """An object in its first photo, and in its further ones; options add evidence of the first."""
    model = session.models.of(mesh)
    files = AnnotationFiles(file)
    stored = files.read(photo.path, model, session.shape)
    seen, observation = stored.seen, stored.observation
    evidence = ImageEvidence() if seen is None else seen.evidence
    marks = MarkedEvidence.of(evidence, observation)
    if is_first:
        marks = _with_options(marks, options, photo)
    intrinsics, focal = _intrinsics(photo, None if seen is None else seen.camera, camera)
    priors = stored.priors_or(Priors(LIKELY_STRETCH, intrinsics.likely_focal))
    if session.shape.is_estimated:  # with a prior of its own on the stretch
        priors = replace(priors, stretch=None)
    document = replace(stored.document, focal=focal, priors=priors, evidence=marks)
    owner = AnnotatedObject(session, model, files, History(document), stored.sigma)
    if observation is not None:
        owner.symmetry, owner.up_axis = observation.symmetry, observation.up_axis
    owner.up_axis = options.up_axis or owner.up_axis
    owner.first = PhotoState(owner, photo, intrinsics, evidence)
    views = [owner.first if each is None else _further_view(owner, each) for each in stored.views]
    owner.views = [view for view in views if view is not None]

    # Of several photos the views' documents are compared as the object's holds them.
    def is_same(drawn: MarkedEvidence, view: str | None) -> bool:
        further = (each for each in owner.states if not each.is_first and each.key == view)
        return _is_same(drawn, next(further, owner.first))

    stored_masks = [view.document.evidence.mask for view in owner.states]
    owner.history = read_history(
        history_path(files.observation),
        owner.document,
        model.registry,
        is_same,
    )
    for view, kept in zip(owner.states, stored_masks, strict=True):
        shown = view.document.evidence.mask
        own = None if shown is None or kept is None else _own_mask(shown, kept, view)
        if own is not None:  # which may be drawn anew
            view.drawn = MaskDrawing(), own, True
    return owner.first


def _with_options(
    marks: MarkedEvidence, options: SessionOptions, photo: PhotoFile
) -> MarkedEvidence:
    """The marks with the mask and the lengths that the options give."""
    mask, size = options.mask, options.size
    if options.image.is_dir() and not (mask is None and size is None):
        where = "--size" if mask is None else "--mask"
        what = "is of a single photo, but a folder is given"
        raise InputError(what, where=where, fix="give one photo")
    if mask is not None:
        drawing = MaskDrawing(str(mask.resolve()))
        draw_mask(drawing, photo.width, photo.height)  # refuses another file now, not in the page
        marks = replace(marks, mask=drawing)
    if size is not None:
        given = read_size(convert(size, SizeFields, where="--size"))
        marks = replace(marks, lengths=MarkedLengths.of(given))
    return marks


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


def _further_view(owner: AnnotatedObject, stored: StoredView) -> PhotoState | ObservedImage | None:
    """A further photo of an object, to whose document its own is added.

    The image as it is where it cannot be annotated, None if it then says nothing.
    """
    seen = stored.seen
    if stored.document is None or seen.image is None:
        return seen
    try:
        photo = PhotoFile.open(seen.image)
        intrinsics, focal = _intrinsics(photo, seen.camera, None)
    except CadalignError as error:
        logger.warning("%s: kept, but not opened: %s", owner.files.observation.name, error)
        return seen if has_evidence(seen) else None
    view = PhotoState(owner, photo, intrinsics, seen.evidence)
    shared = owner.document
    own = replace(
        stored.document,
        focal=focal,
        priors=Priors(shared.priors.stretch, intrinsics.likely_focal),
        evidence=shared.evidence.shared_with(MarkedEvidence.of(seen.evidence)),
        name=shared.name,
    )
    owner.history = History(shared.with_view(view.key, own))
    return view


def _is_same(drawn: MarkedEvidence, state: PhotoState) -> bool:
    """True if what was drawn is what the observation file has of a photo."""
    stored, mask = state.document.evidence, None
    if drawn.mask is not None:
        if stored.mask is not None:
            mask = _own_mask(drawn.mask, stored.mask, state)
        elif not _is_alike(drawn.mask, MaskDrawing(), state.photo):
            return False  # it was taken from the file
    written = drawn.as_written(state.camera, mask)
    if written.mask != stored.mask:
        return False
    if state.is_first and (written.photo, written.lengths) != (stored.photo, stored.lengths):
        return False
    if written.up is None or stored.up is None:
        return written.up is stored.up
    return bool(np.allclose(written.up, stored.up, rtol=0, atol=_SAME_DIRECTION))


def _own_mask(drawn: MaskDrawing, stored: MaskDrawing, state: PhotoState) -> Path | None:
    """The file of a stored mask if it is that of the strokes; None if it is another's."""
    own = next((path for path in state.mask_files if str(path) == stored.base != drawn.base), None)
    return own if drawn.strokes and _is_alike(drawn, stored, state.photo) else None


def _is_alike(one: MaskDrawing, other: MaskDrawing, photo: PhotoFile) -> bool:
    """True if two masks are of the same pixels."""
    size = photo.width, photo.height
    try:
        return np.array_equal(draw_mask(one, *size), draw_mask(other, *size))
    except CadalignError:  # the file of one is gone
        return False
