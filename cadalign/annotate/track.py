"""Frames of a video: keypoints marked in some of them, predicted in the others."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cadalign.annotate.document import AnnotationDocument
from cadalign.annotate.estimate import LEAST_PAIRS
from cadalign.annotate.models import Proposal
from cadalign.annotate.objects import PhotoState
from cadalign.arrays import FloatArray
from cadalign.errors import CadalignError, InputError
from cadalign.estimation.align import align
from cadalign.estimation.model import Model
from cadalign.estimation.result import Result
from cadalign.estimation.view import View
from cadalign.io.images import write_image
from cadalign.io.video import Video, frame_numbers
from cadalign.render.viewpoints import visible_keypoints
from cadalign.shapes.model import ShapeModel
from cadalign.solvers.projection import predicted_covariances, projection_jacobian

if TYPE_CHECKING:
    from cadalign.annotate.session import Session

_RATE = 30.0  # frames in a second, of which only the strength of the motion depends
_CLICK_SIGMA = 2.0  # [px]
_LEAST_FRAMES = 3  # with pairs: two do not say how the motion changes
_MOST_UNCERTAIN = 0.05  # standard deviation of a prediction that is still shown [image widths]


def write_frames(video: Path, folder: Path, *, every: int) -> Path:
    """Write every so many frames of a video as photos; those that are there stay as they are.

    Returns the folder. Raises DataError if the video cannot be read.
    """
    if every < 1:
        raise InputError(f"{every} is not positive", where="--every")
    opened = Video.open(video)
    folder.mkdir(parents=True, exist_ok=True)
    for number, picture in opened.pictures():
        path = folder / f"frame_{number:06d}.png"
        if number % every == 0 and not path.exists():
            write_image(path, picture)
    return folder


@dataclass(eq=False)
class FrameTrack:
    """The first object of each photo as one object in successive frames of a video."""

    times: tuple[float, ...]  # of the photos [s]
    _known: tuple[tuple[AnnotationDocument, ...], Result | None] | None = field(
        default=None, init=False
    )

    @classmethod
    def of(cls, photos: list[PhotoState]) -> FrameTrack:
        """The track of photos whose frames are numbered by their names."""
        names = [state.photo.path.name for state in photos]
        numbers = frame_numbers(names)
        return cls(tuple(numbers[name] / _RATE for name in names))

    def proposals(self, session: Session, number: int) -> tuple[Proposal, ...]:
        """Keypoints that the motion puts into the photo of a number, with their uncertainty.

        None without a frame that has enough pairs, nor in photos that were opened for an object.
        """
        if number >= len(self.times) or not session.ready:
            return ()
        states = [states[0] for states in session.objects[: len(self.times)]]
        documents = tuple(state.document for state in states)
        if self._known is None or self._known[0] != documents:
            self._known = documents, self._aligned(session, states)
        result = self._known[1]
        if result is None:
            return ()
        state, view = session.objects[number][0], result.views[number]
        if view.covariance is None:
            return ()
        ids, points = _own_points(session, state, result)
        uncertain = np.full(len(points), np.inf)  # standard deviations by that of the pose [px]
        ahead = view.camera.sees(view.alignment.apply(points))
        slopes = projection_jacobian(points[ahead], view.camera, view.alignment)
        covariances = predicted_covariances(slopes, view.covariance[:6, :6])
        uncertain[ahead] = np.sqrt(np.trace(covariances, axis1=1, axis2=2) / 2)
        seen = np.flatnonzero(uncertain < _MOST_UNCERTAIN * view.camera.width)
        if session.shape is None:
            scene = state.model.cad.scene
            seen = seen[visible_keypoints(scene, points[seen], view.camera, view.alignment)]
        pixels = view.camera.project(view.alignment.apply(points[seen]))
        inside = view.camera.contains(pixels)
        return tuple(
            Proposal(ids[row], (float(u), float(v)), sigma=float(uncertain[row]))
            for row, (u, v) in zip(seen[inside], pixels[inside], strict=True)
        )

    def _aligned(self, session: Session, states: list[PhotoState]) -> Result | None:
        """The smooth estimate from all frames; None where there is none."""
        registry = states[0].model.registry
        shape, views = session.shape, []
        for state, time in zip(states, self.times, strict=True):
            pairs = state.known_pairs
            points = [registry[pair.keypoint or 0] for pair in pairs]
            ids = [each.semantic_id if shape is None else shape.id_of(each) for each in points]
            uv = [pair.uv for pair in pairs if pair.uv is not None]
            views.append(View(state.camera, uv, ids=ids, sigma=_CLICK_SIGMA, time=time))
        counts = [len(view.keypoint_ids) for view in views]
        if max(counts) < LEAST_PAIRS or np.count_nonzero(counts) < _LEAST_FRAMES:
            return None
        used = {label for view in views for label in view.keypoint_ids}
        known = [point for _, point in registry]
        model: Model | ShapeModel
        if shape is not None:
            model = shape.model_with(known, states[0].model.cad.scene.mesh)
        else:
            marked = [point for point in known if point.semantic_id in used]
            model = Model(
                points_3d=[point.xyz for point in marked],
                ids=[point.semantic_id for point in marked],
                stretch_sigma=states[0].document.priors.stretch,
            )
        try:
            return align(model, views, motion="smooth")
        except CadalignError:  # what is marked so far does not determine it
            return None


def _own_points(
    session: Session, state: PhotoState, result: Result
) -> tuple[list[int], FloatArray]:
    """Keypoints of the registry, and their places (n, 3) on the object, before its stretch."""
    shape, ids, points = session.shape, [], []
    rows = {label: row for row, label in enumerate(result.ids)}
    for number, point in state.model.registry:
        if shape is None:
            ids.append(number)
            points.append(np.asarray(point.xyz))
        elif shape.id_of(point) in rows:
            ids.append(number)
            points.append(result.points_3d[rows[shape.id_of(point)]])
    return ids, np.array(points, dtype=float).reshape(-1, 3)
