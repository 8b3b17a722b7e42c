"""Undo and redo over immutable documents."""

from __future__ import annotations

from cadalign.annotate.document import Document

_LONGEST = 1000


class History:
    """The current document, those before it, and those that were undone.

    Examples
    --------
    >>> history = History(Document())
    >>> placed, _ = history.document.place_uv((1.0, 2.0))
    >>> history.record(placed)
    >>> history.undo(), len(history.document.pairs)
    (True, 0)
    >>> history.redo(), len(history.document.pairs)
    (True, 1)
    """

    def __init__(self, document: Document) -> None:
        self.document = document
        self._before: list[Document] = []
        self._after: list[Document] = []
        self._step: object = None

    @property
    def can_undo(self) -> bool:
        """True if there is a change to undo."""
        return bool(self._before)

    @property
    def can_redo(self) -> bool:
        """True if there is a change to redo."""
        return bool(self._after)

    def record(self, document: Document, *, step: object = None) -> None:
        """Go on to another document.

        Consecutive changes with the same ``step`` are undone together, such as the positions of a
        point while it is dragged.
        """
        if step is None or step != self._step or not self._before:
            self._before.append(self.document)
            del self._before[:-_LONGEST]
        self._after.clear()
        self.document = document
        self._step = step

    def undo(self) -> bool:
        """Go back by one change; returns False if there is none."""
        return self._go(self._before, self._after)

    def redo(self) -> bool:
        """Redo the last undone change; returns False if there is none."""
        return self._go(self._after, self._before)

    def _go(self, source: list[Document], target: list[Document]) -> bool:
        self._step = None
        if not source:
            return False
        target.append(self.document)
        self.document = source.pop()
        return True
