"""Test instances of an annotated model: a view, a stretch, noisy visible keypoints."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, IntArray
from cadalign.evaluation.instances.hull import KeypointHull, sample_hull_view
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import Box
from cadalign.geometry.camera import Camera
from cadalign.geometry.projection import perspective
from cadalign.seeding import instance_rng

if TYPE_CHECKING:
    # Workers that look at annotations only are not to carry the renderer's libraries.
    from cadalign.datasets import AnnotatedModel
    from cadalign.render import Scene

KEYPOINT_CAMERA = Camera(width=640, height=480, fx=935.0, fy=935.0, cx=319.5, cy=239.5)
"""The camera of the sparse-keypoint experiment."""
STRETCH_RANGE = (0.5, 2.0)
RAYS = "rays"
"""Visibility found by casting rays at the mesh."""
HULL = "hull"
"""Visibility by the rule of `cadalign.evaluation.instances.hull`, without a mesh."""


@dataclass(frozen=True, eq=False)
class Instance:
    """One view of a model, and what a method is given to align.

    The image shows the model as it is. The method gets the same model stretched along y and z by
    factors it does not know, so the true scale is one over them.

    Parameters
    ----------
    cam_from_model : Alignment
        The pose of the model as the image shows it.
    points_3d : (n, 3) float
        The visible keypoints of the stretched model.
    points_2d : (n, 2) float
        Their noisy observations [px].
    bounds : (2, 3) float
        Lowest and highest coordinates of the stretched model; of its keypoints without a mesh.
    gt : Alignment
        The truth: pose, and the scale that undoes the stretch.
    visibility : {"rays", "hull"}
        Rule by which keypoints count as seen.
    scene : Scene, optional
        The model as the image shows it; None without a mesh.
    diagonal : float
        Of the bounding box of the model as the image shows it [model units]. Without a mesh it is
        taken as 1, to which KeypointNet's models are normalised.
    """

    camera: Camera
    cam_from_model: Alignment
    points_3d: FloatArray
    points_2d: FloatArray
    semantic_ids: IntArray
    bounds: FloatArray
    gt: Alignment
    visibility: str
    scene: Scene | None
    diagonal: float

    @cached_property
    def gt_box(self) -> Box:
        """The true box."""
        return Box.from_model(self.bounds, self.gt)


def load_scene(model: AnnotatedModel) -> Scene:
    """Read a model's mesh for `make_instance`."""
    from cadalign.datasets import check_solid
    from cadalign.render import Scene

    mesh = model.load_mesh()
    check_solid(mesh)
    return Scene(mesh)


def make_instance(
    model: AnnotatedModel,
    *,
    noise_px: float,
    min_visible: int,
    seed: int,
    view_index: int,
    scene: Scene,
) -> Instance:
    """Draw a view, a stretch and keypoint noise [px] for an annotated model with a mesh.

    Everything random follows from (seed, category, model id, view index). The scene is the
    model's, as `load_scene` gives it.
    """
    from cadalign.render import sample_view

    rng = instance_rng(seed, model.category, model.model_id, str(view_index))
    xyz = model.keypoints.xyz
    view = sample_view(scene, xyz, KEYPOINT_CAMERA, rng=rng, min_visible=min_visible)
    return _stretched(
        xyz,
        model.keypoints.semantic_ids,
        view.visible,
        cam_from_model=view.cam_from_model,
        bounds=scene.bounds,
        noise_px=noise_px,
        rng=rng,
        visibility=RAYS,
        scene=scene,
    )


def make_hull_instance(
    hull: KeypointHull,
    semantic_ids: IntArray,
    *,
    names: tuple[str, str],
    noise_px: float,
    min_visible: int,
    seed: int,
    view_index: int,
) -> Instance:
    """Draw a view, a stretch and keypoint noise, as `make_instance`, for a model without a mesh.

    Which keypoints are seen, and the model's box, follow from the keypoints alone; see
    `cadalign.evaluation.instances.hull`. ``names`` are category and model id.
    """
    rng = instance_rng(seed, *names, str(view_index))
    pose, visible = sample_hull_view(hull, KEYPOINT_CAMERA, rng=rng, min_visible=min_visible)
    return _stretched(
        hull.xyz,
        semantic_ids,
        visible,
        cam_from_model=pose,
        bounds=hull.bounds,
        noise_px=noise_px,
        rng=rng,
        visibility=HULL,
        scene=None,
    )


def _stretched(
    xyz: FloatArray,
    semantic_ids: IntArray,
    visible: npt.NDArray[np.bool_],
    *,
    cam_from_model: Alignment,
    bounds: FloatArray,
    noise_px: float,
    rng: np.random.Generator,
    visibility: str,
    scene: Scene | None,
) -> Instance:
    """The instance of a view, with a stretch and noise drawn for it."""
    stretch = np.array([1.0, *rng.uniform(*STRETCH_RANGE, 2)])
    seen = xyz[visible]
    in_camera = seen @ cam_from_model.linear.T + cam_from_model.translation
    projected = KEYPOINT_CAMERA.pixels_from_normalized(perspective(in_camera))
    return Instance(
        camera=KEYPOINT_CAMERA,
        cam_from_model=cam_from_model,
        points_3d=seen * stretch,
        points_2d=projected + noise_px * rng.standard_normal(projected.shape),
        semantic_ids=semantic_ids[visible],
        bounds=bounds * stretch,
        gt=Alignment(
            cam_from_model.rotation, cam_from_model.translation, 1 / stretch, is_valid=True
        ),
        visibility=visibility,
        scene=scene,
        diagonal=1.0 if scene is None else float(np.linalg.norm(np.ptp(bounds, axis=0))),
    )
