"""Draw an estimated shape, and its uncertainty, over the photo of its observation."""

from __future__ import annotations

import logging

import numpy as np

from cadalign.datasets import load_mesh
from cadalign.errors import CadalignError
from cadalign.fitting.joint.result import AlignResult
from cadalign.fitting.joint.view import View
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.projection import projected_covariances
from cadalign.io.observation import Observation
from cadalign.render import Scene, cast_geometry, draw_overlay
from cadalign.render.drawing.color import ByteImage
from cadalign.render.drawing.fit_overlay import photo_of
from cadalign.render.drawing.keypoint_layer import confidence_regions
from cadalign.shapes.model import ShapeModel
from cadalign.shapes.warp import warp_mesh

logger = logging.getLogger("cadalign")


def draw_aligned(
    observation: Observation, view: View, result: AlignResult, *, mesh: Mesh | None
) -> ByteImage:
    """Draw the estimated box, keypoints with their uncertainty, and mesh over the photo.

    Parameters
    ----------
    observation : Observation
        Its photo is drawn on, or grey where there is none.
    view : View
        The view that the result is of.
    result : AlignResult
    mesh : Mesh, optional
        The object's, in the model's frame before the stretch; see `mesh_of`.
    """
    camera, alignment = view.camera, result.alignment
    in_camera = alignment.apply(result.points_3d)
    ahead = in_camera[:, 2] > 0
    row_of = {label: row for row, label in enumerate(result.ids)}
    rows = [row_of[label] for label in view.keypoint_ids]
    unseen = ahead.copy()
    unseen[rows] = False
    covariances = projected_covariances(
        in_camera[ahead], result.points_cam_covariance[ahead], camera
    )
    regions = confidence_regions(camera.project(in_camera[ahead]), covariances)
    frame = None if mesh is None else cast_geometry(Scene(mesh), camera, alignment)
    return draw_overlay(
        photo_of(observation, camera),
        camera,
        est_box=result.box,
        est_frame=frame,
        observed=view.points_2d,
        reprojected=np.asarray(view.points_2d) + result.residuals[0],
        unseen=camera.project(in_camera[unseen]),
        regions=regions,
    )


def mesh_of(observation: Observation, view: View, result: AlignResult) -> Mesh | None:
    """The object's mesh, warped from the observation's model or the nearest training model.

    In the model's frame, before the stretch. None where no mesh is known; a training mesh that
    cannot be read is warned of (logger "cadalign").
    """
    if not isinstance(result.model, ShapeModel):
        known = result.model is not None and result.model.mesh is not None
        return result.mesh() if known else None
    if observation.model is not None and observation.points_3d.any():
        row_of = {label: row for row, label in enumerate(result.ids)}
        rows = [row_of[label] for label in view.keypoint_ids]
        mesh = load_mesh(observation.model)
        targets = result.points_3d[rows]
        return warp_mesh(mesh, observation.points_3d, targets, bounds=result.bounds)
    training = result.model.training
    if training is None or not len(training) or result.nearest.mesh_path is None:
        return None
    try:
        return result.mesh(load_mesh(result.nearest.mesh_path))
    except CadalignError as error:
        logger.warning("the nearest training model is not drawn: %s", error)
        return None
