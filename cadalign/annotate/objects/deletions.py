"""Objects that were deleted while the program runs, so that they can be brought back."""

from __future__ import annotations

from cadalign.annotate.objects.state import PhotoState


class Deletions:
    """The deleted objects of each photo, by its number."""

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
