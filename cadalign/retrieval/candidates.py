"""Candidates of a query: models with their own or mirrored keypoint labels."""

from __future__ import annotations

from collections.abc import Collection
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import cast

import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, IntArray, as_floats, as_points, worker_count
from cadalign.datasets.models.categories import require_category
from cadalign.errors import DegenerateError, InputError
from cadalign.estimation.facing import require_perspective
from cadalign.estimation.options import LOSSES, Sigma
from cadalign.estimation.problems import rays_of, whitening_of
from cadalign.estimation.uncertainty.posterior import bent
from cadalign.geometry.camera import Camera
from cadalign.retrieval.kernels import LEAST_SHARED, Candidates, Query, bound_all
from cadalign.retrieval.models import ModelKey, ModelTable, check_semantic_ids
from cadalign.retrieval.options import RetrievalOptions

_PIECE = 1024  # candidates that a thread bounds at a time


@dataclass(frozen=True, eq=False)
class Observed:
    """An image's keypoints, in the order of their semantic ids."""

    order: IntArray  # (n,), their rows as they were given
    points_2d: FloatArray  # (n, 2) [px]
    covariances: FloatArray  # (n, 2, 2) [px^2]
    camera: Camera
    query: Query  # semantic ids and rays of the keypoints, for the kernels
    spurious: float  # log-likelihood of the keypoints if all of them are spurious


def observe(
    points_2d: npt.ArrayLike, ids: npt.ArrayLike, camera: Camera, options: RetrievalOptions
) -> Observed:
    """Check an image's keypoints and prepare them for the kernels."""
    if not isinstance(camera, Camera):
        raise InputError(f"expected a cadalign.Camera, got {type(camera).__name__}", where="camera")
    require_perspective(camera, "retrieval")
    pixels = as_points(points_2d, name="points_2d", dimension=2)
    ids = check_semantic_ids(ids, len(pixels), where="ids")
    order = np.argsort(ids)
    pixels, ids = pixels[order], ids[order]
    covariances = _covariances(options, pixels, order)
    rays = np.require(rays_of(pixels, camera), np.float64, ["C", "W"])
    fitting = options.fitting
    density = np.log1p(-options.missing_prob) - np.log(2 * np.pi)
    off = np.log(options.spurious / (camera.width * camera.height))
    query = Query(
        ids=ids,
        rays=rays,
        whitening=whitening_of(covariances, rays, camera),
        loss=LOSSES[fitting.loss],
        loss_scale=float(fitting.loss_scale),
        prior_weight=fitting.prior_weight,
        free=fitting.free,
        max_stretch=float(options.max_stretch),
        gains=density - 0.5 * np.log(np.linalg.det(covariances)) - off,
    )
    return Observed(order, pixels, covariances, camera, query, float(off) * len(ids))


def _covariances(options: RetrievalOptions, pixels: FloatArray, order: IntArray) -> FloatArray:
    """Sum of the covariances of noise and shape, (n, 2, 2) float [px^2], in the given order."""
    count = len(pixels)
    sigma = cast("Sigma", options.sigma)  # the options refuse None
    dimensions = np.ndim(sigma)
    if dimensions == 3:
        covariances = as_floats(sigma, name="sigma", shape=(count, 2, 2))[order]
    else:
        shape: tuple[int | None, ...] = () if dimensions == 0 else (count,)
        deviations = np.broadcast_to(as_floats(sigma, name="sigma", shape=shape), count)
        if not (deviations > 0).all():
            raise InputError("all values must be > 0", where="sigma")
        covariances = deviations[order][:, None, None] ** 2 * np.eye(2)
    extent = float(np.linalg.norm(np.ptp(pixels, axis=0))) if count else 0.0
    return np.asarray(covariances + (options.shape_sigma * extent) ** 2 * np.eye(2))


@dataclass(frozen=True, eq=False)
class CandidateSet:
    """The c candidates of a query that share enough keypoints with it."""

    keypoints: Candidates  # for the kernels
    models: IntArray  # (c,), rows of the models in the table
    mirrored: BoolArray  # (c,)
    base: FloatArray  # (c,), log-likelihood of a candidate that fits without error
    bounds: FloatArray  # (c,), lower bounds of the costs, twice the loss of log-likelihood


def gather_candidates(
    table: ModelTable,
    observed: Observed,
    options: RetrievalOptions,
    exclude: Collection[ModelKey],
    workers: int = -1,
) -> CandidateSet:
    """Gather the candidates of a query, without the models to ``exclude``."""
    threads = worker_count(workers)
    chosen = chosen_models(table, options.category, exclude)
    _check_known(table, observed.query.ids, chosen, options.category)
    models, candidates, labelings = _candidates(table, chosen, options.symmetries)
    bounds, gains, shared = _bound_in_pieces(observed.query, candidates, threads)
    kept = shared >= LEAST_SHARED
    if not kept.any():
        raise DegenerateError(
            f"no model shares more than {shared.max()} keypoints with the image",
            where="ids",
            fix=f"at least {LEAST_SHARED} are needed to align a model",
        )
    # The losses are concave in the squares and 0 at 0, so that of their sum is at most their sum.
    bounds = bent(bounds, options.loss, options.loss_scale)
    counts = candidates.spans[:, 1] - candidates.spans[:, 0]
    base = (
        gains
        + observed.spurious
        + (counts - shared) * np.log(options.missing_prob)
        + options.log_scale_constant
        - np.log(labelings)
    )
    spans = np.ascontiguousarray(candidates.spans[kept])
    return CandidateSet(
        candidates._replace(spans=spans),
        models[kept],
        spans[:, 0] != spans[:, 2],
        base[kept],
        bounds[kept],
    )


def _bound_in_pieces(
    query: Query, candidates: Candidates, threads: int
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Bound the candidates in threads; see `cadalign.retrieval.kernels.bound_all`."""

    def bound(start: int) -> tuple[FloatArray, FloatArray, IntArray]:
        spans = candidates.spans[start : start + _PIECE]
        return bound_all(query, candidates._replace(spans=spans))

    with ThreadPoolExecutor(threads) as pool:
        parts = list(pool.map(bound, range(0, len(candidates.spans), _PIECE)))
    bounds, gains, shared = zip(*parts, strict=True)
    return np.concatenate(bounds), np.concatenate(gains), np.concatenate(shared)


def chosen_models(
    table: ModelTable, category: str | None, exclude: Collection[ModelKey]
) -> IntArray:
    """Select the rows of the models to compare, in the table's order.

    Raises InputError if there are none, or the category is unknown.
    """
    if not len(table):
        raise InputError("the library is empty", where="library")
    rows = np.arange(len(table))
    if category is not None:
        rows = rows[table.rows_of(require_category(category, table.categories, where="category"))]
    if exclude:
        unwanted = set(exclude)
        rows = rows[[table.keys[row] not in unwanted for row in rows.tolist()]]
        if not len(rows):
            raise InputError("all models are excluded", where="exclude")
    return rows


def _check_known(table: ModelTable, ids: IntArray, chosen: IntArray, category: str | None) -> None:
    """Refuse a semantic id that no model has."""
    if category is None:
        known = table.known_ids
    else:
        own = slice(int(table.offsets[chosen[0]]), int(table.offsets[chosen[-1] + 1]))
        known = np.unique(table.ids[own])
    unknown = np.setdiff1d(ids, known)
    if len(unknown):
        where = "the library" if category is None else f"the category {category!r}"
        raise InputError(
            f"no model of {where} has a keypoint with the semantic id {unknown[0]}",
            where="ids",
            fix=f"known are {_ranges(known)}",
        )


def _candidates(
    table: ModelTable, chosen: IntArray, symmetries: bool
) -> tuple[IntArray, Candidates, IntArray]:
    """List the candidates: models (c,), keypoints, and numbers of labelings of each model (c,)."""
    first, last = table.offsets[chosen], table.offsets[chosen + 1]
    labelings = np.ones_like(chosen)
    if symmetries:
        starts, ends = table.labeling_offsets[chosen], table.labeling_offsets[chosen + 1]
        labelings += (ends - starts) // (last - first)
    models = np.repeat(chosen, labelings)
    number = np.arange(len(models)) - np.repeat(np.cumsum(labelings) - labelings, labelings)
    spans = np.repeat(np.stack([first, last, first], axis=1), labelings, axis=0)
    mirrored = table.labeling_offsets[models] + (number - 1) * (spans[:, 1] - spans[:, 0])
    spans[:, 2] = np.where(number > 0, len(table.xyz) + mirrored, spans[:, 0])
    candidates = Candidates(table.xyz, table.ids, table.places, spans)
    return models, candidates, np.repeat(labelings, labelings)


def _ranges(ids: IntArray) -> str:
    """Format ascending numbers as ranges: 0-2, 5."""
    runs = np.split(ids, np.flatnonzero(np.diff(ids) > 1) + 1)
    return ", ".join(
        str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs if len(run)
    )
