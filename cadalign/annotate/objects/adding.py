"""New objects in a photo, and further photos of an object."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cadalign.annotate.alignment import LIKELY_STRETCH
from cadalign.annotate.document import Document, History, Priors
from cadalign.annotate.evidence import Evidence
from cadalign.annotate.files import AnnotationFiles
from cadalign.annotate.names import object_file, object_number
from cadalign.annotate.objects.models import AnnotatedModel
from cadalign.annotate.objects.opening import new_view
from cadalign.annotate.objects.state import PhotoState
from cadalign.errors import InputError

if TYPE_CHECKING:
    from cadalign.annotate.session import Session


def add_object(session: Session, photo: int, model: AnnotatedModel, name: str) -> PhotoState:
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
    priors = Priors(focal=like.intrinsics.prior)
    if session.shape is None:
        priors = Priors(LIKELY_STRETCH, like.intrinsics.likely_focal)
    document = Document(focal=like.document.focal, priors=priors, name=name)
    files = AnnotationFiles(object_file(first, number), like.photo.path, model.path)
    added = PhotoState(like.photo, files, like.intrinsics, History(document), model)
    states.append(added)
    return added


def add_view(session: Session, owner: PhotoState, photo: int) -> PhotoState:
    """Add the photo of a number to an object, or one that was taken from it again."""
    like = session.objects[photo][0]
    view = next((each for each in owner.views if each.key == like.key), None)
    if view is None:
        view = new_view(owner, like.photo, like.intrinsics)
        session.objects[photo].append(view)
    shared = owner.document
    view.history.record(
        Document(
            focal=like.document.focal,
            priors=Priors(shared.priors.stretch, like.intrinsics.likely_focal),
            evidence=Evidence(lengths=shared.evidence.lengths),
            name=shared.name,
        )
    )
    return view
