"""Objects of photos: their annotation in all photos and in one, and their observations."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from cadalign.annotate.document import AnnotationDocument, History, Pair, Pixel
from cadalign.annotate.estimate import LiveAlignment
from cadalign.annotate.evidence import MaskDrawing, draw_mask
from cadalign.annotate.files import AnnotationFiles, written_half
from cadalign.annotate.models import Detected, OpenedModel
from cadalign.annotate.names import file_name, mask_files, object_number
from cadalign.annotate.photos import Intrinsics, PhotoFile
from cadalign.annotate.problem import LEAST_JOINT_PAIRS
from cadalign.annotate.suggestion import Suggestion
from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import CadalignError, InputError
from cadalign.estimation.result import Result
from cadalign.geometry.camera import Camera
from cadalign.geometry.symmetry import Symmetry
from cadalign.io.documents import written_path
from cadalign.io.evidence import ImageEvidence, ObservedImage
from cadalign.io.images import write_image
from cadalign.io.observation import Observation

if TYPE_CHECKING:
    from cadalign.annotate.session import Session


@dataclass(eq=False)
class AnnotatedObject:
    """An object in all of its photos, its model and files, and the outcome of the last save."""

    session: Session = field(repr=False)
    model: OpenedModel
    files: AnnotationFiles
    history: History
    sigma: float | None = None
    """Stored standard deviation of all keypoints in place of their own [px]."""
    symmetry: Symmetry | None = None  # the model's; kept, but without effect while pairs are marked
    up_axis: Literal["x", "y", "z"] | None = "y"  # the model's
    views: list[PhotoState | ObservedImage] = field(default_factory=list)
    """Its photos in the order of the observation, also where undoing took them back.

    An image of the observation file that cannot be annotated stays as it is in the file.
    """
    first: PhotoState = field(init=False, repr=False)  # the photo that its files are named after
    saved_at: float | None = None
    save_error: str = ""
    fit_pending: bool = False
    """True if the alignment's file is still to be written, since the solvers were not ready."""
    alone: tuple[AnnotationDocument, LiveAlignment | CadalignError] | None = field(
        default=None, repr=False
    )
    """The last estimate of the object alone, from all photos, with the document it belongs to."""
    by_mask: tuple[object, dict[Camera, Result]] | None = field(default=None, repr=False)
    """Estimates by the mask alone, with what they depend on."""

    @property
    def document(self) -> AnnotationDocument:
        """The current annotation: that in the first photo, which has those in the others."""
        return self.history.document

    @property
    def states(self) -> list[PhotoState]:
        """The states in all photos, the first one first, also where undoing took them back."""
        known = (view for view in self.views if isinstance(view, PhotoState))
        return sorted(known, key=lambda view: view is not self.first)

    @property
    def shown(self) -> list[PhotoState]:
        """The states in the first photo, and in the others that are shown."""
        return [view for view in self.states if view is self.first or view.is_shown]

    @property
    def estimates_by_mask(self) -> dict[Camera, Result]:
        """Estimates by the mask alone, kept until more than pairs changes."""
        document = self.document
        key = replace(document.evidence, start=None), document.priors, self.model
        if self.by_mask is None or self.by_mask[0] != key:
            self.by_mask = key, {}
        return self.by_mask[1]

    @property
    def unfinished(self) -> dict[str, Any] | None:
        """Pairs that are no keypoints of the observation, and further photos without any."""
        views = [
            {
                "image": written_path(view.photo.path, folder=self.files.observation.parent),
                "camera": view.intrinsics.to_write(view.document.focal).to_dict(
                    pixel_origin="corner"
                ),
                "pairs": pairs,
            }
            for view in self.shown[1:]
            if (pairs := view.unfinished_pairs) or not view.counts
        ]
        parts = {"pairs": self.first.unfinished_pairs, "views": views}
        return {name: part for name, part in parts.items() if part} or None


@dataclass(eq=False)
class PhotoState:
    """An object in one of its photos."""

    owner: AnnotatedObject = field(repr=False)
    photo: PhotoFile
    intrinsics: Intrinsics
    evidence: ImageEvidence = field(default_factory=ImageEvidence)
    """The photo's in the observation file, of which marks take the place."""
    detected: tuple[Detected, ...] = ()  # of a detector
    drawn: tuple[MaskDrawing, Path, bool] | None = None
    """The mask that was written last, its file, and whether anything is in it."""
    live: tuple[object, LiveAlignment, Suggestion | None] | None = field(default=None, repr=False)
    """The last alignment and suggestion, with their document and estimates of the others."""

    @property
    def session(self) -> Session:
        """The session."""
        return self.owner.session

    @property
    def model(self) -> OpenedModel:
        """The object's model."""
        return self.owner.model

    @property
    def is_first(self) -> bool:
        """True in the object's first photo."""
        return self is self.owner.first

    @property
    def document(self) -> AnnotationDocument:
        """The current annotation in this photo; an empty one while it shows no view."""
        whole = self.owner.document
        return whole if self.is_first else whole.view(self.key) or AnnotationDocument()

    def record(self, document: AnnotationDocument, *, step: object = None) -> None:
        """Go on to another annotation of this photo; see `History.record`."""
        if not self.is_first:
            document = self.owner.document.with_view(self.key, document)
            step = None if step is None else (self.key, step)
        self.owner.history.record(document, step=step)

    def mark(self, **changes: Any) -> None:
        """Go on to other marks beside the pairs, which are fields of `MarkedEvidence`."""
        document = self.document
        self.record(replace(document, evidence=replace(document.evidence, **changes)))

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
        return label if self.is_first else f"{label} of {owner.first.photo.path.name}"

    @property
    def is_shown(self) -> bool:
        """True unless the photo was removed from the object, or that deleted."""
        whole = self.owner.document
        return not whole.is_gone if self.is_first else whole.view(self.key) is not None

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
        pairs = self.document.complete_pairs
        known = self.session.shape.known(self.model.points_of(pairs))
        return tuple(pair for pair, counts in zip(pairs, known, strict=True) if counts)

    @property
    def unfinished_pairs(self) -> list[dict[str, Any]]:
        """The other pairs, as an observation holds them."""
        used = self.known_pairs
        return [written_half(pair) for pair in self.document.pairs if pair not in used]

    @property
    def begins(self) -> bool:
        """True if the search begins where the user chose, for there are too few pairs."""
        is_chosen = self.document.evidence.start is not None
        return is_chosen and len(self.known_pairs) < LEAST_JOINT_PAIRS

    @property
    def mask(self) -> BoolArray:
        """The mask of the object, (h, w); empty without one."""
        drawing = self.document.evidence.mask or MaskDrawing()
        return draw_mask(drawing, self.photo.width, self.photo.height)

    def mask_file(self, base: str | None) -> Path:
        """Path of the mask to draw: no file under its strokes, nor one that was not drawn here."""
        first, second = self.mask_files
        is_base = base is not None and Path(base).resolve() == first.resolve()
        is_own = self.drawn is not None and self.drawn[1] == first
        return second if is_base or (first.exists() and not is_own) else first

    @property
    def mask_files(self) -> tuple[Path, Path]:
        """Paths that the mask may have."""
        observation = self.owner.files.observation
        if not self.is_first:  # several photos share the observation
            stem = f"{observation.stem}.{self.photo.path.stem}"
            observation = observation.with_name(file_name(stem, ".json"))
        return mask_files(observation)

    def require_inside(self, uv: Pixel) -> None:
        """Refuse a place outside the photo."""
        if not self.intrinsics.camera.contains(np.array([uv]))[0]:
            what = f"({uv[0]:.1f}, {uv[1]:.1f}) is outside the photo"
            raise InputError(what, where="uv", fix="place it inside")

    @property
    def counts(self) -> bool:
        """True if anything of the photo counts."""
        return has_evidence(self.image())

    @property
    def used_views(self) -> list[PhotoState]:
        """The object's photos that count, this one among them."""
        return [view for view in self.owner.shown if view is self or view.counts]

    @property
    def estimates_focal(self) -> bool:
        """True if the focal lengths of the object's photos are estimated.

        Not where that of some photo is known, or the photos' EXIF data differ: `cadalign.align`
        estimates those of all views, with one prior.
        """
        used = self.used_views
        if any(view.document.focal.known for view in (self, *used)):
            return False
        kept = (view for view in self.owner.views if isinstance(view, ObservedImage))
        if any(view.camera.focal_known for view in kept):
            return False
        known = [prior for view in used if (prior := view.intrinsics.prior) is not None]
        return all(prior.is_like(known[0]) for prior in known)

    def observed(self) -> tuple[Observation, int]:
        """The pairs that count with the evidence beside them, and the photo's number in it."""
        observation = self.observation()
        return observation, [view.image for view in observation.views].index(self.photo.path)

    def observation(
        self, *, fit_options: Mapping[str, Any] | None = None, to_write: bool = False
    ) -> Observation:
        """The observation of the object, with the stored noise and the priors beside options.

        Other photos without anything that counts are left out. ``to_write`` leaves out focal
        lengths that are not known, and adds what is unfinished.
        """
        owner, shape, document = self.owner, self.session.shape, self.document
        marks, likely = document.evidence, self.intrinsics.likely_focal
        options: dict[str, Any] = {} if owner.sigma is None else {"sigma": owner.sigma}
        options |= {**document.priors.fit_options(likely), **(fit_options or {})}
        if shape.sigma is not None:
            options["shape_sigma"] = shape.sigma
        if marks.photo:
            options["image"] = True
        images: list[ObservedImage] = []
        for view in owner.views:
            if isinstance(view, ObservedImage):
                images.append(view)
            elif view is self or view.is_shown:
                image = view.image(to_write=to_write)
                if view is self or has_evidence(image):
                    images.append(image)
        first, *others = images
        return Observation(
            **{each.name: getattr(first, each.name) for each in fields(ObservedImage)},
            others=tuple(others),
            model=self.model.path,
            fit_options=options,
            size=None if marks.lengths is None else marks.lengths.size,
            shape=shape.path,
            symmetry=owner.symmetry,
            init=marks.start.alignment if marks.start is not None and self.begins else None,
            object_name=document.name or None,
            up_axis=owner.up_axis,
            unfinished=owner.unfinished if to_write else None,
        )

    def image(self, *, to_write: bool = False) -> ObservedImage:
        """The photo with its pairs that count and what is known beside them."""
        pairs, document = self.known_pairs, self.document
        points = self.model.points_of(pairs)
        depths = [np.nan if pair.depth is None else pair.depth for pair in pairs]
        has_depths = bool(np.isfinite(depths).any())
        marks = document.evidence.as_written(self.camera, self._drawn_mask())
        evidence = marks.in_place_of(self.evidence)
        if not has_depths and evidence.depth is None:  # all keypoints with depths may be gone
            evidence = replace(evidence, depth_sigma=None)
        return ObservedImage(
            points_3d=np.array([point.xyz for point in points], dtype=float).reshape(-1, 3),
            points_2d=np.array([pair.uv for pair in pairs], dtype=float).reshape(-1, 2),
            camera=self.intrinsics.to_write(document.focal) if to_write else self.camera,
            sigma=filled(pair.sigma for pair in pairs),
            ids=np.array([point.semantic_id for point in points], dtype=np.int64),
            names=tuple(point.name for point in points),
            scores=filled(pair.score for pair in pairs),
            image=self.photo.path,
            depths=np.array(depths) if has_depths else None,
            evidence=evidence,
        )

    def _drawn_mask(self) -> Path | None:
        """The file of a painted mask, written if it is not yet; None if nothing is painted."""
        drawing = self.document.evidence.mask
        if drawing is None or not drawing.strokes:
            return None
        path = self.mask_file(drawing.base)
        if self.drawn is None or self.drawn[:2] != (drawing, path):
            mask = self.mask
            if mask.any():
                self.session.before_saving()
                write_image(path, np.where(mask, 255, 0).astype(np.uint8))
            self.drawn = (drawing, path, bool(mask.any()))
        return path if self.drawn[2] else None


def shown_objects(states: Sequence[PhotoState]) -> list[PhotoState]:
    """The objects of a photo that are listed.

    The first one is left out if nothing was ever marked for it and there are others.
    """
    if not states:
        return []
    first, *others = states
    shown = [state for state in others if state.is_shown]
    is_used = (
        not first.document.is_empty or first.document.name or first.owner.files.observation.exists()
    )
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
