"""The objects of photos: one object's state in one photo, and what a photo lists."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from cadalign.annotate.document import AnnotationDocument
from cadalign.annotate.estimate import Estimate
from cadalign.annotate.evidence import FurtherEvidence, MaskDrawing
from cadalign.annotate.files import AnnotationFiles
from cadalign.annotate.history import History
from cadalign.annotate.keypoints import Proposal
from cadalign.annotate.live import LiveAlignment
from cadalign.annotate.models import OpenedModel
from cadalign.annotate.names import file_name, mask_file, object_number
from cadalign.annotate.photos import Intrinsics, PhotoFile
from cadalign.annotate.suggestion import Suggestion
from cadalign.geometry.camera import Camera


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
    live: tuple[AnnotationDocument, LiveAlignment, Suggestion | None] | None = field(
        default=None, repr=False
    )
    """What was computed last, of that document of the object."""
    estimate: tuple[AnnotationDocument, Estimate] | None = field(default=None, repr=False)
    """The estimate from all photos that was computed last."""

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

    def remove_view(self) -> None:
        """Take the photo from the object."""
        self.history.record(self.history.document.without_view(self.key))

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
        """Path of the mask to draw, other than that of the one under its strokes."""
        observation = self.files.observation
        if self.lead is not None:  # several photos share the observation
            stem = f"{observation.stem}.{self.photo.path.stem}"
            observation = observation.with_name(file_name(stem, ".json"))
        return mask_file(observation, base)

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
