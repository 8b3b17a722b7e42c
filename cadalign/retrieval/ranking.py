"""Candidates of a query, and their ranking by a best-first search with bounds.

A candidate is a model that shares enough keypoints with the image. A lower bound of its errors
(`kernels.bound_all`) gives an upper bound of its log-likelihood. Candidates are searched for poses
in growing batches, in the order of their bounds, until all remaining bounds are 20 below the best
log-likelihood found. So every match with a score above 1e-8 has the rank of an exhaustive search.
If the top list is not full, up to 768 more candidates are searched, so the whole list is exact in
libraries of this size.

Candidates are searched independently: the result does not depend on the order of the library or on
the number of threads.
"""

from __future__ import annotations

from collections.abc import Collection
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, IntArray, as_floats, as_points, worker_count
from cadalign.datasets.image_keypoints import first_names
from cadalign.datasets.shapenet import require_category
from cadalign.errors import DegenerateError, InputError, require_kind
from cadalign.estimation.options import LOSSES
from cadalign.estimation.problems import rays_of, whitening_of
from cadalign.estimation.result import Result
from cadalign.estimation.result_parts import ViewResult
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera, face_pixels, rotate_alignment
from cadalign.retrieval.kernels import LEAST_SHARED, Candidates, Query, bound_all, search_all
from cadalign.retrieval.match import Match, posterior_by_shape, posterior_of_keypoints
from cadalign.retrieval.models import ModelKey, ModelTable, check_key, check_semantic_ids
from cadalign.retrieval.options import (
    MISSING_PROB,
    SPURIOUS,
    STRETCH_SIGMA,
    RetrievalOptions,
)
from cadalign.solvers.constants import CAUCHY, HUBER, POSE_SIZE

_BOUNDED_AT_ONCE = 1024  # candidates per thread task, for bounds
_SEARCHED_AT_ONCE = 32  # candidates per thread task, for searches
_FIRST_BATCH = 64
_LARGEST_BATCH = 4096
# Candidates this far below the best log-likelihood are negligible: 50,000 of them have 1e-4 of its
# probability.
_NEGLIGIBLE = 20.0
# Largest number of further candidates that are searched to fill the top list.
_TO_FILL = 768
_FILL_BATCH = 256
_GUESS = 0.7  # half of a usual ratio of cost to bound, 1.4
# 4-subsets for the minimal solver, refined starts, iterations. 1 to 3 % of all candidates miss
# their optimum, and less than 1 % of a query's best 30.
_EFFORT = (5, 4, 20)
# With outliers, more subsets are needed to have some without outliers.
_ROBUST_EFFORT = (30, 10, 50)
# The best candidates, twice as many as the top list, are searched again with this effort.
_FINAL_EFFORT = (35, 12, 200)


@dataclass(frozen=True, eq=False)
class ObservedKeypoints:
    """Keypoints of an image, in the order of their semantic ids."""

    order: IntArray  # (n,), their rows in the arguments
    points_2d: FloatArray  # (n, 2) [px]
    covariances: FloatArray  # (n, 2, 2) [px^2]
    camera: Camera
    facing: Camera  # the camera, rotated towards the keypoints if wide; the frame of poses and rays
    query: Query  # the keypoints for the kernels
    spurious: float  # log-likelihood of the keypoints if all are spurious


@dataclass(frozen=True, eq=False)
class CandidateSet:
    """The c candidates of a query that share enough keypoints with it."""

    keypoints: Candidates  # for the kernels
    models: IntArray  # (c,), rows of the models in the table
    base: FloatArray  # (c,), log-likelihoods without residuals
    bounds: FloatArray  # (c,), lower bounds of the costs; a cost is twice a loss of log-likelihood


@dataclass(frozen=True, eq=False)
class Ranking:
    """Searched candidates (m,), the best first."""

    candidates: IntArray  # (m,), rows of the candidate set
    poses: FloatArray  # (m, 15), in the frame of the facing camera
    log_likelihoods: FloatArray  # (m,)
    scores: FloatArray  # (m,), probabilities of the models
    shape: Result | None = None  # the estimated shape, if it ranks the models


def observe(
    points_2d: npt.ArrayLike, ids: npt.ArrayLike, camera: Camera, options: RetrievalOptions
) -> ObservedKeypoints:
    """Check the keypoints of an image and convert them for the kernels."""
    require_kind(camera, Camera, "camera")
    pixels = as_points(points_2d, name="points_2d", dimension=2)
    ids = check_semantic_ids(ids, len(pixels), where="ids")
    order = np.argsort(ids)
    pixels, ids = pixels[order], ids[order]
    covariances = _covariances(options, pixels, order)
    facing = face_pixels(camera, pixels)
    rays = np.require(rays_of(pixels, facing), np.float64, ["C", "W"])
    fitting = options.fitting
    density = np.log1p(-MISSING_PROB) - np.log(2 * np.pi)
    off = np.log(SPURIOUS / (camera.width * camera.height))
    query = Query(
        ids=ids,
        rays=rays,
        whitening=whitening_of(covariances, rays, facing),
        loss=LOSSES[fitting.loss],
        loss_scale=float(fitting.loss_scale),
        prior_weight=fitting.prior_weight,
        free=fitting.free,
        gains=density - 0.5 * np.log(np.linalg.det(covariances)) - off,
    )
    return ObservedKeypoints(
        order, pixels, covariances, camera, facing, query, float(off) * len(ids)
    )


def _covariances(options: RetrievalOptions, pixels: FloatArray, order: IntArray) -> FloatArray:
    """Covariances of noise and shape together, (n, 2, 2) float [px^2], in ``order``."""
    count = len(pixels)
    sigma: Any = options.sigma  # the options refuse None
    if np.ndim(sigma) == 3:
        covariances = as_floats(sigma, name="sigma", shape=(count, 2, 2))[order]
    else:
        shape: tuple[int | None, ...] = () if np.ndim(sigma) == 0 else (count,)
        deviations = np.broadcast_to(as_floats(sigma, name="sigma", shape=shape), count)
        if not (deviations > 0).all():
            raise InputError("all values must be > 0", where="sigma")
        covariances = deviations[order][:, None, None] ** 2 * np.eye(2)
    extent = float(np.linalg.norm(np.ptp(pixels, axis=0))) if count else 0.0
    return np.asarray(covariances + (options.shape_sigma * extent) ** 2 * np.eye(2))


def apply_loss(squares: FloatArray, loss: int, scale: float) -> FloatArray:
    """Apply a loss of `cadalign.solvers.constants` to squared whitened lengths of any shape."""
    if loss == HUBER:
        linear = 2 * scale * np.sqrt(squares) - scale**2
        return np.asarray(np.where(squares <= scale**2, squares, linear))
    if loss == CAUCHY:
        return np.asarray(scale**2 * np.log1p(squares / scale**2))
    return squares


def gather_candidates(
    table: ModelTable,
    observed: ObservedKeypoints,
    options: RetrievalOptions,
    exclude: Collection[ModelKey],
    workers: int = -1,
) -> CandidateSet:
    """Gather the candidates of a query, without models to ``exclude``."""
    threads, query, category = worker_count(workers), observed.query, options.category
    if not len(table):
        raise InputError("the library is empty", where="library")
    if category is not None:
        category = require_category(category, table.categories, where="category")
    chosen = np.arange(len(table))[slice(None) if category is None else table.rows_of(category)]
    if unwanted := {check_key(key, "exclude") for key in exclude}:
        chosen = chosen[[table.keys[row] not in unwanted for row in chosen.tolist()]]
        if not len(chosen):
            raise InputError("all models are excluded", where="exclude")
    known = table.known_ids(category)
    unknown = np.setdiff1d(query.ids, known)
    if len(unknown):
        where = "the library" if category is None else f"the category {category!r}"
        what = f"no model of {where} has a keypoint with the semantic id {unknown[0]}"
        raise InputError(
            what, where="ids", fix=f"it has {first_names([str(each) for each in known])}"
        )
    spans = np.stack([table.offsets[chosen], table.offsets[chosen + 1]], axis=1)
    candidates = Candidates(table.xyz, table.ids, spans)

    def bound(start: int) -> tuple[FloatArray, FloatArray, IntArray]:
        some = candidates._replace(spans=spans[start : start + _BOUNDED_AT_ONCE])
        return bound_all(query, some)

    with ThreadPoolExecutor(threads) as pool:
        parts = list(pool.map(bound, range(0, len(spans), _BOUNDED_AT_ONCE)))
    bounds, gains, shared = map(np.concatenate, zip(*parts, strict=True))
    kept = shared >= LEAST_SHARED
    if not kept.any():
        what = f"no model shares more than {shared.max()} keypoints with the image"
        fix = f"at least {LEAST_SHARED} are needed to align a model"
        raise DegenerateError(what, where="ids", fix=fix)
    # Losses are concave and 0 at 0: the loss of a sum is at most the sum of the losses.
    bounds = apply_loss(bounds, query.loss, query.loss_scale)
    counts = spans[:, 1] - spans[:, 0]
    base = gains + observed.spurious + (counts - shared) * np.log(MISSING_PROB)
    axes = len(options.fitting.stretched_axes)  # add the prior's log density at stretch 1
    base = base - axes * (0.5 * np.log(2 * np.pi) + np.log(STRETCH_SIGMA))
    kept_keypoints = candidates._replace(spans=spans[kept])
    return CandidateSet(kept_keypoints, chosen[kept], base[kept], bounds[kept])


def rank(
    candidates: CandidateSet, observed: ObservedKeypoints, options: RetrievalOptions, workers: int
) -> Ranking:
    """Search the candidates for poses and rank them."""
    effort = _EFFORT if options.loss == "linear" else _ROBUST_EFFORT
    with ThreadPoolExecutor(worker_count(workers)) as pool:
        found = _SearchState(candidates, observed, pool)
        found.search_in_order(effort, options.top)
        last = found.ranking().candidates[: 2 * options.top]
        found.search(last, _FINAL_EFFORT)
    return found.ranking()


class _SearchState:
    """Best pose of every searched candidate."""

    def __init__(
        self, candidates: CandidateSet, observed: ObservedKeypoints, pool: ThreadPoolExecutor
    ) -> None:
        self._candidates, self._query, self._pool = candidates, observed.query, pool
        self._best = -np.inf
        self._poses = np.empty((len(candidates.base), POSE_SIZE))
        self._reached = np.full(len(candidates.base), -np.inf)

    def search(self, chosen: IntArray, effort: tuple[int, int, int]) -> None:
        """Search candidates for poses, and keep better known poses."""
        if not len(chosen):
            return

        def piece(start: int) -> tuple[FloatArray, FloatArray]:
            own = slice(start, start + _SEARCHED_AT_ONCE)
            return search_all(self._query, self._candidates.keypoints, chosen[own], *effort)

        parts = list(self._pool.map(piece, range(0, len(chosen), _SEARCHED_AT_ONCE)))
        poses, costs = map(np.concatenate, zip(*parts, strict=True))
        reached = self._candidates.base[chosen] - 0.5 * costs
        better = reached > self._reached[chosen]
        self._poses[chosen[better]] = poses[better]
        self._reached[chosen[better]] = reached[better]
        self._best = max(self._best, float(reached.max()))

    def search_in_order(self, effort: tuple[int, int, int], top: int) -> None:
        """Search the candidates in the order of their bounds; see the module docstring."""
        base, bounds = self._candidates.base, self._candidates.bounds
        limits, guesses = base - 0.5 * bounds, base - _GUESS * bounds
        order = np.argsort(-limits, kind="stable")
        done, size = 0, _FIRST_BATCH
        while done < len(order):
            batch = order[done : done + size]
            batch = batch[limits[batch] >= self._best - _NEGLIGIBLE]
            if not len(batch):
                break
            self.search(batch, effort)
            done += len(batch)
            size = min(2 * size, _LARGEST_BATCH)
        rest = order[done:]
        rest = rest[np.argsort(-guesses[rest], kind="stable")]
        for start in range(0, min(_TO_FILL, len(rest)), _FILL_BATCH):
            batch = rest[start : start + _FILL_BATCH]
            self.search(batch[limits[batch] >= self._last_of(top)], effort)

    def _last_of(self, top: int) -> float:
        """Log-likelihood of the last model in the top list; minus infinity if it is not full."""
        best = self._reached[np.isfinite(self._reached)]
        return float(np.partition(best, -top)[-top]) if len(best) >= top else -np.inf

    def ranking(self) -> Ranking:
        """Rank the searched candidates; ties are in the library's order."""
        order = np.argsort(-self._reached, kind="stable")
        order = order[np.isfinite(self._reached[order])]
        if not len(order):
            fix = "check the keypoints, their semantic ids and the camera"
            what = "no model can be aligned with the keypoints"
            raise DegenerateError(what, where="points_2d", fix=fix)
        reached = self._reached[order]
        weights = np.exp(reached - reached[0])
        return Ranking(order, self._poses[order], reached, weights / weights.sum())


def shared_keypoints(
    candidates: CandidateSet, observed: ObservedKeypoints, candidate: int
) -> tuple[FloatArray, IntArray]:
    """Keypoints (n, 3) of a candidate that the image has, and their rows in the image (n,)."""
    keypoints = candidates.keypoints
    first, last = keypoints.spans[candidate].tolist()
    ids = keypoints.ids[first:last]
    # Three times as fast as np.intersect1d.
    on_model, in_image = np.nonzero(ids[:, None] == observed.query.ids)
    order = np.argsort(ids[on_model])
    on_model, in_image = on_model[order], in_image[order]
    return keypoints.xyz[first + on_model], in_image


def make_matches(
    table: ModelTable,
    candidates: CandidateSet,
    observed: ObservedKeypoints,
    ranking: Ranking,
    options: RetrievalOptions,
    none_probability: float | None,
) -> list[Match]:
    """Make the matches of the first ``top`` candidates of a ranking."""
    matches = []
    for place, candidate in enumerate(ranking.candidates[: options.top].tolist()):
        points_3d, rows = shared_keypoints(candidates, observed, candidate)
        model = table.model(int(candidates.models[candidate]))
        found = Alignment.from_vector(ranking.poses[place])
        alignment = rotate_alignment(found, observed.facing.lens_from_camera)
        pixels, camera = observed.points_2d[rows], observed.camera
        residuals = camera.project(alignment.apply(points_3d)) - pixels
        if ranking.shape is not None:
            posterior = posterior_by_shape(ranking.shape, alignment, options.fitting)
        else:
            fitting = replace(options.fitting, sigma=observed.covariances[rows])
            posterior = posterior_of_keypoints(points_3d, residuals, alignment, camera, fitting)
        ids, inliers = tuple(observed.query.ids[rows].tolist()), np.ones(len(rows), dtype=bool)
        view = ViewResult(camera, alignment, ids, pixels, residuals, inliers, posterior)
        match = Match(
            model.category,
            model.model_id,
            Result((view,), ids, points_3d, "retrieve", posterior, own_bounds=model.bounds),
            log_likelihood=float(ranking.log_likelihoods[place]),
            score=float(ranking.scores[place]),
            missing_ids=tuple(np.delete(observed.query.ids, rows).tolist()),
            mesh_path=model.mesh_path,
            none_probability=none_probability,
        )
        matches.append(match)
    return matches
