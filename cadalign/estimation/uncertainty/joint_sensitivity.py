"""Sensitivity of every estimate: of fits in closed form, of all other evidence by differences."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import cast

import numpy as np

from cadalign.arrays import FloatArray, IntArray
from cadalign.errors import InputError
from cadalign.estimation.estimates import placed_box, poses_of
from cadalign.estimation.facing import faced, turned_alignment
from cadalign.estimation.joint_robust import with_sightings
from cadalign.estimation.model import Model
from cadalign.estimation.options import LOSSES, FitOptions
from cadalign.estimation.pack import evidence_of
from cadalign.estimation.prior import Lenses, prior_of, rows_among, widened
from cadalign.estimation.result_data import ResultData
from cadalign.estimation.symmetry import equal_slopes
from cadalign.estimation.uncertainty.differences import JointOptimum
from cadalign.estimation.uncertainty.evidence import AnyBasis, Basis
from cadalign.estimation.uncertainty.sensitivity import Sensitivity, sensitivity_of_keypoints
from cadalign.estimation.uncertainty.stated import KeypointStatistics
from cadalign.estimation.view import View
from cadalign.shapes.model import ShapeModel
from cadalign.solvers.joint.evidence import State, points_of
from cadalign.solvers.joint.search import has_latent

_NEAR = 1e-9  # of coordinates that are the same but for rounding


def sensitivity_of(result: ResultData, *, exact: bool, view: int) -> Sensitivity:
    """The sensitivity of a result; see `cadalign.Result.sensitivity`."""
    if not 0 <= view < len(result.views):
        what = f"{view} is none of the result's {len(result.views)} views"
        raise InputError(what, where="view", fix=f"give 0 to {len(result.views) - 1}")
    statistics = result.statistics
    if isinstance(statistics, KeypointStatistics) and not result.camera.is_wide:
        if statistics.fisher_covariance is None:
            what = f"the method {result.method} minimises no cost, and has no derivatives"
            raise InputError(what, where="sensitivity", fix='fit with method="optimal"')
        return sensitivity_of_keypoints(result, statistics, exact=exact)
    if not exact:
        what = "only keypoints of one view of an exact model have a Gauss-Newton sensitivity"
        raise InputError(what, where="exact", fix="leave it at True")
    if result.trajectory is not None:
        what = "an estimate with a motion has no sensitivity"
        raise InputError(what, where="sensitivity", fix="align its frames without `motion`")
    basis = statistics.basis
    if basis is None and result.options is not None and result.covariance is not None:
        basis = _basis_of_fit(result, result.options)
    if basis is None:
        what = "the result holds no evidence: it was read from a file"
        raise InputError(what, where="sensitivity", fix="align again")
    return _of_evidence(result, basis, view)


def _basis_of_fit(result: ResultData, options: FitOptions) -> Basis:
    """The evidence of a fit, and its state."""
    own = result.views[0]
    model = Model(
        points_3d=result.points_3d,
        ids=result.ids,
        stretch=options.stretch,
        stretch_sigma=options.stretch_sigma,
        known_axis=options.known_axis,
    )
    sigma = result.sigma if options.sigma is None else options.sigma
    camera = faced(own.camera, own.points_2d)
    view = View(camera, own.points_2d, ids=own.ids, sigma=sigma)
    focals = int(options.focal == "estimate")
    evidence = evidence_of(
        prior_of(model),
        [view],
        None,
        loss=LOSSES[options.loss],
        loss_scale=options.loss_scale,
        lenses=Lenses((camera,), (focals - 1,), options.focal_prior),
    )
    rows = rows_among(result.ids, own.ids, "ids")
    evidence = with_sightings(evidence, own.inliers[np.argsort(rows, kind="stable")])
    pose = turned_alignment(own.alignment, camera.lens_from_camera.T)
    state = State(
        np.concatenate([pose.rotation.ravel(), pose.translation])[None],
        np.zeros(focals),
        np.log(pose.scale),
        np.zeros(0),
        np.zeros_like(evidence.shape.mean),
    )
    return Basis(evidence, state, principal_sigma=options.principal_sigma)


def _of_evidence(result: ResultData, basis: AnyBasis, view: int) -> Sensitivity:
    """The sensitivity of one view's pose, and of all that the views share."""
    numbers = basis.numbers or tuple(range(len(result.views)))
    if view not in numbers:
        what = f"views[{view}] is left out of the estimate"
        raise InputError(what, where="view", fix="give the number of another one")
    evidence, state = basis.evidence, basis.state
    if isinstance(basis, Basis) and isinstance(result.model, ShapeModel):  # as it was estimated
        evidence, state = widened(evidence, state, 1 / result.model.inflation)
    of_view = np.repeat(np.arange(len(result.views)), [len(each.ids) for each in result.views])
    ids = [name for each in result.views for name in each.ids]
    rows, kept = np.array(rows_among(result.ids, ids, "ids")), np.flatnonzero(result.inliers)
    kept = kept[np.argsort(rows[kept], kind="stable")]  # the order of the sightings
    pixels = np.concatenate(result.observed)[kept]
    cameras = [faced(each.camera, each.points_2d) for each in (result.views[k] for k in numbers)]
    optimum = JointOptimum.of(evidence, state, cameras, pixels, basis.principal_sigma)
    image, slopes = numbers.index(view), optimum.slopes
    shown = _Shown(result, optimum, image, cameras[image].lens_from_camera)

    def spread(values: FloatArray, axis: int) -> FloatArray:
        """Columns of all keypoints from those of the inliers, 0 for the others."""
        shape = list(values.shape)
        shape[axis] = len(ids)
        whole = np.zeros(shape)
        whole[(slice(None),) * axis + (kept,)] = values
        return whole

    def of_points(values: FloatArray) -> FloatArray | None:
        if not has_latent(evidence):
            return None
        return spread(np.tensordot(shown.points[: len(result.points_3d)], values, 1), 2)

    by_points = np.tensordot(shown.unknowns, slopes.by_points, 1)
    by_points[6:9] += shown.lengths_by_mean[:, rows[kept]]
    sigma = np.sqrt(np.trace(optimum.keypoints.covariances, axis1=1, axis2=2) / 2)
    return Sensitivity(
        tuple(ids),
        of_view,
        spread(np.tensordot(shown.unknowns, slopes.by_pixels, 1), 1),
        spread(np.tensordot(shown.unknowns, slopes.by_log_sigma, 1), 1),
        spread(by_points, 1),
        of_points(slopes.by_pixels),
        of_points(slopes.by_log_sigma),
        spread(sigma, 0),
        cast(FloatArray, result.views[view].covariance),
    )


@dataclass(frozen=True, eq=False)
class _Shown:
    """A result's numbers by the unknowns of its optimum.

    ``turn`` (3, 3) leads from the frame of the view's camera, the one that was estimated in, to
    that of the result.
    """

    result: ResultData
    optimum: JointOptimum
    image: int
    turn: FloatArray

    @cached_property
    def points(self) -> FloatArray:
        """Derivatives (m + 2, 3, U) of points before the stretch, the box's corners last."""
        shape, first = self.optimum.evidence.shape, self.optimum.parts
        count = len(shape.mean)
        found = np.zeros((count, 3, first.displacements + 3 * count))
        found[:, :, first.coefficients : first.displacements] = np.moveaxis(shape.modes, 0, 2)
        found[:, :, first.displacements :] = np.eye(3 * count).reshape(count, 3, -1)
        return found[np.r_[: len(self.result.ids), -2:0]]

    @cached_property
    def unknowns(self) -> FloatArray:
        """Derivatives (9 or 10, U) of rotation vector, translation, log lengths and log focal."""
        evidence, state, first = self.optimum.evidence, self.optimum.state, self.optimum.parts
        group = int(evidence.focals.group[self.image])
        found = np.zeros((9 + (group >= 0), self.points.shape[2]))
        pose = 6 * int(evidence.rig.pose[self.image])
        turn = self.turn @ evidence.rig.cam_from_rig[self.image, :9].reshape(3, 3)
        found[:3, pose : pose + 3] = found[3:6, pose + 3 : pose + 6] = turn
        found[6:9, first.scales : first.coefficients] = np.eye(3)
        if group >= 0:
            found[9, first.focals + group] = 1.0
        if self.result.symmetry is not None:
            given = turned_alignment(poses_of(evidence, state)[self.image], self.turn)
            free = (evidence.scales.free == 0).tolist()
            found[:9] = equal_slopes(given, self.result.symmetry, held=tuple(free)) @ found[:9]
        if isinstance(self.result.model, ShapeModel):
            low, high = self._corners
            axes = np.arange(3)
            extent = self.result.bounds[1] - self.result.bounds[0]
            found[6:9] += (self.points[high, axes] - self.points[low, axes]) / extent[:, None]
        return found

    @cached_property
    def _corners(self) -> tuple[IntArray, IntArray]:
        """Rows (3,) of the shape's points that the least and the greatest corner move with.

        Without margins these are the corners of the linear box, or keypoints beyond them.
        """
        evidence, state, result = self.optimum.evidence, self.optimum.state, self.result
        count = len(result.points_3d)
        seen = np.unique(evidence.sightings.point)
        seen = seen[seen < count]
        own = count + np.array([[0, 0, 0], [1, 1, 1]])
        margins = cast(ShapeModel, result.model).box_margins
        if margins is not None and not len(evidence.offsets.value):
            linear = points_of(evidence.shape, state)[-2:] / np.exp(state.log_scales)
            _, own = placed_box(np.concatenate([result.points_3d, linear]), seen, margins)
        given = result.points_3d[seen]
        for side, outermost in enumerate((given.argmin(axis=0), given.argmax(axis=0))):
            at_corner = np.abs(result.bounds[side] - given[outermost, np.arange(3)]) < _NEAR
            own[side, at_corner] = seen[outermost[at_corner]]
        return own[0], own[1]

    @cached_property
    def lengths_by_mean(self) -> FloatArray:
        """Derivatives (3, m, 3) of log lengths by the mean's keypoints that are corners."""
        count = len(self.result.points_3d)
        found = np.zeros((3, count + 2, 3))
        if isinstance(self.result.model, ShapeModel):
            low, high = self._corners
            axes = np.arange(3)
            extent = self.result.bounds[1] - self.result.bounds[0]
            found[axes, high, axes] += 1 / extent
            found[axes, low, axes] -= 1 / extent
        return found[:, :count]
