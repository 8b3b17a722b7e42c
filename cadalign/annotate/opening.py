"""Opening of a session: photos, model, camera and earlier annotations are read and checked."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path

from cadalign.annotate.annotation import Annotation
from cadalign.annotate.document import History, Priors
from cadalign.annotate.evidence import MarkedEvidence, MarkedLengths, MarkedMask
from cadalign.annotate.files import NOTHING, AnnotationFiles, stored_priors
from cadalign.annotate.models import Detected, KeypointRegistry, ObjectShape, open_model
from cadalign.annotate.names import (
    file_name,
    further_files,
    keypoints_file,
    observation_file,
    refuse_collisions,
)
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
from cadalign.datasets.detections.image_keypoints import ImageKeypoints
from cadalign.datasets.detections.keypoint_files import read_image_keypoints
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
    further: tuple[tuple[Path, ...], ...]  # those of further objects of each photo
    keypoints: Path  # of the model

    @property
    def written(self) -> tuple[Path, ...]:
        """Files that the session writes."""
        further = (path for paths in self.further for path in paths)
        return (self.keypoints, *self.observations, *further)


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
    further = [
        tuple(path for path in further_files(file, photo.path) if path not in observations)
        for photo, file in zip(photos, observations, strict=True)
    ]
    keypoints = keypoints_file(options.model, out)
    files = SessionFiles(tuple(photos), tuple(observations), tuple(further), keypoints)
    read = [options.model, options.camera, options.mask, options.detections]
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
    session = Session(model, WorkList.open(folder), shape)
    for photo, own, further in zip(files.photos, files.observations, files.further, strict=True):
        for file in (own, *further):
            session.photos.append(_open_annotation(session, options, photo, camera, file))
            session.photos[-1].is_further = file in further
    if options.detections is not None:
        found = read_detected(options.detections, files.photos, model.registry)
        for photo, detected in zip(files.photos, found, strict=True):
            first = next(each for each in session.photos if each.photo is photo)
            first.detected = detected
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
    marks = document.evidence
    if not session.photos:
        marks = _with_options(marks, options, photo)
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
    document = replace(document, focal=focal, priors=priors, evidence=marks)
    return Annotation(session, photo, intrinsics, files, stored, History(document))


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
        given = MarkedMask(str(mask.resolve()))
        given.pixels(photo.width, photo.height)  # refuses another file now, not in the page
        marks = replace(marks, mask=given)
    if size is not None:
        lengths = read_size(convert(size, SizeFields, where="--size"))
        marks = replace(marks, lengths=MarkedLengths.of(lengths))
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


def read_detected(
    path: Path, photos: Sequence[PhotoFile], registry: KeypointRegistry
) -> list[tuple[Detected, ...]]:
    """Read COCO's keypoints or a detector's for each photo, by its file name.

    Of photos of one name an image's are those whose folders agree most with its own. Where a photo
    has several objects, the surest counts. Keypoints are found by name, else by their semantic id;
    in a file with neither by their order, if there are as many as the model has.

    Raises DataError if no photo or no keypoint of the model is in the file.
    """
    found = read_image_keypoints(path)
    called = defaultdict[str, list[PhotoFile]](list)
    for photo in photos:
        for name in {photo.path.name, photo.path.stem}:
            called[name].append(photo)
    objects = defaultdict[PhotoFile, list[ImageKeypoints]](list)
    for each in found:
        namesakes = called.get(Path(each.image or "").name, [])
        alike = [_folders_alike(each.image or "", photo.path) for photo in namesakes]
        for photo, count in zip(namesakes, alike, strict=True):
            if count == max(alike):
                objects[photo].append(each)
    by_photo = []
    for photo in photos:
        own = objects[photo] or (list(found) if len(photos) == 1 else [])
        own.sort(key=lambda each: -(each.score or 0.0))
        by_photo.append(_detected(own[0], photo, registry) if own else ())
    if not any(by_photo):
        raise DataError(
            "has no keypoint of the model in any of the photos",
            where=str(path),
            fix="its images and keypoints must be called as the photos and the model's keypoints",
        )
    return by_photo


def _folders_alike(image: str, photo: Path) -> int:
    """Number of the last folders of two paths that are the same."""
    pairs = zip(Path(image).parts[-2::-1], photo.absolute().parts[-2::-1], strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))


def _detected(
    found: ImageKeypoints, photo: PhotoFile, registry: KeypointRegistry
) -> tuple[Detected, ...]:
    by_name = {point.name: number for number, point in registry}
    count = len(found.points_2d)
    wanted: list[int | None]
    if found.names is not None:
        wanted = [by_name.get(name) for name in found.names]
    elif found.ids is not None:
        wanted = [number if number in registry else None for number in found.ids]
    else:
        numbers = sorted(number for number, _ in registry)
        wanted = list(numbers) if len(numbers) == count else [None] * count
    scores = [None] * count if found.scores is None else found.scores.tolist()
    keypoints = []
    for keypoint, (u, v), score in zip(wanted, found.points_2d.tolist(), scores, strict=True):
        inside = -0.5 <= u <= photo.width - 0.5 and -0.5 <= v <= photo.height - 0.5
        if keypoint is not None and inside and score != 0:
            keypoints.append(Detected(keypoint, (u, v)))
    return tuple(keypoints)
