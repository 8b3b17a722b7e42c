"""Draw an estimated shape, and its uncertainty, over the photo of its observation."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from cadalign.datasets import load_mesh
from cadalign.errors import CadalignError
from cadalign.estimation.align_result import AlignResult
from cadalign.estimation.view import View
from cadalign.geometry.box import Box
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.projection import projected_covariances
from cadalign.io.observation import Observation
from cadalign.io.observed_image import ObservedImage
from cadalign.render import Scene, cast_geometry, draw_overlay
from cadalign.render.drawing.color import ByteImage
from cadalign.render.drawing.fit_overlay import photo_of
from cadalign.render.drawing.keypoint_layer import confidence_regions
from cadalign.shapes.model import ShapeModel
from cadalign.shapes.warp import warp_mesh

logger = logging.getLogger("cadalign")

_INSIDE = 0.5  # least probability of a pixel of the object
_CONTOUR_COLOR = (70, 190, 250)


def draw_aligned(
    image: ObservedImage, view: View, result: AlignResult, *, mesh: Mesh | None, number: int = 0
) -> ByteImage:
    """Draw the estimated box, keypoints with their uncertainty, and mesh over the photo of a view.

    The contour of the view's mask is drawn, too. Where the views have a pose each, the uncertainty
    is drawn in the first one alone.

    Parameters
    ----------
    image : ObservedImage
        Its photo is drawn on, or grey where there is none.
    view : View
        The view that the image became.
    result : AlignResult
    mesh : Mesh, optional
        The object's, in the model's frame before the stretch; see `mesh_of`.
    number : int
        The view's number in the result.
    """
    camera, alignment = view.camera, result.poses[number]
    in_camera = alignment.apply(result.points_3d)
    ahead = in_camera[:, 2] > 0
    row_of = {label: row for row, label in enumerate(result.ids)}
    rows = [row_of[label] for label in view.keypoint_ids]
    unseen = ahead.copy()
    unseen[rows] = False
    regions = None
    if number == 0 or view.cam_from_rig is not None:
        turn = alignment.rotation @ result.alignment.rotation.T
        covariances = turn @ result.points_cam_covariance[ahead] @ turn.T
        covariances = projected_covariances(in_camera[ahead], covariances, camera)
        regions = confidence_regions(camera.project(in_camera[ahead]), covariances)
    frame = None if mesh is None else cast_geometry(Scene(mesh), camera, alignment)
    photo = photo_of(image, camera)
    return draw_overlay(
        photo if view.mask is None else draw_contour(photo, np.asarray(view.mask)),
        camera,
        est_box=Box.from_model(result.bounds, alignment),
        est_frame=frame,
        observed=view.points_2d,
        reprojected=np.asarray(view.points_2d) + result.residuals[number],
        unseen=camera.project(in_camera[unseen]),
        regions=regions,
    )


def draw_contour(image: ByteImage, mask: npt.NDArray[Any]) -> ByteImage:
    """Draw the contour of a mask (h, w) over an image; returns a copy."""
    import cv2

    inside = (mask > _INSIDE).astype(np.uint8)
    contours, _ = cv2.findContours(inside, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    drawn = image.copy()
    cv2.drawContours(drawn, contours, -1, _CONTOUR_COLOR, 1, cv2.LINE_AA)
    return drawn


def mesh_of(observation: Observation, views: Sequence[View], result: AlignResult) -> Mesh | None:
    """The object's mesh, warped from the observation's model or the nearest training model.

    In the model's frame, before the stretch. None where no mesh is known; a training mesh that
    cannot be read is warned of (logger "cadalign").
    """
    if not isinstance(result.model, ShapeModel):
        known = result.model is not None and result.model.mesh is not None
        return result.mesh() if known else None
    sources = {
        label: xyz
        for image, view in zip(observation.views, views, strict=True)
        for label, xyz in zip(view.keypoint_ids, image.points_3d, strict=True)
    }
    if observation.model is not None and np.any(list(sources.values())):
        row_of = {label: row for row, label in enumerate(result.ids)}
        rows = [row_of[label] for label in sources]
        mesh = load_mesh(observation.model)
        targets = result.points_3d[rows]
        return warp_mesh(mesh, np.array(list(sources.values())), targets, bounds=result.bounds)
    training = result.model.training
    if training is None or not len(training) or result.nearest.mesh_path is None:
        return None
    try:
        return result.mesh(load_mesh(result.nearest.mesh_path))
    except CadalignError as error:
        logger.warning("the nearest training model is not drawn: %s", error)
        return None
