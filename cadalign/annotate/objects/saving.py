"""Writing the files of an object."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from cadalign.annotate.files import write_keypoints
from cadalign.annotate.objects.state import PhotoState

if TYPE_CHECKING:
    from cadalign.annotate.session import Session


def write_object(session: Session, state: PhotoState, *, with_fit: bool) -> None:
    """Write keypoints, observation and alignment of an object; raises DataError on failure.

    ``state`` is that in its first photo.
    """
    document, model = state.document, state.model
    live, _ = session.live(state)
    # An alignment by assumptions is shown but not written: `cadalign fit` would refuse it.
    result = None if live.provisional else live.shown
    used = frozenset[int]().union(
        *(other.document.keypoints for other in session.states if other.model is model)
    )
    # First the keypoints, which the observation names.
    write_keypoints(model.keypoints_path, model.registry, used, model.path)
    camera = state.intrinsics.to_write(document.focal)
    priors = document.priors.fit_options(state.intrinsics.prior)
    state.unfinished = state.files.write(
        document,
        model.registry,
        camera,
        {**priors, **live.fit_options},
        session.further(state, to_write=True),
        session.shape,
        _unfinished_views(session, state),
        unfinished=state.unfinished,
    )
    if with_fit:
        state.files.write_fit(result)


def _unfinished_views(session: Session, owner: PhotoState) -> list[dict[str, Any]]:
    """The object's further photos as far as the observation lacks them or their pairs."""
    unfinished = []
    for view in owner.all_views[1:]:
        camera = view.intrinsics.to_write(view.document.focal)
        written = view.files.unfinished_view(
            view.document, view.model.registry, camera, session.shape
        )
        if written["pairs"] or not session.tells(view):
            unfinished.append(written)
    return unfinished
