"""Going on with another model of the library: pairs keep their keypoints by name."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

from cadalign.annotate.action import Action, ActionOutcome
from cadalign.annotate.document import AnnotationDocument, FurtherView, History, Pair
from cadalign.annotate.keypoint_registry import KeypointRegistry
from cadalign.annotate.objects.state import PhotoState
from cadalign.annotate.objects.view_history import ViewHistory
from cadalign.annotate.session import Session
from cadalign.errors import InputError
from cadalign.io.documents import Text
from cadalign.retrieval.models import ModelKey


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


def switch_model(session: Session, state: PhotoState, key: ModelKey) -> None:
    """Exchange an object's model, and the pairs' halves on it."""
    choice = session.choice
    if choice is None:
        raise InputError("the session has no library", where="model", fix="start with --library")
    mesh = choice.model(key).mesh_path
    assert mesh is not None
    session.before_saving()  # where nothing may be written, nothing is changed either
    owner = state.owner
    old, new = owner.model, session.models[session.models.number_of(mesh)]
    if new is old:
        return
    if session.ready:
        new.prepare(has_shape=session.shape is not None)
    carried = carry_keypoints(old.registry, new.registry, choice.ids_on(old.path))
    assert isinstance(owner.history, History)
    history = _carried_history(owner.history, carried)
    for each in (owner, *owner.views):
        each.model = new
        each.files = replace(each.files, model=new.path)
        each.history = history if each is owner else ViewHistory(history, each.key)
        each.live = each.joint = None
        each.proposals = tuple(
            replace(proposal, keypoint=carried[proposal.keypoint])
            for proposal in each.proposals
            if proposal.keypoint in carried
        )


def carry_keypoints(
    old: KeypointRegistry, new: KeypointRegistry, known: Collection[int]
) -> dict[int, int]:
    """Ids of the old model's keypoints on the new one: of the same semantic id, else name.

    Semantic ids tell of those that are ``known``. A keypoint that was renamed keeps its name.
    """
    carried = {number: number for number, _ in old if number in known and number in new}
    for number in carried:
        if old[number].name != new[number].name:
            new.rename(number, old[number].name)
    free = {point.name: number for number, point in new if number not in carried}
    return carried | {
        number: free[point.name]
        for number, point in old
        if number not in carried and point.name in free
    }


def _carried_history(history: History, carried: Mapping[int, int]) -> History:
    moved = History(
        _carried(history.document, carried),
        before=[_carried(document, carried) for document in history.before],
        after=[_carried(document, carried) for document in history.after],
    )
    moved.revision = history.revision + 1
    return moved


def _carried(document: AnnotationDocument, carried: Mapping[int, int]) -> AnnotationDocument:
    """The document with its pairs' keypoints on the new model; halves without any are left out."""
    moved: list[Pair] = []
    for pair in document.pairs:
        keypoint = None if pair.keypoint is None else carried.get(pair.keypoint)
        if keypoint is not None or pair.uv is not None:
            moved.append(replace(pair, keypoint=keypoint))
    views = tuple(
        FurtherView(view.photo, _carried(view.document, carried)) for view in document.further_views
    )
    return replace(document, pairs=tuple(moved), further_views=views)
