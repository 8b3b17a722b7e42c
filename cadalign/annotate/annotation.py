"""An annotation: the object in a photo, and its files."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cadalign.annotate.document import AnnotationDocument, History, Pair, Pixel
from cadalign.annotate.evidence import MarkedMask
from cadalign.annotate.files import AnnotationFiles, stored_sigma, written_half
from cadalign.annotate.live import LiveAlignment
from cadalign.annotate.models import OpenedModel
from cadalign.annotate.names import free_mask_file
from cadalign.annotate.photos import Intrinsics, PhotoFile
from cadalign.annotate.problem import LEAST_JOINT_PAIRS
from cadalign.annotate.suggestion import Suggestion
from cadalign.arrays import BoolArray, FloatArray
from cadalign.errors import InputError
from cadalign.estimation.result import Result
from cadalign.geometry.camera import Camera
from cadalign.io.images import write_image
from cadalign.io.observation import Observation

if TYPE_CHECKING:
    from cadalign.annotate.session import Session


@dataclass(eq=False)
class Annotation:
    """The object in a photo, its files, and the outcome of the last save."""

    session: Session = field(repr=False)
    photo: PhotoFile
    intrinsics: Intrinsics
    files: AnnotationFiles
    stored: Observation
    """Content of the file when it was opened, of which marks take the place."""
    history: History
    saved_at: float | None = None
    save_error: str = ""
    fit_pending: bool = False
    """True if the alignment's file is still to be written, since the solvers were not ready."""
    drawn: tuple[MarkedMask, Path] | None = None  # the mask that was written last, and its file
    live: tuple[AnnotationDocument, LiveAlignment, Suggestion | None] | None = field(
        default=None, repr=False
    )
    """The last alignment and suggestion, with their document."""
    by_mask: tuple[object, dict[Camera, Result]] | None = field(default=None, repr=False)
    """Estimates by the mask alone, with what they depend on."""

    @property
    def model(self) -> OpenedModel:
        """The model of the session."""
        return self.session.model

    @property
    def document(self) -> AnnotationDocument:
        """The current marks."""
        return self.history.document

    def record(self, document: AnnotationDocument, *, step: object = None) -> None:
        """Go on to other marks; see `History.record`."""
        self.history.record(document, step=step)

    def mark(self, **changes: Any) -> None:
        """Go on to other marks beside the pairs, which are fields of `MarkedEvidence`."""
        document = self.document
        self.record(replace(document, evidence=replace(document.evidence, **changes)))

    @property
    def name(self) -> str:
        """The photo's name."""
        return self.photo.path.name

    @property
    def number(self) -> int:
        """Its number in the session."""
        return self.session.photos.index(self)

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
    def begins(self) -> bool:
        """True if the search begins where the mask has led, for there are too few pairs."""
        is_given = self.document.evidence.start is not None
        return is_given and len(self.known_pairs) < LEAST_JOINT_PAIRS

    @property
    def estimates_by_mask(self) -> dict[Camera, Result]:
        """Estimates by the mask alone, kept until more than pairs changes."""
        document = self.document
        key = replace(document.evidence, start=None), document.priors
        if self.by_mask is None or self.by_mask[0] != key:
            self.by_mask = key, {}
        return self.by_mask[1]

    @property
    def mask(self) -> BoolArray:
        """The mask of the object, (h, w); empty without one."""
        mask, (width, height) = self.document.evidence.mask, (self.photo.width, self.photo.height)
        return np.zeros((height, width), bool) if mask is None else mask.pixels(width, height)

    def require_inside(self, uv: Pixel) -> None:
        """Refuse a place outside the photo."""
        if not self.intrinsics.camera.contains(np.array([uv]))[0]:
            what = f"({uv[0]:.1f}, {uv[1]:.1f}) is outside the photo"
            raise InputError(what, where="uv", fix="place it inside")

    def observation(
        self, *, fit_options: Mapping[str, Any] | None = None, to_write: bool = False
    ) -> Observation:
        """The observation, with the stored noise and the priors beside options.

        ``to_write`` leaves out a focal length that is not known, and adds what is unfinished.
        """
        shape, document = self.session.shape, self.document
        marks, likely = document.evidence, self.intrinsics.likely_focal
        sigma = stored_sigma(self.stored)
        options: dict[str, Any] = {} if sigma is None else {"sigma": sigma}
        options |= {**document.priors.fit_options(likely), **(fit_options or {})}
        if shape.sigma is not None:
            options["shape_sigma"] = shape.sigma
        if marks.photo:
            options["image"] = True
        pairs = self.known_pairs
        points = self.model.points_of(pairs)
        depths = [np.nan if pair.depth is None else pair.depth for pair in pairs]
        has_depths = bool(np.isfinite(depths).any())
        mask_sigma = None if marks.mask is None else marks.mask.sigma
        evidence = replace(self.stored.evidence, mask=self._mask_file(), mask_sigma=mask_sigma)
        if not has_depths and evidence.depth is None:  # all keypoints with depths may be gone
            evidence = replace(evidence, depth_sigma=None)
        return replace(
            self.stored,
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
            model=self.model.path,
            fit_options=options,
            shape=shape.path,
            init=marks.start.alignment if marks.start is not None and self.begins else None,
            unfinished=self._unfinished if to_write else None,
        )

    @property
    def _unfinished(self) -> dict[str, Any] | None:
        """Pairs that are no keypoints of the observation."""
        used = self.known_pairs
        halves = [written_half(pair) for pair in self.document.pairs if pair not in used]
        return {"pairs": halves} if halves else None

    def _mask_file(self) -> Path | None:
        """The file of the mask, if there is one; a drawn one is written if it is not yet."""
        mask, observation = self.document.evidence.mask, self.files.observation
        if mask is None or mask.file is not None:
            return None if mask is None else Path(mask.file or "")
        before = self.drawn
        if before is None or before[0] != mask or before[1].parent != observation.parent:
            is_own = before is not None and before[1].parent == observation.parent
            path = before[1] if before is not None and is_own else free_mask_file(observation)
            write_image(path, np.where(self.mask, 255, 0).astype(np.uint8))
            self.drawn = mask, path
        assert self.drawn is not None
        return self.drawn[1]


def filled(values: Iterable[float | None]) -> FloatArray | None:
    """The values (n,), 1 where one is missing; None if all are missing."""
    listed = list(values)
    if all(value is None for value in listed):
        return None
    return np.array([1.0 if value is None else value for value in listed])
