"""An estimate's problem: the model, the views that take part, known lengths, and options.

A wide lens is turned to what its view shows, so that this lies in front of the camera. The turn is
part of the rig: poses are those of the cameras as they were given.

A view of unknown motion whose keypoints determine no pose does not take part: it has no evidence
and no pose, and keeps its number.
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
from cadalign.geometry.camera import faced, needs_facing, rays_ahead
from cadalign.io.evidence import Size
from cadalign.shapes.model import ShapeModel
from cadalign.solvers.constants import LEAST_POINTS
from cadalign.solvers.joint.evidence import Evidence, Shape

Inits = Sequence[Alignment | None]
"""Given starts: one for each view of unknown motion, or one in the frame that the views share."""

_ON_A_LINE = 1e-3  # second over first extent of keypoints that determine no rotation about it
_MOST_PIXELS = 500  # of a mask, amid which a wide lens is turned


class Problem(NamedTuple):
    """Model, views, known lengths and options of an estimate.

    The ``views`` are those ``given``, with lenses turned by ``turns`` (3, 3), and without evidence
    where one has no pose. Keypoints without sigma have the deviation ``noise`` [px].
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
        """True if the mask of the only view is all evidence of the pose of a model with a mesh."""
        if len(self.views) > 1 or any(self.inits) or not is_exact_model(self.model):
            return False
        return self.views[0].has_mask_alone and getattr(self.model, "mesh", None) is not None

    def threshold(self, ransac: RansacOptions) -> float:
        """Largest reprojection error of an inlier [px], by the noise alone."""
        seen = [view for view in self.views if len(view.keypoint_ids)]
        sigmas = [self.noise if view.sigma is None else view.sigma for view in seen]
        limits = [ransac.threshold(sigma) for sigma in sigmas] or [ransac.threshold(None)]
        return float(np.sqrt(np.mean(np.square(limits))))

    def evidence(self, shape: Shape, lenses: Lenses) -> Evidence:
        """The evidence about one component of the shape, with rays of ``lenses``."""
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
    """The problem of checked arguments.

    Raises InputError if a view has no evidence, or keypoints that the model lacks or, without
    ``ransac``, all around a wide lens; DegenerateError if the first view has no pose.
    """
    prior = prior_of(model)
    for view in views:
        if not view.has_evidence:
            raise InputError(
                "tells nothing about the object",
                where=f"views[{view.number}]",
                fix="give keypoints, a mask or a direction, or leave the view away",
            )
    facing = [_facing_view(view) for view in views]
    if ransac is None:
        for view in facing:
            if view.camera.is_wide:
                rays_ahead(view.pixels, view.camera)
    lenses = Lenses.of(facing, options.focal, options.focal_prior)
    turns = tuple(
        np.eye(3) if own is view else own.camera.lens_from_camera
        for own, view in zip(facing, views, strict=True)
    )
    problem = Problem(
        model, prior, tuple(views), tuple(facing), size, inits, options, ransac, lenses, turns
    )
    return _drop_views_without_pose(problem)


def no_pose_error(problem: Problem) -> DegenerateError:
    """The error where no start leads to a pose; InputError of outlines without meshes."""
    shown = [view for view in problem.views if view.has_outline]
    if shown:
        from cadalign.estimation.contours.outline import surface_of  # imports this package

        keypoints = problem.prior.components[0].mean[: len(problem.prior.ids)]
        field = "image" if shown[0].mask is None else "mask"
        surface_of(problem.model, keypoints, f"views[{shown[0].number}].{field}")
    return DegenerateError(
        "no pose with the keypoints in front of the camera follows from the evidence",
        where="views",
        fix="give at least 3 keypoints in one view, or `init`, and check which is which",
    )


def _drop_views_without_pose(problem: Problem) -> Problem:
    """The problem without views of unknown motion, without a start, that determine no pose.

    Raises DegenerateError if the first is one of these.
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
    lenses = Lenses.of(views, problem.options.focal, problem.options.focal_prior)
    return problem._replace(views=tuple(views), lenses=lenses)


def _facing_view(view: View) -> View:
    """The view of a wide lens turned to what it shows; ``up`` and depths stay the lens's."""
    if not needs_facing([view.camera]):
        return view
    return replace(view, camera=faced(view.camera, _pixels_of_object(view)))


def _pixels_of_object(view: View) -> FloatArray:
    """Pixels (n, 2) where a view shows the object: its keypoints or, without any, its mask."""
    if not view.has_mask_alone:
        return view.pixels
    inside = np.argwhere(np.asarray(view.mask) > 0.5)[:, ::-1]
    return inside[:: max(len(inside) // _MOST_PIXELS, 1)].astype(float)
