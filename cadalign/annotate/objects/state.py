"""State of one object in one photo: its annotation, and the outcome of the last save."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from cadalign.annotate.alignment import LiveAlignment
from cadalign.annotate.document import AnnotationDocument, History
from cadalign.annotate.evidence import MaskDrawing
from cadalign.annotate.files import AnnotationFiles
from cadalign.annotate.further import FurtherEvidence
from cadalign.annotate.names import file_name, mask_file
from cadalign.annotate.objects.models import OpenedModel
from cadalign.annotate.objects.unfinished import LeftOut
from cadalign.annotate.objects.view_history import ViewHistory
from cadalign.annotate.photos import Intrinsics, PhotoFile
from cadalign.annotate.proposals import Proposal
from cadalign.annotate.shape_alignment import JointEstimate, LiveShape
from cadalign.annotate.suggestion import Suggestion
from cadalign.geometry.camera import Camera

Live = LiveAlignment | LiveShape
"""Alignment of the pairs placed so far, of the stretched model or of the object's own shape."""


@dataclass(eq=False)
class PhotoState:
    """One object in one photo, its annotation, and the outcome of the last save.

    In a further photo of the object, ``lead`` is the state in its first one; ``views`` are those
    in the further ones, also where undoing took them back.
    """

    photo: PhotoFile
    files: AnnotationFiles
    intrinsics: Intrinsics
    history: History | ViewHistory
    model: OpenedModel
    further: FurtherEvidence = field(default_factory=FurtherEvidence)
    proposals: tuple[Proposal, ...] = ()  # of a detector
    lead: PhotoState | None = None
    views: list[PhotoState] = field(default_factory=list)
    saved_at: float | None = None
    save_error: str = ""
    drawn: tuple[MaskDrawing, Path, bool] | None = None
    """The mask that was written last, its file, and whether anything is in it."""
    unfinished: LeftOut = field(default_factory=LeftOut)
    """What the file beside the observation has."""
    fit_pending: bool = False
    """True if the alignment's file is still to be written, since the solvers were not ready."""
    live: tuple[AnnotationDocument, Live, Suggestion | None] | None = field(
        default=None, repr=False
    )
    """What was computed last, of that document of the object."""
    joint: tuple[AnnotationDocument, JointEstimate] | None = field(default=None, repr=False)
    """The estimate from all photos that was computed last."""

    @property
    def document(self) -> AnnotationDocument:
        """The current annotation in this photo."""
        return self.history.document

    @property
    def marked(self) -> AnnotationDocument:
        """The current annotation in this photo alone."""
        return replace(self.document, further_views=())

    @property
    def object_document(self) -> AnnotationDocument:
        """The current annotation of the object in all its photos."""
        return self.history.object_document

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
        if self.lead is None:
            return not self.document.is_gone
        return self.object_document.view(self.key) is not None

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

    def remove_view(self) -> None:
        """Take the photo from the object."""
        assert isinstance(self.history, ViewHistory)
        self.history.remove()

    def mask_file(self, base: str | None) -> Path:
        """Path of the mask to draw, other than that of the one under its strokes."""
        observation = self.files.observation
        if self.lead is not None:  # several photos share the observation
            stem = f"{observation.stem}.{self.photo.path.stem}"
            observation = observation.with_name(file_name(stem, ".json"))
        return mask_file(observation, base)
