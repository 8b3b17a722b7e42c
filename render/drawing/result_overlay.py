"""Draw a result, and its uncertainty, over the photo of its observation."""

from __future__ import annotations

import logging
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.errors import CadalignError
from cadalign.estimation.result import Result
from cadalign.geometry.box import Box
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.projection import projected_covariances
from cadalign.io.images import read_image
from cadalign.io.meshes.load import load_mesh
from cadalign.io.observation import Observation
from cadalign.io.observed_image import ObservedImage
from cadalign.render.drawing.color import ByteImage
from cadalign.render.drawing.keypoint_layer import confidence_regions
from cadalign.render.drawing.overlay import draw_overlay
from cadalign.render.frame import LIGHT_GREY, check_image_size
from cadalign.render.raycast.renderer import cast_geometry
from cadalign.render.scene import Scene

logger = logging.getLogger("cadalign")

_INSIDE = 0.5  # least probability of a pixel of the object
_CONTOUR_COLOR = (70, 190, 250)


def draw_result(
    image: ObservedImage,
    result: Result,
    *,
    photo: ByteImage | None = None,
    mesh: Mesh | None = None,
    bounds: FloatArray | None = None,
    mask: npt.NDArray[Any] | None = None,
    number: int = 0,
) -> ByteImage:
    """Draw the estimated box, keypoints with their uncertainty, and mesh over the photo of a view.

    Keypoints that the view does not show are drawn with the regions that hold them; where the views
    have a pose each, regions are drawn in the first one alone. ``photo`` (h, w, 3) is the image's
    if it has been read already, grey where there is none; ``mesh`` the object's in the model's
    frame before the stretch, see `mesh_of`; ``bounds`` (2, 3) the box to draw in that frame, by
    default the result's; ``mask`` (h, w) the view's, whose contour is drawn; ``number`` the view's
    in the result.
    """
    view = result.views[number]
    camera, alignment = view.camera, view.alignment
    photo = photo_of(image, camera) if photo is None else photo
    in_camera = alignment.apply(result.points_3d)
    ahead = camera.sees(in_camera)
    seen = set(view.ids)
    unseen = ahead & np.array([label not in seen for label in result.ids], dtype=bool)
    row_of = {label: row for row, label in enumerate(result.ids)}
    own = in_camera[[row_of[label] for label in view.ids]]
    covariances, regions = result.points_cam_covariance, None
    is_first = number == 0 or result.rig_from_model is not None
    if result.model is not None and covariances is not None and is_first:
        turn = alignment.rotation @ result.alignment.rotation.T
        projected = projected_covariances(
            in_camera[ahead], turn @ covariances[ahead] @ turn.T, camera
        )
        regions = confidence_regions(camera.project(in_camera[ahead]), projected)
    frame = None
    if mesh is not None:
        frame = cast_geometry(Scene(mesh), camera, alignment)
    return draw_overlay(
        photo if mask is None else draw_contour(photo, np.asarray(mask)),
        camera,
        est_box=Box.from_model(result.bounds if bounds is None else bounds, alignment),
        est_frame=frame,
        observed=view.points_2d,
        reprojected=camera.project_where_ahead(own),
        unseen=camera.project(in_camera[unseen]) if unseen.any() else None,
        regions=regions,
    )


def photo_of(observation: ObservedImage, camera: Camera) -> ByteImage:
    """The photo (h, w, 3), grey where there is none; refuses images that are too large."""
    check_image_size(camera)
    if observation.image is None:
        return np.full((camera.height, camera.width, 3), LIGHT_GREY, dtype=np.uint8)
    return read_image(observation.image, camera)


def draw_contour(image: ByteImage, mask: npt.NDArray[Any]) -> ByteImage:
    """Draw the contour of a mask (h, w) over an image; returns a copy."""
    inside = (mask > _INSIDE).astype(np.uint8)
    contours, _ = cv2.findContours(inside, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    drawn = image.copy()
    cv2.drawContours(drawn, contours, -1, _CONTOUR_COLOR, 1, cv2.LINE_AA)
    return drawn


def mesh_of(observation: Observation, result: Result) -> Mesh | None:
    """The object's mesh, warped from the observation's model or the nearest training model.

    In the model's frame, before the stretch. None where no mesh is known; a training mesh that
    cannot be read is warned of (logger "cadalign").
    """
    from cadalign.shapes.model import ShapeModel  # takes time to import
    from cadalign.shapes.warp import warp_mesh

    if not isinstance(result.model, ShapeModel):
        known = result.model is not None and result.model.mesh is not None
        return result.mesh() if known else None
    sources = {
        label: xyz
        for image, view in zip(observation.views, result.views, strict=True)
        for label, xyz in zip(view.ids, image.points_3d, strict=True)
    }
    if observation.model is not None and np.any(list(sources.values())):
        row_of = {label: row for row, label in enumerate(result.ids)}
        rows = [row_of[label] for label in sources]
        mesh = load_mesh(observation.model)
        targets = result.points_3d[rows]
        return warp_mesh(mesh, np.array(list(sources.values())), targets, bounds=result.bounds)
    return nearest_mesh(result)


def nearest_mesh(result: Result) -> Mesh | None:
    """The mesh of the training model nearest to a result of a learned shape, warped.

    In the model's frame, before the stretch. None where no mesh is known; one that cannot be read
    is warned of (logger "cadalign").
    """
    from cadalign.shapes.model import ShapeModel  # takes time to import

    if not isinstance(result.model, ShapeModel):
        return None
    training = result.model.training
    if training is None or not len(training) or result.nearest.mesh_path is None:
        return None
    try:
        return result.mesh(load_mesh(result.nearest.mesh_path))
    except CadalignError as error:
        logger.warning("the nearest training model is not drawn: %s", error)
        return None
