"""What is marked of an object, as the observation that `cadalign fit` reads."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cadalign.annotate.document import AnnotationDocument, Pair
from cadalign.annotate.evidence import FurtherEvidence
from cadalign.annotate.files import written_unfinished, written_view
from cadalign.annotate.keypoints import KeypointRegistry
from cadalign.annotate.masks import draw_mask
from cadalign.annotate.object_shape import ObjectShape
from cadalign.annotate.objects import PhotoState
from cadalign.arrays import FloatArray
from cadalign.io.images import write_image
from cadalign.io.observation import Observation
from cadalign.io.observed_image import ObservedImage


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
        if to_write:
            fields["unfinished"] = self._unfinished(state)
        image = self._keypoints(state, to_write=to_write)
        return further.added_to(image, fit_options=options, **fields)

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
            elif tells_something(image := self.image(each, to_write=to_write)):
                others.append(image)
        kept = owner.further
        return replace(
            own, others=tuple(others), place=place, sigma=kept.sigma, symmetry=kept.symmetry
        )

    def image(self, state: PhotoState, *, to_write: bool = False) -> ObservedImage:
        """A photo with its pairs that count and what is known beside them."""
        own = self._own_evidence(state)
        return own.added_to_image(self._keypoints(state, to_write=to_write))

    def tells(self, state: PhotoState) -> bool:
        """True if anything of a photo counts."""
        return tells_something(self.image(state))

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
            semantic_ids=np.array(keypoints, dtype=np.int64),
            names=tuple(registry[keypoint].name for keypoint in keypoints),
            confidences=filled(pair.confidence for pair in pairs),
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
        """What an observation has no keypoints for: other pairs, and further photos without any."""
        views = []
        for view in state.all_views[1:]:
            pairs = self._other_pairs(view)
            if pairs or not self.tells(view):
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


def tells_something(image: ObservedImage) -> bool:
    """True if an image has keypoints or other evidence of the object."""
    return bool(len(image.points_2d) or image.evidence.given)


def _key_of(view: PhotoState | ObservedImage) -> str:
    if isinstance(view, PhotoState):
        return view.key
    return "" if view.image is None else str(view.image.resolve())
