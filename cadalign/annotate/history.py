"""Undo and redo over documents that never change."""

from __future__ import annotations

from cadalign.annotate.document import Document

_LONGEST = 1000


class History:
    """The documents that were, the one that is, and those that were undone.

    Parameters
    ----------
    document : Document
        The first one.

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
        """Whether there is anything to undo."""
        return bool(self._before)

    @property
    def can_redo(self) -> bool:
        """Whether there is anything to redo."""
        return bool(self._after)

    def record(self, document: Document, *, step: object = None) -> None:
        """Go on to another document.

        Parameters
        ----------
        document : Document
        step : object, optional
            Changes that follow each other with the same step are undone together, such as the
            places of a point that is dragged.
        """
        if step is None or step != self._step or not self._before:
            self._before.append(self.document)
            del self._before[:-_LONGEST]
        self._after.clear()
        self.document = document
        self._step = step

    def undo(self) -> bool:
        """Go back by one change; says whether there was one."""
        return self._go(self._before, self._after)

    def redo(self) -> bool:
        """Take back an undo; says whether there was one."""
        return self._go(self._after, self._before)

    def _go(self, source: list[Document], target: list[Document]) -> bool:
        self._step = None
        if not source:
            return False
        target.append(self.document)
        self.document = source.pop()
        return True
