"""The objects of a photo that are listed, and their names."""

from __future__ import annotations

from collections.abc import Sequence

from cadalign.annotate.names import object_number
from cadalign.annotate.objects.state import PhotoState


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
