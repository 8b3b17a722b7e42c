"""The problem of an estimate: the model, the views that take part, known lengths, and options.

The camera of a wide lens is turned towards the object, so that the object is in front of it. The
rig contains the turn, and results have the poses of the given cameras.

Without a rig, a view whose keypoints do not determine its pose is left out: it keeps its number,
but has neither evidence nor a pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.errors import DegenerateError, InputError
from cadalign.estimation.model import Model, is_exact_model
from cadalign.estimation.options import FitOptions, RansacOptions
from cadalign.estimation.pack import evidence_of
from cadalign.estimation.prior import Lenses, ShapePrior, prior_of
from cadalign.estimation.view import View
from cadalign.geometry.alignment import Alignment, are_on_a_line
from cadalign.geometry.camera import face_pixels, needs_facing, rays_ahead
from cadalign.io.evidence import Size
from cadalign.shapes.model import ShapeModel
from cadalign.solvers.constants import LEAST_POINTS
from cadalign.solvers.joint.evidence import Evidence, Shape

Inits = Sequence[Alignment | None]
"""Given starts: one for each view or, with a rig, one in the rig's frame."""

_ON_A_LINE = 1e-3  # largest ratio of second to first extent of keypoints on a line
_MOST_PIXELS = 500  # of a mask, towards which a wide lens is turned


class Problem(NamedTuple):
    """Model, views, known lengths and options of an estimate.

    ``views`` are the ``given`` ones with cameras turned by ``turns`` (3, 3); a view without a pose
    has no evidence. Keypoints without sigma have the standard deviation ``noise`` [px].
    """

    model: Model | ShapeModel
    prior: ShapePrior
    given: tuple[View, ...]
    views: tuple[View, ...]
    size: Size | None
    inits: Inits
    options: FitOptions
    ransac: RansacOptions | None
    lenses: Lenses
    turns: tuple[FloatArray, ...]
    noise: float = 1.0

    @property
    def lacks_sigma(self) -> bool:
        return any(view.sigma is None and len(view.keypoint_ids) for view in self.views)

    @property
    def is_rig(self) -> bool:
        """True if the views share one pose."""
        return self.views[0].cam_from_rig is not None

    @property
    def numbers(self) -> list[int]:
        """Numbers of the views that take part."""
        return [number for number, view in enumerate(self.views) if view.has_evidence]

    @property
    def uses_outlines(self) -> bool:
        return any(view.has_outline for view in self.views)

    @property
    def is_mask_alone(self) -> bool:
        """True for one view with a mask, without keypoints or start, of an exact model's mesh."""
        if len(self.views) > 1 or any(self.inits) or not is_exact_model(self.model):
            return False
        return self.views[0].has_mask_alone and getattr(self.model, "mesh", None) is not None

    def threshold(self, ransac: RansacOptions) -> float:
        """Largest reprojection error of an inlier [px], for an exact shape."""
        seen = [view for view in self.views if len(view.keypoint_ids)]
        sigmas = [self.noise if view.sigma is None else view.sigma for view in seen]
        limits = [ransac.threshold(sigma) for sigma in sigmas] or [ransac.threshold(None)]
        return float(np.sqrt(np.mean(np.square(limits))))

    def evidence(self, shape: Shape, lenses: Lenses) -> Evidence:
        """The evidence for one component of the shape, with the focal lengths of ``lenses``."""
        return evidence_of(
            self.prior,
            shape,
            self.views,
            self.size,
            options=self.options,
            lenses=lenses,
            turns=self.turns,
            noise=self.noise,
        )


def compile_problem(
    model: Model | ShapeModel,
    views: Sequence[View],
    size: Size | None,
    inits: Inits,
    options: FitOptions,
    ransac: RansacOptions | None,
) -> Problem:
    """Compile the problem from arguments of the right types.

    Raises InputError if a view has no evidence, has keypoints that the model lacks, or, without
    ``ransac``, has keypoints all around a wide lens; DegenerateError if the first view has no pose.
    """
    prior = prior_of(model)
    for view in views:
        if not view.has_evidence:
            raise InputError(
                "has no evidence about the object",
                where=f"views[{view.number}]",
                fix="give keypoints, a mask or a direction, or omit the view",
            )
    facing = [_facing_view(view) for view in views]
    if ransac is None:
        for view in facing:
            if view.camera.is_wide:
                rays_ahead(view.pixels, view.camera)
    lenses = Lenses.from_views(facing, options.focal, options.focal_prior)
    turns = tuple(
        np.eye(3) if own is view else own.camera.lens_from_camera
        for own, view in zip(facing, views, strict=True)
    )
    problem = Problem(
        model, prior, tuple(views), tuple(facing), size, inits, options, ransac, lenses, turns
    )
    return _drop_views_without_pose(problem)


def no_pose_error(problem: Problem) -> DegenerateError:
    """The error if no start leads to a pose; raises InputError if an outline lacks its mesh."""
    shown = [view for view in problem.views if view.has_outline]
    if shown:
        from cadalign.estimation.contours.outline import surface_of  # imports this package

        keypoints = problem.prior.components[0].mean[: len(problem.prior.ids)]
        field = "image" if shown[0].mask is None else "mask"
        surface_of(problem.model, keypoints, f"views[{shown[0].number}].{field}")
    return DegenerateError(
        "the evidence gives no pose with the keypoints in front of the camera",
        where="views",
        fix="give at least 3 keypoints in one view, or `init`, and check the correspondences",
    )


def _drop_views_without_pose(problem: Problem) -> Problem:
    """Without a rig, drop views that have no start and too few keypoints for a pose.

    Raises DegenerateError if the first view is dropped.
    """
    views, prior = list(problem.views), problem.prior
    if len(views) < 2 or any(view.cam_from_rig is not None for view in views):
        return problem
    for number, view in enumerate(problem.views):
        rows = prior.rows_of(view.keypoint_ids, f"views[{number}].ids")
        points = prior.components[0].mean[rows]
        is_open = len(points) < LEAST_POINTS or are_on_a_line(points, _ON_A_LINE)
        if is_open and problem.inits[number] is None:
            views[number] = View(view.camera, number=view.number)
    if not views[0].has_evidence:
        raise DegenerateError(
            "its keypoints do not determine its pose, and the result is in its camera's frame",
            where="views[0]",
            fix="give at least 3 keypoints, not on one line, or another view first",
        )
    lenses = Lenses.from_views(views, problem.options.focal, problem.options.focal_prior)
    return problem._replace(views=tuple(views), lenses=lenses)


def _facing_view(view: View) -> View:
    """Turn the camera of a wide lens to the object; ``up`` and depths stay in the lens's frame."""
    if not needs_facing([view.camera]):
        return view
    pixels = view.pixels
    if view.has_mask_alone:
        inside = np.argwhere(np.asarray(view.mask) > 0.5)[:, ::-1]
        pixels = inside[:: max(len(inside) // _MOST_PIXELS, 1)].astype(float)
    return replace(view, camera=face_pixels(view.camera, pixels))
