"""Opening of models, and of the objects of photos and their further photos."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cadalign.annotate.alignment import LIKELY_STRETCH
from cadalign.annotate.choosing.choice import ModelChoice
from cadalign.annotate.document import AnnotationDocument, FocalChoice, FurtherView, History, Priors
from cadalign.annotate.evidence import MarkedEvidence, MarkedLengths
from cadalign.annotate.files import (
    SAME_PLACE,
    AnnotationFiles,
    known_pairs,
    refuse_other_model,
)
from cadalign.annotate.further import FurtherEvidence
from cadalign.annotate.history_file import history_path, read_history
from cadalign.annotate.keypoint_registry import KeypointRegistry
from cadalign.annotate.model import ClickableModel
from cadalign.annotate.names import keypoints_file
from cadalign.annotate.object_shape import ObjectShape
from cadalign.annotate.objects.models import OpenedModel
from cadalign.annotate.objects.state import PhotoState
from cadalign.annotate.objects.unfinished import LeftOut, StoredView
from cadalign.annotate.objects.view_history import ViewHistory
from cadalign.annotate.photos import Intrinsics, PhotoFile, intrinsics_of
from cadalign.datasets.models.model_keypoints import ModelKeypoints
from cadalign.errors import CadalignError
from cadalign.geometry.camera import Camera
from cadalign.io.meshes.load import load_mesh

logger = logging.getLogger("cadalign")

_SAME_DIRECTION = 1e-6


@dataclass(frozen=True)
class ModelOpener:
    """Options that the models of a session are opened with.

    Parameters
    ----------
    folder : Path
        Where the keypoints are written.
    keypoints : Path, optional
        The first model's keypoints, where they are not beside it.
    shape : ObjectShape, optional
    choice : ModelChoice, optional
        A library, whose models' keypoints are given by it.
    """

    folder: Path
    keypoints: Path | None
    shape: ObjectShape | None
    choice: ModelChoice | None = None

    def open(self, path: Path, opened: Sequence[OpenedModel]) -> OpenedModel:
        """Read a model, its given keypoints, and those of earlier sessions."""
        cad = ClickableModel(load_mesh(path))
        own = self._keypoints_path(path, opened)
        beside = keypoints_file(path, path.parent)
        source = beside if opened or self.keypoints is None else self.keypoints
        mesh = cad.scene.mesh
        given = () if self.choice is None else self.choice.keypoints_of(path)
        if source != own and (source != beside or source.exists()):
            given = ModelKeypoints.load(source, mesh=mesh, model=path).keypoints
        reserved = frozenset(() if self.shape is None else self.shape.reserved)
        if self.choice is not None:
            reserved |= self.choice.semantic_ids
        registry = KeypointRegistry(given, reserved=reserved)
        if own.exists():
            earlier = ModelKeypoints.load(own, mesh=mesh, model=path)
            refuse_other_model(earlier.model, path, where=own)
            registry.merge(earlier.keypoints, tolerance=SAME_PLACE * cad.diagonal)
        return OpenedModel(path, cad, registry, own)

    def _keypoints_path(self, path: Path, opened: Sequence[OpenedModel]) -> Path:
        """The model's file of keypoints; with folders in its name where another model has it."""
        plain = keypoints_file(path, self.folder)
        if not opened and self.choice is None:
            return plain
        taken = {model.keypoints_path for model in opened}
        candidates = [
            keypoints_file(path, self.folder, parents=count)
            for count in range(len(path.resolve().parts) - 1)
        ]
        free = [each for each in candidates if each not in taken and not _is_others(each, path)]
        return free[0] if free else candidates[-1]


def _is_others(path: Path, model: Path) -> bool:
    """True for a keypoints file of another model."""
    if not path.exists():
        return False
    named = ModelKeypoints.load(path).model
    return named is not None and named.resolve() != model.resolve()


def open_object(
    files: AnnotationFiles,
    photo: PhotoFile,
    model: OpenedModel,
    *,
    camera: Camera | None,
    shape: ObjectShape | None,
    with_options: Callable[[FurtherEvidence], FurtherEvidence] = lambda further: further,
) -> PhotoState:
    """Open an object in its first photo, and in its further ones.

    ``with_options`` adds the evidence that options give.
    """
    registry, diagonal = model.registry, model.cad.diagonal
    stored = files.read(registry, diagonal, shape)
    own = stored.camera
    intrinsics, focal = _intrinsics(photo, own, camera)
    likely = Priors(LIKELY_STRETCH, intrinsics.likely_focal)
    priors = stored.priors_or(likely, exif=intrinsics.prior)
    if shape is not None:  # which has a prior of its own on the stretch
        priors = replace(priors, stretch=None)
    further = with_options(stored.further)
    evidence = MarkedEvidence.of(further)
    document = replace(stored.document, focal=focal, priors=priors, evidence=evidence)
    state = PhotoState(photo, files, intrinsics, History(document), model, further)
    for each in stored.views:
        document = _with_view(state, document, each)

    def is_same(drawn: MarkedEvidence, view: str | None) -> bool:
        found = next((each for each in state.views if each.key == view), state)
        return _is_same(drawn, found)

    history = read_history(
        history_path(files.observation),
        document,
        registry,
        tolerance=SAME_PLACE * diagonal,
        same_evidence=is_same,
    )
    state.history = history
    used = known_pairs(history.document, registry, shape)
    pairs = tuple(pair for pair in history.document.pairs if pair not in used)
    state.unfinished = LeftOut(pairs)
    for view in state.views:
        view.history = ViewHistory(history, view.key)
    return state


def new_view(owner: PhotoState, photo: PhotoFile, intrinsics: Intrinsics) -> PhotoState:
    """The state of an object in a further photo, which its history does not have yet."""
    assert isinstance(owner.history, History)
    view = PhotoState(
        photo,
        replace(owner.files, image=photo.path),
        intrinsics,
        owner.history,
        owner.model,
        lead=owner,
    )
    view.history = ViewHistory(owner.history, view.key)
    owner.views.append(view)
    return view


def _intrinsics(
    photo: PhotoFile, own: Camera | None, given: Camera | None
) -> tuple[Intrinsics, FocalChoice]:
    """The camera of a photo: that of its observation, or else the given one."""
    if own is not None and not own.focal_known:
        # The file leaves it to be estimated; the given camera's is kept for the user to choose.
        return intrinsics_of(photo, given or own), FocalChoice(known=False)
    intrinsics = intrinsics_of(photo, own or given)
    return intrinsics, FocalChoice(known=intrinsics.calibrated)


def _with_view(
    owner: PhotoState, document: AnnotationDocument, stored: StoredView
) -> AnnotationDocument:
    """The object's document with a further photo, of which the state is added to the owner's."""
    try:
        photo = PhotoFile.open(stored.image)
        intrinsics, focal = _intrinsics(photo, stored.camera, None)
    except CadalignError as error:
        logger.warning("%s: kept, but not opened: %s", owner.files.observation.name, error)
        return document
    view = new_view(owner, photo, intrinsics)
    view.further = FurtherEvidence(stored.evidence)
    own = replace(
        stored.document,
        focal=focal,
        priors=Priors(document.priors.stretch, intrinsics.likely_focal),
        evidence=replace(MarkedEvidence.of(view.further), lengths=document.evidence.lengths),
    )
    return replace(document, further_views=(*document.further_views, FurtherView(view.key, own)))


def _is_same(drawn: MarkedEvidence, state: PhotoState) -> bool:
    """True if what was drawn is what an observation file has."""
    further = state.further
    mask = None if drawn.mask is None else state.mask_file(drawn.mask.base)
    ours = drawn.added_to(further, state.camera, mask if further.image.mask is not None else None)
    if (ours.image.mask, ours.image.mask_sigma) != (further.image.mask, further.image.mask_sigma):
        return False
    if state.lead is None and MarkedLengths.of(ours.size) != MarkedLengths.of(further.size):
        return False
    one, other = ours.image.up, further.image.up
    if one is None or other is None:
        return one is other
    return bool(np.allclose(one, other, rtol=0, atol=_SAME_DIRECTION))
