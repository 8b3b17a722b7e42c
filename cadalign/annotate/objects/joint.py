"""The photos of one object as the views of its observation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from cadalign.annotate.further import FurtherEvidence
from cadalign.annotate.objects.state import PhotoState
from cadalign.io.observed_image import ObservedImage


def views_in_order(owner: PhotoState) -> list[PhotoState | ObservedImage]:
    """The views of an object in the order of its observation, those added last at the end.

    An image of the observation file that cannot be annotated stays as the file has it.
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


def with_other_views(
    state: PhotoState,
    evidence: FurtherEvidence,
    observed: Callable[[PhotoState], ObservedImage],
) -> FurtherEvidence:
    """A photo's evidence with the object's other photos, as ``observed``, beside it.

    Photos without anything that counts are left out.
    """
    others: list[ObservedImage] = []
    place = 0
    for each in views_in_order(state.owner):
        if each is state:
            place = len(others)
            continue
        image = observed(each) if isinstance(each, PhotoState) else each
        if not isinstance(each, PhotoState) or tells_something(image):
            others.append(image)
    owner = state.owner.further
    return replace(
        evidence, others=tuple(others), place=place, sigma=owner.sigma, symmetry=owner.symmetry
    )


def tells_something(image: ObservedImage) -> bool:
    """True if an image has keypoints or other evidence of the object."""
    return bool(len(image.points_2d) or image.evidence.given)


def _key_of(view: PhotoState | ObservedImage) -> str:
    if isinstance(view, PhotoState):
        return view.key
    return "" if view.image is None else str(view.image.resolve())
