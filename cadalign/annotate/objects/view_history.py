"""History of an object as one of its further photos sees it."""

from __future__ import annotations

from cadalign.annotate.document import AnnotationDocument, History


class ViewHistory:
    """The object's history, of which the documents are those of one further photo.

    Parameters
    ----------
    whole : History
        Of the object.
    photo : str
        The photo, as `FurtherView` names it.
    """

    def __init__(self, whole: History, photo: str) -> None:
        self._whole = whole
        self._photo = photo

    @property
    def object_document(self) -> AnnotationDocument:
        """The document of the object."""
        return self._whole.document

    @property
    def document(self) -> AnnotationDocument:
        """The photo's document; an empty one while it shows no view of the object."""
        return self._whole.document.view(self._photo) or AnnotationDocument()

    @property
    def revision(self) -> int:
        """Number that grows with every change of the object."""
        return self._whole.revision

    @property
    def can_undo(self) -> bool:
        """True if there is a change of the object to undo."""
        return self._whole.can_undo

    @property
    def can_redo(self) -> bool:
        """True if there is a change of the object to redo."""
        return self._whole.can_redo

    def record(self, document: AnnotationDocument, *, step: object = None) -> None:
        """Go on to another document of the photo; see `History.record`."""
        changed = self._whole.document.with_view(self._photo, document)
        self._whole.record(changed, step=None if step is None else (self._photo, step))

    def remove(self) -> None:
        """Go on to a document of the object without the photo."""
        self._whole.record(self._whole.document.without_view(self._photo))

    def undo(self) -> bool:
        """Undo the object's last change; returns False if there is none."""
        return self._whole.undo()

    def redo(self) -> bool:
        """Redo the object's last undone change; returns False if there is none."""
        return self._whole.redo()
