"""The objects of photos: their state in one photo, what a photo lists, and their observations."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.annotate.document import AnnotationDocument, Pair, Pixel
from cadalign.annotate.estimate import LEAST_JOINT_PAIRS, LiveEstimate
from cadalign.annotate.evidence import FurtherEvidence, MaskDrawing
from cadalign.annotate.files import AnnotationFiles, written_unfinished, written_view
from cadalign.annotate.history import History
from cadalign.annotate.live import LiveAlignment
from cadalign.annotate.masks import draw_mask
from cadalign.annotate.models import KeypointRegistry, OpenedModel, Proposal
from cadalign.annotate.names import file_name, mask_file, object_number
from cadalign.annotate.object_shape import ObjectShape
from cadalign.annotate.photos import Intrinsics, PhotoFile
from cadalign.annotate.suggestion import Suggestion
from cadalign.arrays import FloatArray
from cadalign.errors import CadalignError, InputError
from cadalign.geometry.camera import Camera
from cadalign.io.evidence import ObservedImage
from cadalign.io.images import write_image
from cadalign.io.observation import Observation


@dataclass(eq=False)
class PhotoState:
    """One object in one photo, its annotation, and the outcome of the last save.

    In a further photo of the object, ``lead`` is the state in its first one; ``views`` are those
    in the further ones, also where undoing took them back. All share the object's history.
    """

    photo: PhotoFile
    files: AnnotationFiles
    intrinsics: Intrinsics
    history: History
    model: OpenedModel
    further: FurtherEvidence = field(default_factory=FurtherEvidence)
    proposals: tuple[Proposal, ...] = ()  # of a detector
    lead: PhotoState | None = None
    views: list[PhotoState] = field(default_factory=list)
    saved_at: float | None = None
    save_error: str = ""
    drawn: tuple[MaskDrawing, Path, bool] | None = None
    """The mask that was written last, its file, and whether anything is in it."""
    fit_pending: bool = False
    """True if the alignment's file is still to be written, since the solvers were not ready."""
    live: tuple[object, LiveAlignment, Suggestion | None] | None = field(default=None, repr=False)
    """The last alignment and suggestion, with their document and estimates of the others."""
    estimate: tuple[AnnotationDocument, LiveEstimate | CadalignError] | None = field(
        default=None, repr=False
    )
    """The last estimate of the object alone, from all photos, with the document it belongs to."""

    @property
    def document(self) -> AnnotationDocument:
        """The current annotation in this photo; an empty one while it shows no view."""
        whole = self.history.document
        return whole if self.lead is None else whole.view(self.key) or AnnotationDocument()

    @property
    def marked(self) -> AnnotationDocument:
        """The current annotation in this photo alone."""
        return replace(self.document, further_views=())

    def record(self, document: AnnotationDocument, *, step: object = None) -> None:
        """Go on to another annotation of this photo; see `History.record`."""
        if self.lead is not None:
            document = self.history.document.with_view(self.key, document)
            step = None if step is None else (self.key, step)
        self.history.record(document, step=step)

    @property
    def owner(self) -> PhotoState:
        """The state in the object's first photo."""
        return self.lead or self

    @property
    def key(self) -> str:
        """The photo as `FurtherView` names it."""
        return str(self.photo.path.resolve())

    @property
    def is_shown(self) -> bool:
        """True unless the photo was removed from the object, or that deleted."""
        whole = self.history.document
        return not whole.is_gone if self.lead is None else whole.view(self.key) is not None

    @property
    def all_views(self) -> tuple[PhotoState, ...]:
        """The states in all photos of the object that are shown."""
        lead = self.owner
        return (lead, *(view for view in lead.views if view.is_shown))

    @property
    def camera(self) -> Camera:
        """The camera, with an assumed focal length where that is unknown."""
        return self.intrinsics.with_focal(self.document.focal)

    @property
    def is_rigid(self) -> bool:
        """True if the poses of the cameras of the object's photos are known."""
        views = (self.further.image, *(view.evidence for view in self.further.others))
        return any(view.cam_from_rig is not None for view in views)

    def mask_file(self, base: str | None) -> Path:
        """Path of the mask to draw, not the file of the one under its strokes."""
        observation = self.files.observation
        if self.lead is not None:  # several photos share the observation
            stem = f"{observation.stem}.{self.photo.path.stem}"
            observation = observation.with_name(file_name(stem, ".json"))
        return mask_file(observation, base)

    def require_inside(self, uv: Pixel) -> None:
        """Refuse a place outside the photo."""
        if not self.intrinsics.camera.contains(np.array([uv]))[0]:
            what = f"({uv[0]:.1f}, {uv[1]:.1f}) is outside the photo"
            raise InputError(what, where="uv", fix="place it inside")

    def add_view(self, photo: PhotoFile, intrinsics: Intrinsics) -> PhotoState:
        """The state of the object in a further photo, which its history does not have yet."""
        files = replace(self.files, image=photo.path)
        view = PhotoState(photo, files, intrinsics, self.history, self.model, lead=self)
        self.views.append(view)
        return view


class Deletions:
    """Objects of each photo that were deleted while the program runs, to bring them back."""

    def __init__(self) -> None:
        self._deleted: dict[int, list[PhotoState]] = {}
        self._just_now: set[int] = set()

    def add(self, photo: int, owner: PhotoState) -> None:
        """Remember an object that was deleted in a photo."""
        self._deleted.setdefault(photo, []).append(owner)
        self._just_now.add(photo)

    def note_change(self, photo: int) -> None:
        """Something else was changed in a photo: undoing concerns that."""
        self._just_now.discard(photo)

    def last(self, photo: int, *, at_once: bool = False) -> PhotoState | None:
        """The object that was deleted last and still is; ``at_once`` if nothing came after it."""
        if at_once and photo not in self._just_now:
            return None
        deleted = self._deleted.get(photo, [])
        while deleted and not deleted[-1].document.is_gone:
            deleted.pop()
        return deleted[-1] if deleted else None


def shown_objects(states: Sequence[PhotoState]) -> list[PhotoState]:
    """The objects of a photo that are listed.

    The first one is left out if nothing was ever marked for it and there are others.
    """
    if not states:
        return []
    first, *others = states
    shown = [state for state in others if state.is_shown]
    is_used = not first.document.is_empty or first.document.name or first.files.observation.exists()
    if not shown or (is_used and first.is_shown):
        return [first, *shown]
    return shown


def label_of(state: PhotoState) -> str:
    """The object's name, by default its number in its first photo."""
    owner = state.owner
    if owner.document.name:
        return owner.document.name
    label = f"object {object_number(owner.files.observation)}"
    return label if state is owner else f"{label} of {owner.photo.path.name}"


@dataclass(eq=False)
class Observer:
    """Makes observations of states, with the object's shape if it is estimated.

    ``before_writing`` is called before a painted mask is written, and may refuse it.
    """

    shape: ObjectShape | None
    before_writing: Callable[[], None]

    def observation(
        self,
        state: PhotoState,
        *,
        fit_options: Mapping[str, Any] | None = None,
        to_write: bool = False,
    ) -> Observation:
        """The observation of an object, beginning at one of its photos.

        ``to_write`` leaves out focal lengths that are not known, and adds what is unfinished.
        """
        further = self.further(state, to_write=to_write)
        document, options = state.document, dict(fit_options or {})
        fields: dict[str, Any] = {"model": state.files.model, "object_name": document.name or None}
        if self.shape is not None:
            fields["shape"] = self.shape.path
            if self.shape.sigma is not None:
                options["shape_sigma"] = self.shape.sigma
        if document.evidence.photo:
            options["image"] = True
        if self.begins(state):
            assert document.evidence.start is not None
            fields["init"] = document.evidence.start.alignment
        if to_write:
            fields["unfinished"] = self._unfinished(state)
        image = self._keypoints(state, to_write=to_write)
        return further.added_to(image, fit_options=options, **fields)

    def begins(self, state: PhotoState) -> bool:
        """True if the search begins where the user chose, for there are too few pairs."""
        pairs = known_pairs(state.document, state.model.registry, self.shape)
        return state.document.evidence.start is not None and len(pairs) < LEAST_JOINT_PAIRS

    def further(self, state: PhotoState, *, to_write: bool = False) -> FurtherEvidence:
        """The evidence beside a photo's pairs; photos without anything that counts are left out."""
        own, owner = self._own_evidence(state), state.owner
        others: list[ObservedImage] = []
        place = 0
        for each in self.views_in_order(owner):
            if each is state:
                place = len(others)
            elif isinstance(each, ObservedImage):
                others.append(each)
            elif has_evidence(image := self.image(each, to_write=to_write)):
                others.append(image)
        kept = {name: getattr(owner.further, name) for name in ("sigma", "symmetry", "up_axis")}
        return replace(own, others=tuple(others), place=place, **kept)

    def image(self, state: PhotoState, *, to_write: bool = False) -> ObservedImage:
        """A photo with its pairs that count and what is known beside them."""
        own = self._own_evidence(state)
        return own.added_to_image(self._keypoints(state, to_write=to_write))

    def counts(self, state: PhotoState) -> bool:
        """True if anything of a photo counts."""
        return has_evidence(self.image(state))

    def views_in_order(self, owner: PhotoState) -> list[PhotoState | ObservedImage]:
        """The views of an object in the order of its observation, those added last at the end.

        An image of the observation file that cannot be annotated stays as it is in the file.
        """
        further = owner.further
        stored: list[PhotoState | ObservedImage] = [*further.others]
        stored.insert(further.place, owner)
        by_photo = {view.key: view for view in owner.views}
        views: list[PhotoState | ObservedImage] = []
        for each in stored:
            known = by_photo.get(_key_of(each))
            if known is None:
                views.append(each)
            elif known.is_shown:
                views.append(known)
        return [*views, *(view for view in owner.all_views if view not in views)]

    def _keypoints(self, state: PhotoState, *, to_write: bool) -> ObservedImage:
        registry, document = state.model.registry, state.document
        pairs = known_pairs(document, registry, self.shape)
        keypoints = [pair.keypoint for pair in pairs if pair.keypoint is not None]
        depths = [np.nan if pair.depth is None else pair.depth for pair in pairs]
        return ObservedImage(
            points_3d=registry.xyz(keypoints),
            points_2d=np.array([pair.uv for pair in pairs], dtype=float).reshape(-1, 2),
            camera=state.intrinsics.to_write(document.focal) if to_write else state.camera,
            sigma=filled(pair.sigma for pair in pairs),
            ids=np.array(keypoints, dtype=np.int64),
            names=tuple(registry[keypoint].name for keypoint in keypoints),
            scores=filled(pair.score for pair in pairs),
            image=state.files.image,
            depths=np.array(depths) if np.isfinite(depths).any() else None,
        )

    def _own_evidence(self, state: PhotoState) -> FurtherEvidence:
        """The evidence of a photo beside its pairs; a painted mask is written to its file."""
        evidence = state.document.evidence
        drawing, drawn = evidence.mask, None
        if drawing is not None and drawing.strokes:
            drawn = state.mask_file(drawing.base)
            if state.drawn is None or state.drawn[:2] != (drawing, drawn):
                mask = draw_mask(drawing, state.photo.width, state.photo.height)
                if mask.any():
                    self.before_writing()
                    write_image(drawn, np.where(mask, 255, 0).astype(np.uint8))
                state.drawn = (drawing, drawn, bool(mask.any()))
            drawn = drawn if state.drawn[2] else None
        return evidence.added_to(state.further, state.camera, drawn)

    def _unfinished(self, state: PhotoState) -> dict[str, Any] | None:
        """Pairs that are no keypoints of the observation, and further photos without any."""
        views = []
        for view in state.all_views[1:]:
            pairs = self._other_pairs(view)
            if pairs or not self.counts(view):
                camera = view.intrinsics.to_write(view.document.focal)
                views.append(written_view(view.files, camera, pairs))
        return written_unfinished(self._other_pairs(state), views)

    def _other_pairs(self, state: PhotoState) -> list[Pair]:
        used = known_pairs(state.document, state.model.registry, self.shape)
        return [pair for pair in state.document.pairs if pair not in used]


def known_pairs(
    document: AnnotationDocument, registry: KeypointRegistry, shape: ObjectShape | None
) -> tuple[Pair, ...]:
    """Complete pairs whose keypoints the shape knows; all of them without a shape."""
    return tuple(
        pair
        for pair in document.complete_pairs
        if shape is None or shape.knows(registry[pair.keypoint or 0])
    )


def filled(values: Iterable[float | None]) -> FloatArray | None:
    """The values (n,), 1 where one is missing; None if all are missing."""
    listed = list(values)
    if all(value is None for value in listed):
        return None
    return np.array([1.0 if value is None else value for value in listed])


def has_evidence(image: ObservedImage) -> bool:
    """True if an image has keypoints or other evidence of the object."""
    return bool(len(image.points_2d) or image.evidence.given)


def _key_of(view: PhotoState | ObservedImage) -> str:
    if isinstance(view, PhotoState):
        return view.key
    return "" if view.image is None else str(view.image.resolve())
