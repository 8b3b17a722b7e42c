"""Ranking: the most promising candidates are searched first, until no other can matter.

A candidate's log-likelihood is at most what a lower bound of its errors leaves of it
(`kernels.bound_all`). In the order of these limits candidates are searched in growing batches,
until the limits of all others lie 20 below the best log-likelihood found. So every match that has
a score of more than 1e-8 is where it would be if all candidates had been searched. If these are
fewer than the top list holds, up to 768 more candidates are searched to fill it, so that in a
library of that size the whole list is exact.

Each candidate is searched by itself, in the same way: nothing depends on the order of the library
or on how many threads share the work.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.errors import DegenerateError, InputError
from cadalign.fitting.fit import fit_batch
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import Box
from cadalign.retrieval.candidates import Field, Observed
from cadalign.retrieval.kernels import search_all
from cadalign.retrieval.match import Match
from cadalign.retrieval.models import ModelTable
from cadalign.retrieval.options import RetrievalOptions
from cadalign.solvers.constants import POSE_SIZE

_FIRST_BATCH = 64
_LARGEST_BATCH = 4096
_PIECE = 32  # candidates that a thread gets at a time
# Models this far below the best in log-likelihood don't count: 50,000 of them have 1e-4 of its
# probability.
_NEGLIGIBLE = 20.0
# How many candidates are searched at most to fill the rest of the top list.
_TO_FILL = 768
_FILL_BATCH = 256
_GUESS = 3.0  # errors are some 6 times their bound
# 4-subsets for the minimal solver, refined starts, iterations. 1 to 3 % of all candidates miss
# their optimum, less than 1 % of the best 30 of a query.
_EFFORT = (5, 4, 20)
# With outliers, subsets without any must be among them.
_ROBUST_EFFORT = (30, 10, 50)
# For the top list and as many behind it, once more, so that what is shown is the optimum.
_FINAL_EFFORT = (35, 12, 200)

Search = Callable[[IntArray], tuple[FloatArray, FloatArray]]
"""From candidates (m,) to their packed poses (m, 15) and costs (m,)."""


@dataclass(frozen=True, eq=False)
class Ranking:
    """The candidates that were searched, one for each model, the best first.

    Parameters
    ----------
    candidates : (m,) int
        Rows of the field.
    poses : (m, 15) float
    log_likelihoods : (m,) float
    scores : (m,) float
        Probabilities of the models.
    searched : int
        How many candidates were searched for a pose.
    """

    candidates: IntArray
    poses: FloatArray
    log_likelihoods: FloatArray
    scores: FloatArray
    searched: int


def rank(
    field: Field, observed: Observed, options: RetrievalOptions, *, workers: int = -1
) -> Ranking:
    """Rank the models of a field.

    Raises
    ------
    InputError
        If the number of workers is none.
    DegenerateError
        If no model can be aligned.
    """
    if workers == -1:
        workers = os.cpu_count() or 1
    if workers < 1:
        raise InputError(f"must be >= 1, or -1 for all cores, not {workers}", where="workers")
    found = _Found(field)
    if options.method == "epnp":
        _search_in_order(found, options, lambda some: _search_unstretched(field, observed, some))
        return found.ranking()
    with ThreadPoolExecutor(workers) as pool:

        def search(effort: tuple[int, int, int]) -> Search:
            def search_together(chosen: IntArray) -> tuple[FloatArray, FloatArray]:
                pieces = [chosen[k : k + _PIECE] for k in range(0, len(chosen), _PIECE)]
                parts = list(
                    pool.map(
                        lambda piece: search_all(observed.query, field.candidates, piece, *effort),
                        pieces,
                    )
                )
                return (
                    np.concatenate([poses for poses, _ in parts]),
                    np.concatenate([costs for _, costs in parts]),
                )

            return search_together

        is_robust = options.loss != "linear"
        _search_in_order(found, options, search(_ROBUST_EFFORT if is_robust else _EFFORT))
        found.search(found.ranking().candidates[: 2 * options.top], search(_FINAL_EFFORT))
    return found.ranking()


class _Found:
    """What the search has found so far.

    Parameters
    ----------
    field : Field
    """

    def __init__(self, field: Field) -> None:
        self.limits = field.base - 0.5 * field.bounds
        self.guesses = field.base - _GUESS * field.bounds
        self.best = -np.inf
        self._field = field
        self._poses = np.empty((len(self.limits), POSE_SIZE))
        self._reached = np.full(len(self.limits), -np.inf)
        self._searched = np.zeros(len(self.limits), dtype=bool)

    def search(self, chosen: IntArray, search: Search) -> None:
        """Search candidates; one that was searched before keeps what is better."""
        if not len(chosen):
            return
        poses, costs = search(chosen)
        reached = self._field.base[chosen] - 0.5 * costs
        better = reached > self._reached[chosen]
        self._poses[chosen[better]] = poses[better]
        self._reached[chosen[better]] = reached[better]
        self._searched[chosen] = True
        self.best = max(self.best, float(reached.max()))

    def last_of(self, top: int) -> float:
        """The log-likelihood of the last model of a top list; minus infinity if it is not full."""
        models = self._field.models[self._searched]
        best = np.full(int(self._field.models[-1]) + 1, -np.inf)
        np.maximum.at(best, models, self._reached[self._searched])
        best = best[np.isfinite(best)]
        return float(np.partition(best, -top)[-top]) if len(best) >= top else -np.inf

    def ranking(self) -> Ranking:
        """The models that were found, each with its best labels; ties in the library's order.

        Raises
        ------
        DegenerateError
            If there are none.
        """
        order = np.argsort(-self._reached, kind="stable")
        order = order[np.isfinite(self._reached[order])]
        if not len(order):
            raise DegenerateError(
                "no model can be aligned with the keypoints",
                where="points_2d",
                fix="check them, their ids, and the camera",
            )
        _, first = np.unique(self._field.models[order], return_index=True)
        order = order[np.sort(first)]
        reached = self._reached[order]
        weights = np.exp(reached - reached[0])
        searched = int(self._searched.sum())
        return Ranking(order, self._poses[order], reached, weights / weights.sum(), searched)


def _search_in_order(found: _Found, options: RetrievalOptions, search: Search) -> None:
    """Search the candidates that matter, or all; the module says which."""
    order = np.argsort(-found.limits, kind="stable")
    done = 0
    size = _FIRST_BATCH
    while done < len(order):
        batch = order[done : done + size]
        if not options.exhaustive:
            batch = batch[found.limits[batch] >= found.best - _NEGLIGIBLE]
        if not len(batch):
            break
        found.search(batch, search)
        done += len(batch)
        size = min(2 * size, _LARGEST_BATCH)
    rest = order[done:]
    rest = rest[np.argsort(-found.guesses[rest], kind="stable")]
    for start in range(0, min(_TO_FILL, len(rest)), _FILL_BATCH):
        batch = rest[start : start + _FILL_BATCH]
        found.search(batch[found.limits[batch] >= found.last_of(options.top)], search)


def _search_unstretched(
    field: Field, observed: Observed, chosen: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Poses and costs of OpenCV's EPnP."""
    points, seen = [], []
    for candidate in chosen.tolist():
        on_model, in_image = shared_keypoints(field, observed, candidate)
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
        errors = inside[:, :2] / inside[:, 2:] - observed.query.rays[seen[m]]
        a, b, c = observed.query.whitening[seen[m] if each else [0]].T
        across, down = errors.T
        costs[m] = ((a * across + b * down) ** 2 + (c * down) ** 2).sum()
    return poses, costs


def shared_keypoints(
    field: Field, observed: Observed, candidate: int
) -> tuple[FloatArray, IntArray]:
    """A candidate's keypoints that the image shows, (n, 3), and their rows in the image, (n,)."""
    candidates = field.candidates
    first, last, row = candidates.spans[candidate].tolist()
    _, on_model, in_image = np.intersect1d(
        candidates.ids[first:last], observed.semantic_ids, return_indices=True
    )
    return candidates.xyz[candidates.rows[row + on_model]], in_image


def make_matches(
    table: ModelTable, field: Field, observed: Observed, ranking: Ranking, *, top: int
) -> list[Match]:
    """The first of a ranking as matches."""
    matches = []
    for place in range(min(top, len(ranking.candidates))):
        candidate = int(ranking.candidates[place])
        points_3d, rows = shared_keypoints(field, observed, candidate)
        model = table.model(int(field.models[candidate]))
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
                semantic_ids=observed.semantic_ids[rows],
                points_3d=points_3d,
                points_2d=observed.points_2d[rows],
                residuals=residuals,
                missing_ids=tuple(np.delete(observed.semantic_ids, rows).tolist()),
                mirrored=bool(field.mirrored[candidate]),
                mesh_path=model.mesh_path,
            )
        )
    return matches
