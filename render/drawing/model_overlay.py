"""A placed model over its photo, with its box and its axes."""

from __future__ import annotations

import logging
import os
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray
from cadalign.errors import DataError, InputError
from cadalign.geometry.alignment import Alignment, Box
from cadalign.geometry.camera import Camera
from cadalign.geometry.mesh import Mesh
from cadalign.io.images import read_image
from cadalign.io.meshes.files import load_mesh, mesh_at
from cadalign.io.observation import Observation
from cadalign.render.drawing.canvas import ByteImage
from cadalign.render.drawing.layers import confidence_regions
from cadalign.render.drawing.overlay import draw_overlay
from cadalign.render.raycast.renderer import RaycastRenderer, cast_geometry
from cadalign.render.scene import LIGHT_GREY, Scene, check_image_size

logger = logging.getLogger("cadalign")


def overlay_model(
    image: npt.ArrayLike,
    camera: Camera,
    mesh: Mesh | Scene,
    alignment: Alignment,
) -> ByteImage:
    """Draw an aligned model over its photo, shaded, with its edges, its box and its axes.

    Parameters
    ----------
    image : (h, w), (h, w, 3) or (h, w, 4) uint8
        The photo, of the camera's size.
    camera : Camera
        Its lens distortion bends the model, the box and the axes.
    mesh : Mesh or Scene
        The model, before its stretch: a result's ``mesh()`` where the object's shape was estimated.
        A `Scene` is prepared once for many photos.
    alignment : Alignment
        The model's pose and stretch, of a result or the truth.

    Returns
    -------
    (h, w, 3) uint8

    Raises
    ------
    InputError
        If the image is of another kind or size.
    RenderError
        If the image is too large.

    Examples
    --------
    >>> triangle = Mesh([[-1, -1, 0], [1, -1, 0], [0, 2, 0]], [[0, 1, 2]])
    >>> camera = Camera.from_fov(65, 49, fov_x=60.0)
    >>> photo = np.zeros((49, 65, 3), np.uint8)
    >>> pose = Alignment(np.eye(3), [0, 0, 4], [1, 1, 1])
    >>> overlay_model(photo, camera, triangle, pose).shape
    (49, 65, 3)
    """
    scene = mesh if isinstance(mesh, Scene) else Scene(mesh)
    return draw_overlay(
        image,
        camera,
        est_box=Box.from_model(scene.bounds, alignment),
        est_frame=RaycastRenderer().render(scene, camera, alignment),
        legend=False,
    )


_SAME = 1e-9  # of the model's size
_INSIDE = 0.5  # least probability of a pixel of the object
_CONTOUR_COLOR = (70, 190, 250)


def draw_result(
    photo: npt.ArrayLike,
    result: Any,
    *,
    mesh: Mesh | None = None,
    bounds: FloatArray | None = None,
    mask: npt.NDArray[Any] | None = None,
    number: int = 0,
) -> ByteImage:
    """Draw the estimated box, keypoints with their uncertainty, and mesh over the photo of a view.

    Keypoints that the view does not show are drawn with the regions that hold them; where the views
    have a pose each, regions are drawn in the first one alone. ``photo`` is as for `draw_overlay`,
    ``result`` a `cadalign.Result`; ``mesh`` the object's in the model's frame before the stretch,
    see `mesh_of`; ``bounds`` (2, 3) the box to draw in that frame, by default the result's;
    ``mask`` (h, w) the view's, whose contour is drawn; ``number`` the view's in the result.
    """
    view = result.views[number]
    camera, alignment = view.camera, view.alignment
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
        turned = turn @ covariances[ahead] @ turn.T
        projected = camera.projected_covariances(in_camera[ahead], turned)
        regions = confidence_regions(camera.project(in_camera[ahead]), projected)
    frame = None
    if mesh is not None:
        frame = cast_geometry(Scene(mesh), camera, alignment)
    return draw_overlay(
        photo if mask is None else draw_contour(np.asarray(photo), np.asarray(mask)),
        camera,
        est_box=Box.from_model(result.bounds if bounds is None else bounds, alignment),
        est_frame=frame,
        observed=view.points_2d,
        reprojected=camera.project_where_ahead(own),
        unseen=camera.project(in_camera[unseen]) if unseen.any() else None,
        regions=regions,
        outliers=view.points_2d[~view.inliers],
    )


def photo_of(image: Path | str | npt.ArrayLike | None, camera: Camera) -> npt.NDArray[Any]:
    """The pixels of a photo, grey where there is none; refuses images that are too large."""
    check_image_size(camera)
    if image is None:
        return np.full((camera.height, camera.width, 3), LIGHT_GREY, dtype=np.uint8)
    if isinstance(image, Path | str):
        return read_image(Path(image), camera)
    return np.asarray(image)


def draw_contour(image: ByteImage, mask: npt.NDArray[Any]) -> ByteImage:
    """Draw the contour of a mask (h, w) over an image; returns a copy."""
    inside = (mask > _INSIDE).astype(np.uint8)
    contours, _ = cv2.findContours(inside, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    drawn = image.copy()
    cv2.drawContours(drawn, contours, -1, _CONTOUR_COLOR, 1, cv2.LINE_AA)
    return drawn


def mesh_of(observation: Observation, result: Any) -> Mesh | None:
    """The object's mesh, warped from the observation's model or the nearest training model.

    Of a fit of pairs the model's own. In the model's frame, before the stretch. None where no mesh
    is known; a training mesh that cannot be read is warned of (logger "cadalign").
    """
    if result.method != "align":
        return None if observation.model is None else mesh_at(observation.model)
    from cadalign.shapes.model import ShapeModel  # takes time to import
    from cadalign.shapes.warp import warp_mesh

    model = result.model
    if model is not None and not isinstance(model, ShapeModel):
        return None if model.mesh is None else result.mesh()
    sources = {
        label: xyz
        for image, view in zip(observation.views, result.views, strict=True)
        for label, xyz in zip(view.ids, image.points_3d, strict=True)
    }
    row_of = {label: row for row, label in enumerate(result.ids)}
    source = np.array(list(sources.values())).reshape(-1, 3)
    target = result.points_3d[[row_of[label] for label in sources]]
    if observation.model is None or (model is not None and not source.any()):
        return None if model is None else drawable_mesh(result)
    mesh = load_mesh(observation.model)
    if not sources or np.abs(source - target).max() <= _SAME * np.ptp(source):
        return mesh
    return warp_mesh(mesh, source, target, bounds=result.bounds)


def drawable_mesh(result: Any, mesh: Mesh | str | os.PathLike[str] | None = None) -> Mesh | None:
    """The mesh of a result; None where there is none to warp, or the model's cannot be read."""
    try:
        return cast(Mesh, result.mesh(mesh))
    except InputError:
        if mesh is not None:
            raise
    except DataError as error:
        if mesh is not None:
            raise
        logger.warning("the nearest training model is not drawn: %s", error)
    return None
