"""Ranking of models by similarity to the shape estimated from the image.

For objects that are not in the library. Aligning the category's `ShapeModel` with the image's
keypoints gives the posterior of the object's shape, including its hidden parts. A model is scored
by the probability of its keypoints and box under this posterior, with wider covariances:

- Size and place are free, since one image does not determine them.
- Each coordinate has a deviation: ``shape_sigma`` times the extent of the mean shape or, if that is
  0, the distance of the library's models from their nearest models.

Each keypoint of the image that the model lacks multiplies the probability by `SPURIOUS`, and each
keypoint of the model that the image lacks by `MISSING_PROB`.

Missing keypoints of a model are replaced by their expectation in the category. All models are
ranked, except models that would reach behind the camera; there is no search for poses. Matches have
the pose of the estimated shape, and the stretch that brings the model's keypoints and box closest
to the estimated ones.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.datasets.shapenet import require_category
from cadalign.errors import DegenerateError, InputError, require_kind
from cadalign.estimation.align import align
from cadalign.estimation.estimates import linearise
from cadalign.estimation.options import FitOptions
from cadalign.estimation.pack import seen_keypoints
from cadalign.estimation.prior import prior_of
from cadalign.estimation.result import Result
from cadalign.estimation.view import View
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import face_pixels, rotate_alignment
from cadalign.retrieval.kernels import MOST_STRETCH
from cadalign.retrieval.models import ModelTable
from cadalign.retrieval.options import MISSING_PROB, SPURIOUS, RetrievalOptions
from cadalign.retrieval.ranking import CandidateSet, ObservedKeypoints, Ranking
from cadalign.shapes.gaussians import Gaussians, Vectors, log_likelihoods
from cadalign.shapes.model import ShapeModel
from cadalign.shapes.parts import BOX_ROWS
from cadalign.solvers.marginal.equations import POSE_UNKNOWNS
from cadalign.solvers.marginal.problem import Seen, coordinates_of

logger = logging.getLogger("cadalign")

_LEAST_KEYPOINTS = 3
_FREE_SIZE = 1.0  # standard deviation of the log size
_FREE_PLACE = 0.5  # standard deviation of the place, in extents of the shape
_NEGLIGIBLE = 1e-9  # largest weight of a Gaussian that is dropped
_FLOOR = 1e-4  # least standard deviation of a coordinate, in extents of the shape
_FLAT = 1e-9  # largest share of a model's variance along an axis without extent
_MOST_NEIGHBOURS = 2000  # largest number of models among which nearest models are searched


@dataclass(frozen=True, eq=False)
class _Shapes:
    """Models of a category, with its shape model's keypoints; means are weighted by `_weights`."""

    centred: FloatArray  # (n, m + 2, 3), completed keypoints and boxes, centred
    centres: FloatArray  # (n, 3)
    squares: FloatArray  # (n, 3), variances
    has: BoolArray  # (n, m), which keypoints the models have
    extent: float  # of the mean shape
    deviation: float  # distance between nearest models, per coordinate


def category_to_rank(shape: ShapeModel, options: RetrievalOptions, table: ModelTable) -> str:
    """Category to rank by a shape model: the options' category, or else the shape model's.

    Raises
    ------
    InputError
        If the category is not in the library, or the shape model has no semantic ids.
    """
    require_kind(shape, ShapeModel, "shape")
    if any(isinstance(label, str) for label in shape.ids):
        what, fix = "its keypoints have names", "learn it from models with semantic ids"
        raise InputError(what, where="shape", fix=fix)
    if options.category is not None:
        return require_category(options.category, table.categories, where="category")
    try:
        return require_category(shape.category, table.categories, where="shape")
    except InputError as error:
        raise InputError(
            error.what, where="shape", fix=f"{error.fix}; or give `category`"
        ) from None


def rank_by_shape(
    table: ModelTable,
    candidates: CandidateSet,
    observed: ObservedKeypoints,
    options: RetrievalOptions,
    shape: ShapeModel,
) -> Ranking:
    """Rank a candidate set of one category by the estimated shape.

    Raises
    ------
    InputError
        If the shape model has fewer than 3 of the image's keypoints.
    DegenerateError
        If the shape model cannot be aligned with the keypoints, or no model lies in front of the
        camera.
    """
    query, sigma = observed.query, np.asarray(options.sigma)
    has = np.isin(query.ids, shape.ids)
    if has.sum() < _LEAST_KEYPOINTS:
        what = f"the shape model has fewer than {_LEAST_KEYPOINTS} of the keypoints"
        raise InputError(what, where="ids", fix="check them, or rank without shape")
    view = View(
        observed.camera,
        observed.points_2d[has],
        ids=query.ids[has].tolist(),
        sigma=sigma[observed.order][has] if sigma.ndim else options.sigma,
    )
    loss: dict[str, Any] = {"loss": options.loss, "loss_scale": options.loss_scale}
    result = align(shape, view, **loss)
    for each in result.warnings:
        logger.warning("the estimated shape: %s", each.text)
    likely, log_evidence = shape_posterior(result, view, **loss)
    category, _ = table.keys[int(candidates.models[0])]
    known = _shapes_of(table, category, shape)
    models = candidates.models - table.rows_of(category).start
    turn = observed.facing.lens_from_camera.T
    logs, poses, kept = _rank_models(models, known, result, likely, options, turn)
    logs += log_evidence + float(query.gains[has].sum()) - np.logaddexp.reduce(logs)
    ranked, logs, poses = np.flatnonzero(kept), logs[kept], poses[kept]
    if not len(logs):
        fix = "check the keypoints, their semantic ids and the camera"
        what = "no model has all keypoints in front of the camera"
        raise DegenerateError(what, where="points_2d", fix=fix)
    order = np.argsort(-logs, kind="stable")
    weights = np.exp(logs[order] - logs.max())
    scores = weights / weights.sum()
    return Ranking(ranked[order], poses[order], logs[order], scores, result)


def _rank_models(
    models: IntArray,
    known: _Shapes,
    result: Result,
    likely: Gaussians,
    options: RetrievalOptions,
    turn: FloatArray,
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Log probabilities (c,) and poses (c, 15) of models; which are in front of the camera, (c,).

    ``turn`` (3, 3) rotates the camera frame to the frame of the poses.
    """
    estimate = np.concatenate([result.points_3d, result.bounds])
    weights = _weights(len(estimate))
    aim = weights @ estimate
    centred, squares = known.centred[models], known.squares[models]
    products = np.einsum("nka,ka->na", centred, weights[:, None] * (estimate - aim))
    placed = centred * _scales(squares, products, "")[:, None] + aim
    deviation = known.deviation
    if options.shape_sigma > 0:
        deviation = options.shape_sigma * known.extent
    vectors = Vectors(placed.reshape(len(models), -1), np.ones(len(models)))
    logs = log_likelihoods(vectors, _widen(likely, estimate, deviation))
    seen = np.array([label in result.views[0].ids for label in result.ids])
    has = known.has[models]
    logs = logs + (~has[:, seen]).sum(axis=1) * np.log(SPURIOUS)
    logs += has[:, ~seen].sum(axis=1) * np.log(MISSING_PROB)
    logs += has[:, seen].sum(axis=1) * np.log1p(-MISSING_PROB)
    axes, centres = options.fitting.stretched_axes, known.centres[models]
    scales = _scales(squares, products, axes)
    pose = rotate_alignment(result.alignment, turn)
    poses = _poses(pose, scales, aim - scales * centres, axes)
    across = poses[:, 6:9] * poses[:, 12:]  # the last row of the linear part
    depths = np.einsum("nka,na->nk", centred[:, :-BOX_ROWS], across).min(axis=1)
    ahead = np.asarray(depths + (centres * across).sum(axis=1) + poses[:, 11] > 0)
    return logs, poses, ahead


def _widen(shapes: Gaussians, estimate: FloatArray, deviation: float) -> Gaussians:
    """Distribution of similar models' shapes, given the distribution of the object's shape."""
    centred = estimate - estimate.mean(axis=0)
    extent = float(np.linalg.norm(np.ptp(estimate, axis=0)))
    size = _FREE_SIZE * centred.ravel()
    place = _FREE_PLACE * extent * np.tile(np.eye(3), len(estimate))
    widening = np.outer(size, size) + place.T @ place + deviation**2 * np.eye(len(size))
    kept = shapes.weights > _NEGLIGIBLE
    return Gaussians(shapes.weights[kept], shapes.means[kept], shapes.covariances[kept] + widening)


def _weights(count: int) -> FloatArray:
    """Weights (count,): the keypoints have half of the total, the box the other half."""
    weights = np.full(count, 1 / (2 * (count - BOX_ROWS)))
    weights[-BOX_ROWS:] = 1 / (2 * BOX_ROWS)
    return weights


def _scales(squares: FloatArray, products: FloatArray, free: str) -> FloatArray:
    """Scales (n, 3) that bring models closest to a shape, from their moments (n, 3).

    Each ``free`` axis has its own scale, and the others share one.
    """
    total = np.maximum(squares.sum(axis=1), np.finfo(float).tiny)
    common = np.maximum(products.sum(axis=1) / total, np.finfo(float).eps)
    scales = np.empty_like(squares)
    held = [axis for axis, name in enumerate("xyz") if name not in free]
    for axes in (held, *([axis] for axis in range(3) if axis not in held)):
        square, product = squares[:, axes].sum(axis=1), products[:, axes].sum(axis=1)
        # A flat or mirrored model does not determine the scale along this axis.
        known = (square > _FLAT * total) & (product > 0)
        found = np.where(known, product / np.where(known, square, 1.0), common)
        scales[:, axes] = found[:, None]
    return scales


def _poses(pose: Alignment, scales: FloatArray, shifts: FloatArray, free: str) -> FloatArray:
    """Packed poses (n, 15) of scaled and shifted models; axes not free have the scale 1."""
    held = next(axis for axis, name in enumerate("xyz") if name not in free)
    size = scales[:, [held]]
    stretch = np.clip(scales / size, 1 / MOST_STRETCH, MOST_STRETCH)
    # The image stays the same if everything is scaled about the camera centre.
    translation = (pose.translation + (shifts * pose.scale) @ pose.rotation.T) / size
    turned = np.broadcast_to(pose.rotation.ravel(), (len(stretch), 9))
    return np.concatenate([turned, translation, stretch * pose.scale], axis=1)


@lru_cache(maxsize=32)
def _shapes_of(table: ModelTable, category: str, shape: ShapeModel) -> _Shapes:
    ids, points = table.keypoints_of(category)
    _, rows, own = np.intersect1d(shape.ids, ids, return_indices=True)
    stacked = np.full((len(points), len(shape.ids) + BOX_ROWS, 3), np.nan)
    stacked[:, rows] = points[:, own]
    stacked[:, -BOX_ROWS:] = table.bounds[table.rows_of(category)]
    has = ~np.isnan(stacked[:, :-BOX_ROWS, 0])
    extent = float(np.linalg.norm(np.ptp(shape.mean, axis=0)))
    prior = gaussians_of(shape).widen(_FLOOR * extent)
    flat = _complete(stacked.reshape(len(stacked), -1), prior)
    weights, full = _weights(stacked.shape[1]), flat.reshape(stacked.shape)
    centres = weights @ full
    centred = full - centres[:, None]
    squares = weights @ centred**2
    return _Shapes(centred, centres, squares, has, extent, _deviation(flat, prior))


def _complete(values: FloatArray, prior: Gaussians) -> FloatArray:
    """Replace missing entries of vectors (n, d) by their expectation under a mixture."""
    vectors = Vectors(values, np.ones(len(values)))
    every = zip(prior.weights, prior.means, prior.covariances, strict=True)
    parts = [Gaussians(*(np.array([value]) for value in each)) for each in every]
    logs = np.array([log_likelihoods(vectors, part) for part in parts])
    shares = np.exp(logs - np.logaddexp.reduce(logs, axis=0))
    pairs = zip(shares, parts, strict=True)
    return np.asarray(sum(share[:, None] * vectors.complete(part) for share, part in pairs))


def _deviation(values: FloatArray, prior: Gaussians) -> float:
    """Median deviation per coordinate of vectors (n, d) from their nearest vectors.

    With a single vector, it is the prior's deviation.
    """
    values = values[:: -(-len(values) // _MOST_NEIGHBOURS)]
    floor = float(np.sqrt(prior.covariances.diagonal(axis1=1, axis2=2).min()))
    if len(values) < 2:
        variances = prior.weights @ prior.covariances.diagonal(axis1=1, axis2=2)
        return float(np.sqrt(variances.mean()))
    centred = values - values.mean(axis=0)
    norms = (centred**2).sum(axis=1)
    squares = norms[:, None] + norms - 2 * centred @ centred.T
    np.fill_diagonal(squares, np.inf)
    nearest = np.maximum(squares.min(axis=1), 0.0)
    return max(float(np.sqrt(np.median(nearest) / values.shape[1])), floor)


def shape_posterior(
    result: Result, view: View, *, loss: str = "linear", loss_scale: float = 2.0
) -> tuple[Gaussians, float]:
    """Posterior of the shape and log evidence, from an alignment with the inliers of one view.

    The posterior is a mixture over x, y, z of each keypoint, then of the box's corners. The log
    evidence has an unknown constant. Depths and directions are not used; the ``loss`` weights
    keypoints by their residuals.

    The reprojection errors are linearised in shape and pose at the estimate. Whitened and projected
    to the complement of all changes of the pose, they are ``A x = b + noise`` of unit covariance,
    with the stacked rows x of the shape. Each Gaussian of the category is conditioned on this in
    closed form; its weight is multiplied by its probability of b.
    """
    assert isinstance(result.model, ShapeModel)
    camera, rows_of = face_pixels(view.camera, view.pixels), prior_of(result.model).rows_of
    options = FitOptions(loss=loss, loss_scale=loss_scale)
    names = rows_of(view.keypoint_ids, "view.ids")
    seen = seen_keypoints(replace(view, camera=camera), view.pixels, names, options)
    kept = result.inliers
    seen = Seen(seen.points[kept], seen.rays[kept], seen.whitening[kept], *seen[3:])
    pose = rotate_alignment(result.alignment, camera.lens_from_camera.T)
    estimate, columns = np.concatenate([result.points_3d, result.bounds]), coordinates_of(seen)
    errors, rows, by_pose = linearise(estimate[seen.points], pose, seen)
    full, triangle = np.linalg.qr(by_pose, mode="complete")
    rest = full[:, POSE_UNKNOWNS:].T
    rows, right = rest @ rows, rest @ (rows @ estimate[seen.points].ravel() - errors)
    logs, means, covariances = [], [], []
    for weight, mean, covariance in zip(*gaussians_of(result.model), strict=True):
        across = rows @ covariance[columns]
        spread = across[:, columns] @ rows.T + np.eye(len(right))
        gap = right - rows @ mean[columns]
        gain = np.linalg.solve(spread, across).T
        square = float(gap @ np.linalg.solve(spread, gap))
        logs.append(np.log(weight) - 0.5 * (square + np.linalg.slogdet(spread)[1]))
        means.append(mean + gain @ gap)
        covariances.append(covariance - gain @ across)
    total = float(np.logaddexp.reduce(logs))
    shapes = Gaussians(np.exp(np.array(logs) - total), np.array(means), np.array(covariances))
    # The estimate's objective includes a log determinant that depends on the keypoints. Its
    # gradient there shifts the means. The box is no part of it, as it may have been enlarged.
    keypoints = result.points_3d.size
    gap = (estimate.ravel() - shapes.means[result.component])[:keypoints]
    own = shapes.covariances[result.component][:keypoints, :keypoints]
    slope = np.linalg.pinv(own, hermitian=True) @ gap
    shifts = shapes.covariances[:, :, :keypoints] @ slope
    moved = Gaussians(shapes.weights, shapes.means + shifts, shapes.covariances)
    pose_volume = float(np.log(np.abs(triangle.diagonal())).sum())
    return moved, total - pose_volume


def gaussians_of(model: ShapeModel) -> Gaussians:
    weights, means, covariances = model.gaussians
    return Gaussians(weights, means.reshape(len(means), -1), covariances)
