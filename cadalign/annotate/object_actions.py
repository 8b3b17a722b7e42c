"""Actions of the page on the objects of a photo, their models, and the photos of an object."""

from __future__ import annotations

from dataclasses import replace

from cadalign.annotate.action import Action, ActionOutcome
from cadalign.annotate.document import AnnotationDocument, Priors
from cadalign.annotate.estimate import LIKELY_STRETCH
from cadalign.annotate.evidence import MarkedEvidence
from cadalign.annotate.files import AnnotationFiles
from cadalign.annotate.history import History
from cadalign.annotate.models import OpenedModel
from cadalign.annotate.names import object_file, object_number
from cadalign.annotate.objects import PhotoState, label_of, shown_objects
from cadalign.annotate.ranking import switch_model
from cadalign.annotate.session import Session
from cadalign.errors import InputError, quote
from cadalign.io.documents import Index, Text

_LONGEST_NAME = 60


class AddObject(Action):
    """Add an object to the photo, with the model of a number; by default that of this object."""

    name: str = ""
    model: Index | None = None

    def apply(self, session: Session, state: PhotoState) -> ActionOutcome:
        photo, _ = session.place_of(state)
        name = _free_name(self.name, session.objects[photo], None)
        model = state.model if self.model is None else session.models[self.model]
        return ActionOutcome(shown=_add_object(session, photo, model, name))


class RenameObject(Action):
    """Rename the object; an empty name gives it its number again."""

    name: str

    def apply(self, session: Session, state: PhotoState) -> ActionOutcome:
        photo, _ = session.place_of(state)
        name = _free_name(self.name, session.objects[photo], state)
        state.record(replace(state.document, name=name))
        return ActionOutcome()


class DeleteObject(Action):
    """Delete the object with its files; it can be brought back while the program runs."""

    def apply(self, session: Session, state: PhotoState) -> ActionOutcome:
        label, owner = label_of(state), state.owner
        kept = owner.document
        empty = AnnotationDocument(
            focal=kept.focal, priors=kept.priors, name=kept.name, is_deleted=True
        )
        owner.record(empty)
        for view in (owner, *owner.views):
            view.drawn = None
        for each in (owner, *owner.views):
            session.deletions.add(session.place_of(each)[0], owner)
        return ActionOutcome(message=f"Deleted: {label}. Ctrl+Z brings it back.")


class RestoreObject(Action):
    """Bring back the object of the photo that was deleted last."""

    def apply(self, session: Session, state: PhotoState) -> ActionOutcome:
        deleted = session.deletions.last(session.place_of(state)[0])
        if deleted is None:
            raise InputError("no deleted object is left", where="restore", fix="add one")
        return bring_back(deleted)


class AddView(Action):
    """Add another photo as a further view of the object."""

    photo: Index

    def apply(self, session: Session, state: PhotoState) -> ActionOutcome:
        target = session.photo_state(self.photo)
        if any(view.key == target.key for view in state.all_views):
            raise InputError(
                f"{target.photo.path.name} is a photo of this object already",
                where="photo",
                fix="choose another one",
            )
        if state.owner.is_rigid:
            raise InputError(
                "the cameras of this object's photos are known, the new one's is not",
                where="photo",
                fix="write its camera pose into the observation",
            )
        return ActionOutcome(shown=_add_view(session, state.owner, self.photo))


class RemoveView(Action):
    """Take the photo from the object, with its pairs; undo brings it back."""

    def apply(self, session: Session, state: PhotoState) -> ActionOutcome:
        if state.lead is None:
            raise InputError(
                "the object's first photo cannot be taken from it",
                where="photo",
                fix="delete the object, or take its other photos from it",
            )
        state.remove_view()
        return ActionOutcome(
            shown=state.owner, message=f"{state.photo.path.name} is no longer used."
        )


class ChooseModel(Action):
    """Go on with another model of the library, in all photos of the object."""

    category: Text
    model: Text

    def apply(self, session: Session, state: PhotoState) -> ActionOutcome:
        before = sum(pair.keypoint is not None for pair in state.document.pairs)
        switch_model(session, state, (self.category, self.model))
        lost = before - sum(pair.keypoint is not None for pair in state.document.pairs)
        if not lost:
            return ActionOutcome()
        pairs = "1 pair has" if lost == 1 else f"{lost} pairs have"
        return ActionOutcome(message=f"{pairs} no keypoint on this model: click on it.")


OBJECT_ACTIONS: dict[str, type[Action]] = {
    "add_object": AddObject,
    "rename_object": RenameObject,
    "delete_object": DeleteObject,
    "restore_object": RestoreObject,
    "add_view": AddView,
    "remove_view": RemoveView,
    "model": ChooseModel,
}
"""Actions by the name that the page sends as ``do``."""


def bring_back(deleted: PhotoState) -> ActionOutcome:
    """Undo the deletion of an object."""
    deleted.history.undo()
    return ActionOutcome(shown=deleted, message=f"Brought back: {label_of(deleted)}.")


def _free_name(name: str, states: list[PhotoState], own: PhotoState | None) -> str:
    """The name without superfluous blanks; refuses one that is too long or another object's."""
    name = " ".join(name.split())
    if len(name) > _LONGEST_NAME:
        raise InputError(
            f"{quote(name[:_LONGEST_NAME])}... is too long",
            where="name",
            fix=f"give at most {_LONGEST_NAME} characters",
        )
    if any(label_of(each) == name for each in shown_objects(states) if each is not own):
        raise InputError(
            f"another object of this photo is called {quote(name)}",
            where="name",
            fix="choose another name",
        )
    return name


def _add_object(session: Session, photo: int, model: OpenedModel, name: str) -> PhotoState:
    """Add an object to the photo of a number; its camera is that of the photo's other objects."""
    states = session.objects[photo]
    like = states[0]
    if session.shape is not None and session.shape.learned is not None and model is not like.model:
        raise InputError(
            "the shape is that of one category, with one model",
            where="model",
            fix="start without --shape for objects of several models",
        )
    first = like.files.observation
    taken = {object_number(each.files.observation) for each in states if each.lead is None}
    number = next(
        number
        for number in range(2, len(states) + 3)
        if number not in taken and not object_file(first, number).exists()
    )
    stretch = LIKELY_STRETCH if session.shape is None else None
    priors = Priors(stretch, like.intrinsics.likely_focal)
    document = AnnotationDocument(focal=like.document.focal, priors=priors, name=name)
    files = AnnotationFiles(object_file(first, number), like.photo.path, model.path)
    added = PhotoState(like.photo, files, like.intrinsics, History(document), model)
    states.append(added)
    return added


def _add_view(session: Session, owner: PhotoState, photo: int) -> PhotoState:
    """Add the photo of a number to an object, or one that was taken from it again."""
    like = session.objects[photo][0]
    view = next((each for each in owner.views if each.key == like.key), None)
    if view is None:
        view = owner.add_view(like.photo, like.intrinsics)
        session.objects[photo].append(view)
    shared = owner.document
    view.record(
        AnnotationDocument(
            focal=like.document.focal,
            priors=Priors(shared.priors.stretch, like.intrinsics.likely_focal),
            evidence=MarkedEvidence(lengths=shared.evidence.lengths),
            name=shared.name,
        )
    )
    return view
