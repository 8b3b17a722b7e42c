"""Ranking of candidates by a best-first search with bounds.

The lower bound of a candidate's errors (`kernels.bound_all`) gives an upper bound of its
log-likelihood. Candidates are searched in growing batches, in the order of their bounds, until the
bounds of all others lie 20 below the best log-likelihood found. So every match with a score above
1e-8 has the rank of an exhaustive search. If these do not fill the top list, up to 768 more
candidates are searched, so that in a library of that size the whole list is exact. A candidate's
search ends early once its pose is out of reach of a log-likelihood that would count.

Candidates are searched independently: the result does not depend on the order of the library or on
the number of threads.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np

from cadalign.arrays import FloatArray, IntArray, worker_count
from cadalign.errors import DegenerateError
from cadalign.estimation.fit import fit_batch
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import Box
from cadalign.geometry.pixels import perspective
from cadalign.retrieval.candidates import CandidateSet, Observed
from cadalign.retrieval.kernels import Candidates, Query, search_all
from cadalign.retrieval.match import Match
from cadalign.retrieval.models import ModelTable
from cadalign.retrieval.options import RetrievalOptions
from cadalign.solvers.constants import POSE_SIZE

_FIRST_BATCH = 64
_LARGEST_BATCH = 4096
_PIECE = 32  # candidates that a thread gets at a time
# Candidates this far below the best in log-likelihood are negligible: 50,000 of them together have
# 1e-4 of its probability.
_NEGLIGIBLE = 20.0
# Largest number of candidates that are searched to fill the rest of the top list.
_TO_FILL = 768
_FILL_BATCH = 256
_GUESS = 0.7  # errors are some 1.4 times their bound, or more
# 4-subsets for the minimal solver, refined starts, iterations. 1 to 3 % of all candidates miss
# their optimum, less than 1 % of the best 30 of a query.
_EFFORT = (5, 4, 20)
# With outliers, some of the subsets must be without any.
_ROBUST_EFFORT = (30, 10, 50)
# For the top list and as many behind it, searched again so that the result is the optimum.
_FINAL_EFFORT = (35, 12, 200)

Search = Callable[[IntArray, FloatArray], tuple[FloatArray, FloatArray]]
"""Function from candidates (m,) and the costs (m,) above which poses are of no interest, to their
packed poses (m, 15) and costs (m,)."""


@dataclass(frozen=True, eq=False)
class Ranking:
    """Searched candidates, one for each of m models, the best first."""

    candidates: IntArray  # (m,), rows of the candidate set
    poses: FloatArray  # (m, 15)
    log_likelihoods: FloatArray  # (m,)
    scores: FloatArray  # (m,), probabilities of the models
    searched: int  # number of candidates that were searched for a pose


def rank(
    candidates: CandidateSet, observed: Observed, options: RetrievalOptions, workers: int
) -> Ranking:
    """Rank the models of a candidate set."""
    threads = worker_count(workers)
    found = _SearchState(candidates)
    if options.method == "epnp":
        _search_in_order(found, options, partial(_search_unstretched, candidates, observed))
        return found.ranking()
    with ThreadPoolExecutor(threads) as pool:
        search = partial(_search_in_pieces, pool, observed.query, candidates.keypoints)
        effort = _EFFORT if options.loss == "linear" else _ROBUST_EFFORT
        _search_in_order(found, options, partial(search, effort))
        last = found.ranking().candidates[: 2 * options.top]
        found.search(last, partial(search, _FINAL_EFFORT), floor=-np.inf)
    return found.ranking()


def _search_in_pieces(
    pool: ThreadPoolExecutor,
    query: Query,
    keypoints: Candidates,
    effort: tuple[int, int, int],
    chosen: IntArray,
    ceilings: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Search the chosen candidates in the threads of a pool; see `Search`."""

    def search(start: int) -> tuple[FloatArray, FloatArray]:
        piece = slice(start, start + _PIECE)
        return search_all(query, keypoints, chosen[piece], ceilings[piece], *effort)

    parts = list(pool.map(search, range(0, len(chosen), _PIECE)))
    poses, costs = zip(*parts, strict=True)
    return np.concatenate(poses), np.concatenate(costs)


class _SearchState:
    """Best pose of every candidate searched so far."""

    def __init__(self, candidates: CandidateSet) -> None:
        self.limits = candidates.base - 0.5 * candidates.bounds
        self.guesses = candidates.base - _GUESS * candidates.bounds
        self.best = -np.inf
        self._candidates = candidates
        self._poses = np.empty((len(self.limits), POSE_SIZE))
        self._reached = np.full(len(self.limits), -np.inf)
        self._searched = np.zeros(len(self.limits), dtype=bool)

    def search(self, chosen: IntArray, search: Search, *, floor: float) -> None:
        """Search candidates for poses above a log-likelihood; a known better pose is kept."""
        if not len(chosen):
            return
        poses, costs = search(chosen, 2.0 * (self._candidates.base[chosen] - floor))
        reached = self._candidates.base[chosen] - 0.5 * costs
        better = reached > self._reached[chosen]
        self._poses[chosen[better]] = poses[better]
        self._reached[chosen[better]] = reached[better]
        self._searched[chosen] = True
        self.best = max(self.best, float(reached.max()))

    def last_of(self, top: int) -> float:
        """Log-likelihood of the last model of the top list; minus infinity if it is not full."""
        models = self._candidates.models[self._searched]
        best = np.full(int(self._candidates.models[-1]) + 1, -np.inf)
        np.maximum.at(best, models, self._reached[self._searched])
        best = best[np.isfinite(best)]
        return float(np.partition(best, -top)[-top]) if len(best) >= top else -np.inf

    def ranking(self) -> Ranking:
        """Rank the models, each with its best labels; ties in the library's order."""
        order = np.argsort(-self._reached, kind="stable")
        order = order[np.isfinite(self._reached[order])]
        if not len(order):
            raise DegenerateError(
                "no model can be aligned with the keypoints",
                where="points_2d",
                fix="check the keypoints, their semantic ids and the camera",
            )
        _, first = np.unique(self._candidates.models[order], return_index=True)
        order = order[np.sort(first)]
        reached = self._reached[order]
        weights = np.exp(reached - reached[0])
        searched = int(self._searched.sum())
        return Ranking(order, self._poses[order], reached, weights / weights.sum(), searched)


def _search_in_order(found: _SearchState, options: RetrievalOptions, search: Search) -> None:
    """Search the candidates in the order of their bounds; see the module."""
    order = np.argsort(-found.limits, kind="stable")
    done = 0
    size = _FIRST_BATCH
    while done < len(order):
        batch = order[done : done + size]
        if not options.exhaustive:
            batch = batch[found.limits[batch] >= found.best - _NEGLIGIBLE]
        if not len(batch):
            break
        wanted = min(found.best - _NEGLIGIBLE, found.last_of(options.top))
        found.search(batch, search, floor=-np.inf if options.exhaustive else wanted)
        done += len(batch)
        size = min(2 * size, _LARGEST_BATCH)
    rest = order[done:]
    rest = rest[np.argsort(-found.guesses[rest], kind="stable")]
    for start in range(0, min(_TO_FILL, len(rest)), _FILL_BATCH):
        batch = rest[start : start + _FILL_BATCH]
        last = found.last_of(options.top)
        found.search(batch[found.limits[batch] >= last], search, floor=last)


def _search_unstretched(
    candidates: CandidateSet, observed: Observed, chosen: IntArray, _ceilings: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Compute poses and costs by OpenCV's EPnP."""
    points, seen = [], []
    for candidate in chosen.tolist():
        on_model, in_image = shared_keypoints(candidates, observed, candidate)
        points.append(on_model)
        seen.append(in_image)
    batch = fit_batch(
        points, [observed.points_2d[rows] for rows in seen], observed.camera, method="epnp"
    )
    poses = np.zeros((len(chosen), POSE_SIZE))
    costs = np.full(len(chosen), np.inf)
    each = len(observed.query.whitening) > 1
    for m in np.flatnonzero(batch.solved).tolist():
        poses[m] = np.concatenate([batch.rotation[m].ravel(), batch.translation[m], batch.scale[m]])
        inside = points[m] @ batch.rotation[m].T + batch.translation[m]
        errors = perspective(inside) - observed.query.rays[seen[m]]
        a, b, c = observed.query.whitening[seen[m] if each else [0]].T
        across, down = errors.T
        costs[m] = ((a * across + b * down) ** 2 + (c * down) ** 2).sum()
    return poses, costs


def shared_keypoints(
    candidates: CandidateSet, observed: Observed, candidate: int
) -> tuple[FloatArray, IntArray]:
    """Select a candidate's keypoints in the image, (n, 3), and their rows there, (n,)."""
    keypoints = candidates.keypoints
    first, last, row = keypoints.spans[candidate].tolist()
    _, on_model, in_image = np.intersect1d(
        keypoints.ids[first:last], observed.query.ids, return_indices=True
    )
    return keypoints.xyz[keypoints.rows[row + on_model]], in_image


def make_matches(
    table: ModelTable, candidates: CandidateSet, observed: Observed, ranking: Ranking, top: int
) -> list[Match]:
    """Make matches of the first models of a ranking."""
    matches = []
    for place in range(min(top, len(ranking.candidates))):
        candidate = int(ranking.candidates[place])
        points_3d, rows = shared_keypoints(candidates, observed, candidate)
        model = table.model(int(candidates.models[candidate]))
        alignment = Alignment.from_packed(ranking.poses[place])
        residuals = observed.camera.project(alignment.apply(points_3d)) - observed.points_2d[rows]
        matches.append(
            Match(
                category=model.category,
                model_id=model.model_id,
                alignment=alignment,
                rms=float(np.sqrt((residuals**2).sum(axis=1).mean())),
                log_likelihood=float(ranking.log_likelihoods[place]),
                score=float(ranking.scores[place]),
                box=Box.from_model(model.bounds, alignment),
                bounds=model.bounds,
                ids=observed.query.ids[rows],
                points_3d=points_3d,
                points_2d=observed.points_2d[rows],
                residuals=residuals,
                missing_ids=tuple(np.delete(observed.query.ids, rows).tolist()),
                mirrored=bool(candidates.mirrored[candidate]),
                mesh_path=model.mesh_path,
                camera=observed.camera,
            )
        )
    return matches
