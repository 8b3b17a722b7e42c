"""Errors of poses that somebody else estimated, on a data set of photos."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from cadalign.datasets.photos.dataset import PhotoDataset
from cadalign.errors import CadalignError, InputError, quote
from cadalign.evaluation.metrics.sets import score_alignment
from cadalign.evaluation.outcome import LEFT_OUT, Outcome, reason_of
from cadalign.evaluation.photos.experiment import COLUMNS
from cadalign.evaluation.photos.protocols import Protocol, protocol_of
from cadalign.evaluation.photos.spec import summarize_cells
from cadalign.evaluation.photos.target import PhotoTarget
from cadalign.evaluation.runs.tables import Row
from cadalign.evaluation.summary import Summary
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import Box

Poses = Mapping[tuple[str, str], Alignment]
"""Alignments by the photo's name and the object's id."""


def score_poses(dataset: PhotoDataset, poses: Poses, *, method: str = "given") -> list[Row]:
    """Score given poses of the objects of a data set, by its own metrics.

    Parameters
    ----------
    dataset : PhotoDataset
        See `cadalign.datasets.open`.
    poses : mapping of (str, str) to Alignment
        By `Photo.name` and `PhotoObject.object_id`: pose and stretch of the data set's model in the
        frame and the unit of the photo's camera. Objects without one count as failed.
    method : str
        A name for the rows.

    Returns
    -------
    list of dict
        A row for each object with a true pose, with the columns of
        `cadalign.evaluation.photos.experiment`.

    Raises
    ------
    InputError
        If a pose is of a photo or an object that the data set lacks.

    Examples
    --------
    >>> import cadalign
    >>> dataset = cadalign.datasets.open("lmo")  # doctest: +SKIP
    >>> truth = {(photo.name, found.object_id): found.truth.cam_from_model
    ...          for photo in dataset for found in photo.objects}  # doctest: +SKIP
    >>> score_poses(dataset, truth)[0]["mssd"]  # doctest: +SKIP
    0.0
    """
    protocol, root = protocol_of(dataset.kind), str(dataset.root)
    left = set(poses)
    rows = []
    for target in _targets(dataset, root):
        key = target.photo.name, target.found.object_id
        left.discard(key)
        rows.append(_outcome(target, protocol, poses.get(key), method).row())
    if left:
        photo, found = sorted(left)[0]
        what = f"the data set has no object {quote(found)} with a pose in the photo {quote(photo)}"
        raise InputError(what, where="poses")
    return rows


def summarize_rows(rows: list[Row]) -> list[Summary]:
    """Summaries of rows by category and method; see `cadalign.evaluation.photos.spec`."""
    names = (*(name for name, _ in COLUMNS), "seconds")
    cells = {name: np.array([row.get(name) for row in rows], dtype=object) for name in names}
    return summarize_cells(cells, list(dict.fromkeys(row["method"] for row in rows)))


def _targets(dataset: PhotoDataset, root: str) -> Iterator[PhotoTarget]:
    for photo in dataset:
        for found in photo.objects:
            if found.truth.cam_from_model is not None or found.truth.box is not None:
                yield PhotoTarget(photo, found, root)


def _outcome(
    target: PhotoTarget, protocol: Protocol, est: Alignment | None, method: str
) -> Outcome:
    names, facts = {**target.names, "method": method}, {"source": ""}
    if est is None:
        return Outcome.failure("there is no estimate", names, **facts)
    try:
        bounds = target.bounds
        if bounds is None:
            return Outcome(names, facts, LEFT_OUT, "the size of the model is not known")
        scores = score_alignment(target, protocol.metrics, est, Box.from_model(bounds, est))
    except CadalignError as error:
        return Outcome.failure(reason_of(error), names, **facts)
    return Outcome(names, facts | scores)
