"""Keypoints that could be taken: those of a detector, and in a video those of other frames."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Iterable, Sequence
from itertools import takewhile
from pathlib import Path

import numpy as np

from cadalign.annotate.models import KeypointRegistry, Proposal
from cadalign.annotate.objects import PhotoState
from cadalign.annotate.photos import PhotoFile
from cadalign.annotate.problem import LEAST_PAIRS
from cadalign.datasets.detections.image_keypoints import ImageKeypoints
from cadalign.datasets.detections.keypoint_files import read_image_keypoints
from cadalign.errors import CadalignError, DataError, InputError
from cadalign.estimation.align import align
from cadalign.estimation.model import Model
from cadalign.estimation.result import Result
from cadalign.estimation.view import View
from cadalign.io.images import Video, frame_numbers, read_photo, write_image
from cadalign.render.viewpoints import visible_keypoints
from cadalign.shapes.model import ShapeModel
from cadalign.solvers.projection import predicted_covariances, projection_jacobian

logger = logging.getLogger("cadalign")

_RATE = 30.0  # frames in a second, of which only the strength of the motion depends
_CLICK_SIGMA = 2.0  # [px]
_COMPARED = 30  # one of so many frames that are there, to know whether they are the video's
_LEAST_FRAMES = 3  # with pairs: two do not say how the motion changes
_MOST_UNCERTAIN = 0.05  # standard deviation of a prediction that is still shown [image widths]


def write_frames(video: Path, folder: Path, *, every: int) -> Path:
    """Write every so many frames of a video as photos; those that are there stay as they are.

    Returns the folder. Raises DataError if the video cannot be read, or the folder has another's.
    """
    if every < 1:
        raise InputError(f"{every} is not positive", where="--every")
    opened = Video.open(video)
    folder.mkdir(parents=True, exist_ok=True)
    taken, alike = set[str](), list[bool]()

    def refuse_others() -> None:
        if alike and not any(alike):
            fix = "rename the folder or the video, or give another --out"
            what = f"the frames there are not those of {video.name}"
            raise DataError(what, where=str(folder), fix=fix)

    for number, picture in opened.pictures():
        path = folder / f"frame_{number:06d}.png"
        if number % every:
            continue
        taken.add(path.name)
        if not path.exists():
            refuse_others()
            write_image(path, picture)
        elif number % (_COMPARED * every) == 0:
            alike.append(np.array_equal(read_photo(path), picture))
    refuse_others()
    others = sum(path.name not in taken for path in folder.glob("frame_*.png"))
    if others:
        text = "%s: has %d frames beside those of --every %d, which are photos here, too"
        logger.warning(text, folder, others, every)
    return folder


def read_proposals(
    path: Path, photos: Sequence[PhotoFile], registry: KeypointRegistry
) -> list[tuple[Proposal, ...]]:
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
        by_photo.append(_proposals(own[0], photo, registry) if own else ())
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


def _proposals(
    found: ImageKeypoints, photo: PhotoFile, registry: KeypointRegistry
) -> tuple[Proposal, ...]:
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
    proposals = []
    for keypoint, (u, v), score in zip(wanted, found.points_2d.tolist(), scores, strict=True):
        inside = -0.5 <= u <= photo.width - 0.5 and -0.5 <= v <= photo.height - 0.5
        if keypoint is not None and inside and score != 0:
            proposals.append(Proposal(keypoint, (u, v), score))
    return tuple(proposals)


def times_of(photos: Iterable[Path]) -> tuple[float, ...]:
    """Times [s] of photos that are frames of one video, numbered by their names."""
    names = [path.name for path in photos]
    numbers = frame_numbers(names)
    return tuple(numbers[name] / _RATE for name in names)


def proposals_of(state: PhotoState) -> tuple[Proposal, ...]:
    """Keypoints of a detector, and of the other frames, that could be taken.

    The motion puts the keypoints of the first object of each frame into the others, with their
    uncertainty: not without a frame that has enough pairs, nor in photos that are no frames.
    """
    session, (number, slot) = state.session, state.place
    if slot or number >= len(session.times) or not session.ready:
        return state.proposals
    frames = [states[0] for states in session.objects[: len(session.times)]]
    documents = tuple(each.document for each in frames)
    if session.tracked is None or session.tracked[0] != documents:
        session.tracked = documents, _aligned(frames, session.times)
    result = session.tracked[1]
    view = None if result is None else result.views[number]
    if result is None or view is None or view.covariance is None:
        return state.proposals
    shape, ids, places = session.shape, [], []
    rows = {label: row for row, label in enumerate(result.ids)}
    for keypoint, point in state.model.registry:
        label = shape.id_of(point)
        if not shape.is_estimated or label in rows:
            ids.append(keypoint)
            places.append(result.points_3d[rows[label]] if shape.is_estimated else point.xyz)
    points = np.array(places, dtype=float).reshape(-1, 3)  # on the object, before its stretch
    camera, pose = view.camera, view.alignment
    uncertain = np.full(len(points), np.inf)  # standard deviations by that of the pose [px]
    ahead = camera.sees(pose.apply(points))
    slopes = projection_jacobian(points[ahead], camera, pose)
    covariances = predicted_covariances(slopes, view.covariance[:6, :6])
    uncertain[ahead] = np.sqrt(np.trace(covariances, axis1=1, axis2=2) / 2)
    seen = np.flatnonzero(uncertain < _MOST_UNCERTAIN * camera.width)
    if not shape.is_estimated:
        seen = seen[visible_keypoints(state.model.cad.scene, points[seen], camera, pose)]
    pixels = camera.project(pose.apply(points[seen]))
    inside = camera.contains(pixels)
    return state.proposals + tuple(
        Proposal(ids[row], (float(u), float(v)), sigma=float(uncertain[row]))
        for row, (u, v) in zip(seen[inside], pixels[inside], strict=True)
    )


def _aligned(frames: Sequence[PhotoState], times: Sequence[float]) -> Result | None:
    """The smooth estimate from all frames; None where there is none."""
    first = frames[0]
    registry, shape, views = first.model.registry, first.session.shape, []
    for state, time in zip(frames, times, strict=True):
        pairs = state.known_pairs
        ids = [shape.id_of(point) for point in state.model.points_of(pairs)]
        uv = [pair.uv for pair in pairs if pair.uv is not None]
        views.append(View(state.camera, uv, ids=ids, sigma=_CLICK_SIGMA, time=time))
    counts = [len(view.keypoint_ids) for view in views]
    if max(counts) < LEAST_PAIRS or np.count_nonzero(counts) < _LEAST_FRAMES:
        return None
    used = {label for view in views for label in view.keypoint_ids}
    known = [point for _, point in registry]
    model: Model | ShapeModel
    if shape.is_estimated:
        model = shape.model_with(known, first.model.cad.scene.mesh)
    else:
        marked = [point for point in known if point.semantic_id in used]
        model = Model(
            points_3d=[point.xyz for point in marked],
            ids=[point.semantic_id for point in marked],
            stretch_sigma=first.document.priors.stretch,
        )
    try:
        return align(model, views, motion="smooth")
    except CadalignError:  # what is marked so far does not determine it
        return None
