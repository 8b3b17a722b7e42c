"""The objects of photos: their state in one photo, what a photo lists, and their observations."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cadalign.annotate.candidates import MaskCandidates
from cadalign.annotate.document import AnnotationDocument, History, Pair, Pixel
from cadalign.annotate.estimate import LiveAlignment
from cadalign.annotate.evidence import FurtherEvidence, MaskDrawing, draw_mask
from cadalign.annotate.files import AnnotationFiles, written_half
from cadalign.annotate.models import OpenedModel, Proposal
from cadalign.annotate.names import file_name, mask_file, object_number
from cadalign.annotate.photos import Intrinsics, PhotoFile
from cadalign.annotate.problem import LEAST_JOINT_PAIRS
from cadalign.annotate.suggestion import Suggestion
from cadalign.arrays import FloatArray
from cadalign.errors import CadalignError, InputError
from cadalign.geometry.camera import Camera
from cadalign.io.documents import written_path
from cadalign.io.evidence import ObservedImage
from cadalign.io.images import write_image
from cadalign.io.observation import Observation

if TYPE_CHECKING:
    from cadalign.annotate.session import Session


@dataclass(eq=False)
class PhotoState:
    """One object in one photo, its annotation, and the outcome of the last save.

    In a further photo of the object, ``lead`` is the state in its first one; ``views`` are those
    in the further ones, also where undoing took them back. All share the object's history.
    """

    session: Session = field(repr=False)
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
    alone: tuple[AnnotationDocument, LiveAlignment | CadalignError] | None = field(
        default=None, repr=False
    )
    """The last estimate of the object alone, from all photos, with the document it belongs to."""
    by_mask: tuple[object, dict[Camera, MaskCandidates]] | None = field(default=None, repr=False)
    """What the mask alone allows, with what it depends on."""

    @property
    def document(self) -> AnnotationDocument:
        """The current annotation in this photo; an empty one while it shows no view."""
        whole = self.history.document
        return whole if self.lead is None else whole.view(self.key) or AnnotationDocument()

    def record(self, document: AnnotationDocument, *, step: object = None) -> None:
        """Go on to another annotation of this photo; see `History.record`."""
        if self.lead is not None:
            document = self.history.document.with_view(self.key, document)
            step = None if step is None else (self.key, step)
        self.history.record(document, step=step)

    def mark(self, **changes: Any) -> None:
        """Go on to other marks beside the pairs, which are fields of `MarkedEvidence`."""
        document = self.document
        self.record(replace(document, evidence=replace(document.evidence, **changes)))

    @property
    def owner(self) -> PhotoState:
        """The state in the object's first photo."""
        return self.lead or self

    @property
    def key(self) -> str:
        """The photo as `FurtherView` names it."""
        return str(self.photo.path.resolve())

    @property
    def place(self) -> tuple[int, int]:
        """The number of the photo, and of this object among those of the photo."""
        for number, states in enumerate(self.session.objects):
            if self in states:
                return number, states.index(self)
        raise LookupError(self.key)

    @property
    def label(self) -> str:
        """The object's name, by default its number in its first photo."""
        owner = self.owner
        if owner.document.name:
            return owner.document.name
        label = f"object {object_number(owner.files.observation)}"
        return label if self is owner else f"{label} of {owner.photo.path.name}"

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
    def beside(self) -> list[PhotoState]:
        """The other objects of the photo."""
        shown = shown_objects(self.session.objects[self.place[0]])
        return [each for each in shown if each.owner is not self.owner]

    @property
    def camera(self) -> Camera:
        """The camera, with an assumed focal length where that is unknown."""
        return self.intrinsics.with_focal(self.document.focal)

    @property
    def known_pairs(self) -> tuple[Pair, ...]:
        """Complete pairs whose keypoints the shape knows; all of them without a shape."""
        shape, registry = self.session.shape, self.model.registry
        return tuple(
            pair
            for pair in self.document.complete_pairs
            if shape is None or shape.knows(registry[pair.keypoint or 0])
        )

    @property
    def allowed_by_mask(self) -> dict[Camera, MaskCandidates]:
        """Alignments that the mask alone allows, kept until more than pairs changes."""
        document = self.document
        key = replace(document.evidence, start=None), document.priors, self.model
        if self.by_mask is None or self.by_mask[0] != key:
            self.by_mask = key, {}
        return self.by_mask[1]

    @property
    def begins(self) -> bool:
        """True if the search begins where the user chose, for there are too few pairs."""
        is_chosen = self.document.evidence.start is not None
        return is_chosen and len(self.known_pairs) < LEAST_JOINT_PAIRS

    @property
    def mask(self) -> np.ndarray[Any, np.dtype[np.bool_]]:
        """The mask of the object, (h, w); empty without one."""
        drawing = self.document.evidence.mask or MaskDrawing()
        return draw_mask(drawing, self.photo.width, self.photo.height)

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
        own = self.files, intrinsics, self.history, self.model
        view = PhotoState(self.session, photo, *own, lead=self)
        self.views.append(view)
        return view

    def observed(self) -> tuple[Observation, int]:
        """The pairs that count with the evidence beside them, and the photo's number in it."""
        observation = self.observation()
        return observation, [view.image for view in observation.views].index(self.photo.path)

    def observation(
        self, *, fit_options: Mapping[str, Any] | None = None, to_write: bool = False
    ) -> Observation:
        """The observation of the object, beginning at this photo.

        Photos without anything that counts are left out. ``to_write`` leaves out focal lengths that
        are not known, and adds what is unfinished.
        """
        shape, document, options = self.session.shape, self.document, dict(fit_options or {})
        fields: dict[str, Any] = {"model": self.model.path, "object_name": document.name or None}
        if shape is not None:
            fields["shape"] = shape.path
            if shape.sigma is not None:
                options["shape_sigma"] = shape.sigma
        if document.evidence.photo:
            options["image"] = True
        if self.begins:
            assert document.evidence.start is not None
            fields["init"] = document.evidence.start.alignment
        if to_write:
            fields["unfinished"] = self._unfinished()
        others: list[ObservedImage] = []
        place = 0
        for each in self._views_in_order():
            if each is self:
                place = len(others)
                continue
            image = each if isinstance(each, ObservedImage) else each.image(to_write=to_write)
            if isinstance(each, ObservedImage) or has_evidence(image):
                others.append(image)
        of_owner = self.owner.further
        kept = {name: getattr(of_owner, name) for name in ("sigma", "symmetry", "up_axis")}
        further = replace(self._own_evidence(), others=tuple(others), place=place, **kept)
        image = self._keypoints(to_write=to_write)
        return further.added_to(image, fit_options=options, **fields)

    def image(self, *, to_write: bool = False) -> ObservedImage:
        """The photo with its pairs that count and what is known beside them."""
        return self._own_evidence().added_to_image(self._keypoints(to_write=to_write))

    @property
    def counts(self) -> bool:
        """True if anything of the photo counts."""
        return has_evidence(self.image())

    @property
    def used_views(self) -> list[PhotoState]:
        """The object's photos that count, this one among them."""
        return [view for view in self.all_views if view is self or view.counts]

    @property
    def estimates_focal(self) -> bool:
        """True if the focal lengths of the object's photos are estimated.

        Not where that of some photo is known, or the photos' EXIF data differ: `cadalign.align`
        estimates those of all views, with one prior.
        """
        used = self.used_views
        if self.document.focal.known or any(view.document.focal.known for view in used):
            return False
        stored = [view for view in self.owner._views_in_order() if isinstance(view, ObservedImage)]
        if any(view.camera.focal_known for view in stored):
            return False
        known = [prior for view in used if (prior := view.intrinsics.prior) is not None]
        return all(prior.is_like(known[0]) for prior in known)

    def _views_in_order(self) -> list[PhotoState | ObservedImage]:
        """The views of the object in the order of its observation, those added last at the end.

        An image of the observation file that cannot be annotated stays as it is in the file.
        """
        owner = self.owner
        stored: list[PhotoState | ObservedImage] = [*owner.further.others]
        stored.insert(owner.further.place, owner)
        by_photo = {view.key: view for view in owner.views}
        views: list[PhotoState | ObservedImage] = []
        for each in stored:
            known = by_photo.get(_key_of(each))
            if known is None:
                views.append(each)
            elif known.is_shown:
                views.append(known)
        return [*views, *(view for view in owner.all_views if view not in views)]

    def _keypoints(self, *, to_write: bool) -> ObservedImage:
        registry, pairs = self.model.registry, self.known_pairs
        keypoints = [pair.keypoint for pair in pairs if pair.keypoint is not None]
        depths = [np.nan if pair.depth is None else pair.depth for pair in pairs]
        focal = self.document.focal
        return ObservedImage(
            points_3d=registry.xyz(keypoints),
            points_2d=np.array([pair.uv for pair in pairs], dtype=float).reshape(-1, 2),
            camera=self.intrinsics.to_write(focal) if to_write else self.camera,
            sigma=filled(pair.sigma for pair in pairs),
            ids=np.array(keypoints, dtype=np.int64),
            names=tuple(registry[keypoint].name for keypoint in keypoints),
            scores=filled(pair.score for pair in pairs),
            image=self.photo.path,
            depths=np.array(depths) if np.isfinite(depths).any() else None,
        )

    def _own_evidence(self) -> FurtherEvidence:
        """The evidence of the photo beside its pairs; a painted mask is written to its file."""
        evidence = self.document.evidence
        drawing, drawn = evidence.mask, None
        if drawing is not None and drawing.strokes:
            drawn = self.mask_file(drawing.base)
            if self.drawn is None or self.drawn[:2] != (drawing, drawn):
                mask = self.mask
                if mask.any():
                    self.session.before_saving()
                    write_image(drawn, np.where(mask, 255, 0).astype(np.uint8))
                self.drawn = (drawing, drawn, bool(mask.any()))
            drawn = drawn if self.drawn[2] else None
        return evidence.added_to(self.further, self.camera, drawn)

    def _unfinished(self) -> dict[str, Any] | None:
        """Pairs that are no keypoints of the observation, and further photos without any."""
        views = [
            {
                "image": written_path(view.photo.path, folder=view.files.observation.parent),
                "camera": view.intrinsics.to_write(view.document.focal).to_dict(
                    pixel_origin="corner"
                ),
                "pairs": pairs,
            }
            for view in self.all_views[1:]
            if (pairs := view._other_pairs()) or not view.counts
        ]
        parts = {"pairs": self._other_pairs(), "views": views}
        return {name: part for name, part in parts.items() if part} or None

    def _other_pairs(self) -> list[dict[str, Any]]:
        used = self.known_pairs
        return [written_half(pair) for pair in self.document.pairs if pair not in used]


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
