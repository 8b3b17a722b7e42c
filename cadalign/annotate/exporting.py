"""Annotations in other tools' formats: COCO, data sets of photos, a photo's object as GLB."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Hashable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.annotate.models import OpenedModel
from cadalign.annotate.objects import PhotoState, shown_objects
from cadalign.annotate.session import Session
from cadalign.datasets.detections.coco import CocoObject, coco_document
from cadalign.datasets.photos.photo import Photo
from cadalign.errors import InputError
from cadalign.estimation.outputs import object_of
from cadalign.export import AlignedObject, export_object
from cadalign.export.aligned_object import names_of, photos_of, write_photo_set
from cadalign.io.files import write_text

_MARKED = 2  # COCO's flag of a keypoint that is labelled and visible


def coco_of(session: Session) -> dict[str, Any]:
    """All marked keypoints as COCO annotations, a category for each model.

    What was not marked has the flag and the coordinates 0. Photos that are skipped are left out.
    """
    with session.lock:
        photos = [shown_objects(states) for states in session.objects]
        kept = [objects for objects in photos if session.work_state(objects[0]) != "skipped"]
        marked: dict[OpenedModel, set[int]] = {}  # in any photo
        for state in session.states:
            pairs = state.document.complete_pairs
            found = {pair.keypoint for pair in pairs if pair.keypoint is not None}
            marked.setdefault(state.model, set()).update(found)
        models = [model for model in session.models.opened if marked.get(model)]
        models = models or [session.models[0]]
        numbers = [sorted(marked.get(model, ())) for model in models]
        annotations = []
        for row, objects in enumerate(kept):
            for state in objects:
                places = {pair.keypoint: pair.uv for pair in state.document.complete_pairs}
                if not places:
                    continue
                category = models.index(state.model)
                own = numbers[category]
                uv = np.array([places.get(number) or (0.0, 0.0) for number in own], dtype=float)
                flags = np.array([_MARKED if number in places else 0 for number in own])
                rectangle = np.concatenate([uv[flags > 0].min(axis=0), uv[flags > 0].max(axis=0)])
                annotations.append(CocoObject(row, category, uv, flags, rectangle))
        files = [objects[0].photo for objects in kept]
        names = names_of(photo.path for photo in files)  # of photos in several folders their paths
        return coco_document(
            [(names[photo.path], photo.width, photo.height) for photo in files],
            [
                (model.path.stem, [model.registry[number].name for number in own])
                for model, own in zip(models, numbers, strict=True)
            ],
            annotations,
        )


def glb_of(session: Session, number: int, *, slot: int | None = None) -> bytes:
    """The aligned, textured model before its photo; raises InputError without an alignment."""
    with session.lock:
        exported = _aligned_object(session.photo_state(number, slot))
    if exported is None:
        raise InputError("there is no alignment yet", where="export", fix="place more pairs")
    with tempfile.TemporaryDirectory() as folder:
        return export_object(Path(folder) / "object.glb", exported).read_bytes()


def annotated_photos(session: Session) -> list[Photo]:
    """The photos with an alignment that are not skipped, for data sets."""
    with session.lock:
        choice = session.choice
        found = []
        for state in (each for each in session.states if each.is_shown):
            exported = _aligned_object(state)
            if exported is None or session.work_state(state) == "skipped":
                continue
            key = None if choice is None else choice.key_of(state.model.path)
            image = state.image().evidence
            category = "object" if key is None else key[0]
            (photo,) = photos_of(_named(state, exported), category=category, mask=image.mask)
            path, up = state.photo.path, image.up
            up = None if up is None else np.asarray(up, dtype=float)
            found.append(replace(photo, name=path.name, image=path, up=up))
        return found


def zipped_photo_set(session: Session, form: str) -> bytes:
    """The photos as a data set of a form of `FORMS`, as a ZIP file.

    It has a file ``LEFT_OUT.txt`` where the form cannot hold some of them.
    """
    photos = annotated_photos(session)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "photos"
        problems = write_photo_set(root, photos, form)
        if problems:
            write_text(root / "LEFT_OUT.txt", "".join(f"{problem}\n" for problem in problems))
        archive = shutil.make_archive(str(Path(folder) / "set"), "zip", root)
        return Path(archive).read_bytes()


def _aligned_object(state: PhotoState) -> AlignedObject | None:
    """The model as it is aligned in a photo; None without an alignment."""
    live, _ = state.session.live(state)
    if live.result is None or live.wireframe is None:
        return None
    lines, cad = live.wireframe, state.model.cad
    mesh = lines.scene.mesh if state.session.shape.is_estimated else cad.scene.mesh
    images = [view.image for view in state.observation().views]
    result = replace(live.result, model=None)  # or the mesh, which is warped, would be once more
    return object_of(result, mesh=mesh, images=images, name=state.model.path.stem)


def _named(state: PhotoState, exported: AlignedObject) -> AlignedObject:
    live, _ = state.session.live(state)
    names: dict[Hashable, Hashable] = {number: point.name for number, point in state.model.registry}
    view = exported.views[live.place]
    view = replace(view, ids=tuple(names.get(each, each) for each in view.ids))
    ids = tuple(names.get(each, each) for each in exported.ids)
    return replace(exported, views=(view,), ids=ids)
