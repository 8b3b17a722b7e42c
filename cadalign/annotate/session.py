"""Annotation session: its photos, their live alignments, and their observation files."""

from __future__ import annotations

import json
import logging
import threading
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.annotate.files import (
    SessionOptions,
    keypoints_file,
    observation_file,
    refuse_collisions,
)
from cadalign.annotate.keypoints import ObjectShape, positions_of
from cadalign.annotate.marks import History, Marks, Pixel
from cadalign.annotate.model import MarkedModel, open_model
from cadalign.annotate.observations import LEAST_JOINT_PAIRS, ObservationFile
from cadalign.annotate.photos import PhotoFile, camera_of, find_photos
from cadalign.annotate.problem import LiveEstimate, LiveProblem, warm_up
from cadalign.annotate.skeleton import next_row, open_skeleton
from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import CadalignError, DataError, DegenerateError, InputError
from cadalign.estimation.result import Result
from cadalign.io.observation import Observation, read_camera

logger = logging.getLogger("cadalign")

_LEAST_PAIRS = 4  # of an alignment without further evidence
_USUAL = 0.5  # share of a category's models with a keypoint that is proposed before rarer ones


@dataclass(frozen=True, eq=False)
class LiveAlignment:
    """Alignment of the current marks, or a message why there is none."""

    estimate: LiveEstimate | None = None
    message: str = ""
    counts: BoolArray = field(default_factory=lambda: np.empty(0, dtype=bool))
    """Mask (n,) of the complete pairs that count."""
    lines: FloatArray = field(default_factory=lambda: np.empty((0, 2, 2)))
    """Visible lines (k, 2, 2) of the object [px]."""

    @property
    def result(self) -> Result | None:
        """The result of the estimate, whose keypoints are the pairs that count."""
        return None if self.estimate is None else self.estimate.result


def missing_text(counts: BoolArray, shape: ObjectShape, observation: Observation) -> str:
    """Return a text about how many more pairs the first alignment needs; empty if none.

    ``counts`` (n,) is the mask of complete pairs that count.
    """
    if shape.learned is None and (observation.evidence.mask or observation.init):
        return ""
    # Three pairs leave a learned shape without a model too uncertain to be of use.
    is_plain = observation.is_plain and (shape.learned is None or observation.model is None)
    missing = (_LEAST_PAIRS if is_plain else LEAST_JOINT_PAIRS) - int(counts.sum())
    if missing <= 0:
        return ""
    text = f"{missing} more pair{'s' if missing > 1 else ''} to the first alignment"
    if not counts.all() and shape.learned is not None:
        text += f": keypoints that {shape.learned.category} has, the white points on the model"
    return text


@dataclass(eq=False)
class Annotation:
    """The object in a photo: its file, its marks, its last alignment, and errors of saving."""

    file: ObservationFile
    history: History
    save_error: str = ""
    is_pending: bool = False
    """True if it was saved before the solvers were ready, without the estimated noise."""
    live: tuple[Marks, LiveAlignment] | None = None
    """The last alignment, with its marks."""
    skipped: set[str] = field(default_factory=set)
    """Names of keypoints that are not proposed any more."""
    _estimated: tuple[str, LiveEstimate] | None = None  # with a key of its input

    @property
    def marks(self) -> Marks:
        """The current marks."""
        return self.history.marks

    @property
    def photo(self) -> PhotoFile:
        """The photo."""
        return self.file.photo

    @property
    def model(self) -> MarkedModel:
        """The model whose keypoints are marked."""
        return self.marks.model

    def record(self, marks: Marks) -> None:
        """Set the current marks."""
        self.history.record(marks)

    def next_keypoint(self, live: LiveAlignment) -> int | None:
        """The keypoint of a skeleton to mark next; None for a model, or if there is none."""
        if not self.model.is_skeleton:
            return None
        points, used = [point for _, point in self.model.registry], self.marks.keypoints
        rows = [row for row, point in enumerate(points) if point.semantic_id in used]
        marked = {points[row].name for row in rows}
        left = [row for row, point in enumerate(points) if point.name not in marked | self.skipped]
        # A part that was skipped and has no mark, such as an armrest, is likely absent.
        absent = set(map(_part_of, self.skipped)) - set(map(_part_of, marked))
        likely = [row for row in left if _part_of(points[row].name) not in absent]
        learned = self.model.shape.learned
        shares = () if learned is None else learned.shares
        usual = [row for row in likely if not shares or shares[row] > _USUAL]
        for group in (usual, likely, left):
            row = next_row(positions_of(points), rows, group, live.result)
            if row is not None:
                return points[row].semantic_id
        return None

    def exchange_shape(self, shape: ObjectShape) -> None:
        """Mark the keypoints of another shape; pairs of equal names stay, others lose theirs."""
        model, marks, before = open_skeleton(shape), self.marks, self.model.registry
        found: dict[int | None, int | None]
        found = {number: model.registry.find_by_name(before[number]) for number in marks.keypoints}
        changed = [replace(each, keypoint=found.get(each.keypoint)) for each in marks.pairs]
        kept = [each for each in changed if each.uv is not None or each.keypoint is not None]
        self.record(replace(marks, model=model, pairs=tuple(kept), start=None))

    @property
    def mask(self) -> BoolArray:
        """The mask of the object, (h, w); empty without one."""
        mask, (width, height) = self.marks.mask, (self.photo.width, self.photo.height)
        return np.zeros((height, width), bool) if mask is None else mask.pixels(width, height)

    def require_inside(self, uv: Pixel) -> None:
        """Raise InputError for a place outside the photo."""
        if not self.marks.camera.contains(np.array([uv]))[0]:
            what = f"({uv[0]:.1f}, {uv[1]:.1f}) is outside the photo"
            raise InputError(what, where="uv", fix="place it inside")

    def alignment(self) -> LiveAlignment:
        """The alignment of the current marks."""
        marks = self.marks
        if self.live is None or self.live[0] is not marks:
            try:
                live = self._align()
            except DegenerateError as error:
                live = LiveAlignment(message=f"No alignment yet: {error.what}.")
            except CadalignError as error:  # for example a mask that cannot be read or written
                live = LiveAlignment(message=f"No alignment: {error}.")
            self.live = marks, live
        return self.live[1]

    def _align(self) -> LiveAlignment:
        file, marks, shape = self.file, self.marks, self.model.shape
        observation, counting = file.observation_of(marks), file.usable_pairs(marks)
        counts = np.array([pair in counting for pair in marks.complete_pairs], dtype=bool)
        if missing := missing_text(counts, shape, observation):
            return LiveAlignment(message=missing)
        estimate = self._estimate(observation)
        return LiveAlignment(estimate, "", counts, self.model.lines(estimate.result))

    def _estimate(self, observation: Observation) -> LiveEstimate:
        depends = replace(observation, draft=None).to_dict()
        key = json.dumps([depends, hash(self.marks.mask)])  # a mask's path may stay the same
        if self._estimated is None or self._estimated[0] != key:
            known = self.model.shape.learned, self.model.cad.scene.mesh
            focal = self.photo.likely_focal.focal, self.file.focal_prior
            self._estimated = key, LiveProblem.make(*known, observation, *focal).estimate()
        return self._estimated[1]


def _part_of(name: str) -> str:
    """Name of the part that a keypoint belongs to: "leg" of "leg, front left, bottom"."""
    return name.split(",")[0]


@dataclass(eq=False)
class Session:
    """All state of an annotator; safe to use from several threads."""

    model: MarkedModel
    """CAD model of all photos; without one, the skeleton of new photos."""
    photos: list[Annotation] = field(default_factory=list)
    ready: bool = False  # True once the solvers are compiled and loaded, so that a fit is instant

    def __post_init__(self) -> None:
        self.lock = threading.RLock()
        self.ended = threading.Event()

    def warm_up(self) -> None:
        """Compile or load the solvers, and prepare the model, unless the session has ``ended``."""
        try:
            joint = self.model.shape.learned is not None or any(
                not each.file.observation_of(each.marks).is_plain
                for each in self.photos
                if each.marks.complete_pairs
            )
            warm_up(joint=joint)
            if not self.ended.is_set():
                _ = self.model.cad.scene.caster, self.model.cad.creases
        finally:  # an error here occurs again, and is reported, when the user aligns
            self.ready = True
            with self.lock:
                for each in self.photos:
                    if each.is_pending and not self.ended.is_set():
                        self.save(each)

    def annotation(self, number: int) -> Annotation:
        """Return the annotation of a number, from 0; raises InputError if there is none."""
        if not 0 <= number < len(self.photos):
            raise InputError(f"there is no photo {number + 1}", where="image")
        return self.photos[number]

    def live(self, annotation: Annotation) -> LiveAlignment:
        """The alignment of an annotation's current marks."""
        if not self.ready:
            return LiveAlignment(message="Solvers and model are being prepared.")
        return annotation.alignment()

    def save(self, annotation: Annotation) -> None:
        """Write the files of an annotation and of the model; an error is kept for the page.

        Also writes annotations that could not be written before.
        """
        self._write(annotation)
        if not annotation.save_error:
            self.save_unsaved()

    @property
    def unsaved(self) -> list[Annotation]:
        """Annotations whose last change could not be written."""
        return [each for each in self.photos if each.save_error]

    def save_unsaved(self) -> None:
        """Write all annotations that could not be written."""
        with self.lock:
            for each in self.unsaved:
                self._write(each)

    def _write(self, annotation: Annotation) -> None:
        annotation.is_pending = not self.ready  # read first: it may change at any time
        estimate = self.live(annotation).estimate
        options = {} if estimate is None else estimate.fit_options
        used = (each.marks.keypoints for each in self.photos)
        try:
            # Keypoints first: the observation refers to them.
            self.model.write_keypoints(frozenset[int]().union(*used))
            file = annotation.file
            file.write(file.observation_of(annotation.marks, sigma=options))
        except CadalignError as error:
            annotation.save_error = str(error)
        else:
            annotation.save_error = ""


SessionFiles = list[tuple[PhotoFile, Path]]
"""Photos of a session, and the observation file of each, all in one folder."""


def find_session_files(options: SessionOptions) -> SessionFiles:
    """Find the photos and name their files; raises InputError if files would collide."""
    image, given = options.image, options.observation
    if options.model is None and options.keypoints is not None:
        raise InputError("given without a model", where="--keypoints", fix="give the model, too")
    paths = find_photos(image)
    if given is not None and (image.is_dir() or options.out is not None):
        what = "names the file of a single photo, but a folder is given too"
        fix = "use --out for a folder of photos, and not both options"
        raise InputError(what, where="--observation", fix=fix)
    photos = _open_photos(paths) if image.is_dir() else [PhotoFile.open(paths[0])]
    photos[0].encode()  # refuses a damaged photo now, not when the page asks for it
    out = options.out or paths[0].parent if given is None else given.parent
    observations = [] if given is None else [given]
    for photo in photos[len(observations) :]:
        observations.append(observation_file(photo.path, out, observations))
    read: list[Any] = [options.model, options.camera, *(photo.path for photo in photos)]
    written = observations
    if options.model is not None:
        keypoints = keypoints_file(options.model, out)
        written = [keypoints, *observations]
        if options.keypoints != keypoints:
            read.append(options.keypoints)
    refuse_collisions(written, [path for path in read if path is not None])
    return list(zip(photos, observations, strict=True))


def open_session(options: SessionOptions, files: SessionFiles | None = None) -> Session:
    """Open an annotation session: read photos, model, camera and earlier annotations."""
    files = files or find_session_files(options)
    shape, (first, path) = ObjectShape.open(options.shape), files[0]
    up_axis = options.up_axis
    if options.model is None:
        model = open_skeleton(shape)
        up_axis = up_axis or (None if shape.learned is None else shape.learned.up_axis)
    else:
        model = open_model(options.model, path.parent, keypoints=options.keypoints, shape=shape)
    size = first.width, first.height
    given = None if options.camera is None else read_camera(options.camera, size=size)
    session = Session(model)
    for photo, path in files:
        camera = camera_of(photo, given)
        if options.focal is not None:
            camera = camera.replace_focal(options.focal)
        file = ObservationFile(path, photo)
        marks = file.read(model, camera, up_axis=up_axis)
        session.photos.append(Annotation(file, History(marks)))
    return session


def _open_photos(paths: list[Path]) -> list[PhotoFile]:
    """Open the photos; logs a warning for each file that cannot be read."""
    photos = []
    for path in paths:
        try:
            photos.append(PhotoFile.open(path))
        except DataError as error:
            logger.warning("left out: %s", error)
    if not photos:
        raise DataError("none of the photos in this folder can be read", where=str(paths[0].parent))
    return photos
