"""Errors with evidence beside keypoints, relative to the Cramer-Rao bound."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain

import cv2
import numpy as np

from benchmarks import section
from benchmarks.section import BenchmarkData, Row, Tables
from cadalign import Alignment, Model, Result, View, align
from cadalign.arrays import BoolArray, FloatArray, instance_rng
from cadalign.datasets import AnnotatedModel, KeypointNet
from cadalign.evaluation.instances.instance import (
    KEYPOINT_CAMERA,
    Instance,
    make_instance,
    scene_of,
)
from cadalign.evaluation.metrics.errors import alignment_errors, overlap
from cadalign.geometry.alignment import Box
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.io.evidence import Size
from cadalign.render import cast_geometry, visible_keypoints

_DEPTH_SIGMA = 0.005  # relative
_UP_SIGMA_DEG = 1.0
_LENGTH_SIGMA = 0.01  # relative
_TURN_DEG = 25.0  # about the object, between neighbouring cameras
_TURNS = (0, 1, -1, 2, -2)  # places of the cameras around the object
_LEAST_KEYPOINTS = 6
_LEAST_FREE = 3  # keypoints of a view with unknown motion
_DRAWS = 1000  # errors of an ideal estimator
_WANDER = 2.0  # [px], standard deviation of a smoothed contour
_WANDER_LENGTH = 5.0  # [px], correlation length of that noise
_HIDDEN = 0.25  # share of the area
_KINDS = (
    *("keypoints", "gravity", "length", "depth", "views-2-free", "views-5-free", "views-2"),
    *("views-5", "mask-exact", "mask-dilated", "mask-hidden", "mask-smoothed"),
)
_FIELDS = {  # fields of a view, by kind of evidence
    "depth": ("depth", "depth_sigma"),
    "gravity": ("up", "up_sigma_deg"),
    "views-2": ("cam_from_rig",),
    "views-5": ("cam_from_rig",),
}


def evidence(given: BenchmarkData) -> Tables:
    """Errors with keypoints only, and with one kind of further evidence.

    Each view shows a model with a mesh. The alignment gets the visible keypoints with 1 px of noise
    and the model stretched by factors from 0.5 to 2 along y and z. The last column is the ratio of
    the rotation error to an ideal estimator's, from the inverse Fisher information of the view
    without noise. Masks have no ratio, as their noise is estimated. Views with -free have unknown
    motion.
    """
    dataset = KeypointNet(given.folder("keypointnet")).subset(with_mesh=True)
    cases = []
    for model in dataset:
        for view in range(given.count or 8):
            draw = partial(section.attempt, draw_object, model, view, seed=given.seed)
            drawn = draw(noise=1.0), draw(noise=0.0)
            if None not in drawn:
                cases.append(({}, drawn))
    methods = {kind: partial(_measure, kind) for kind in _KINDS}
    rows = list(section.measure(cases, methods))
    yield f"evidence beside keypoints, {len(cases)} views", section.summaries(rows, "method")


@dataclass(frozen=True, eq=False)
class SeenObject:
    """An object seen by several cameras, and its stretched model."""

    category: str
    instance: Instance  # in the first camera
    model: Model  # the stretched model with its mesh
    views: tuple[View, ...]  # with depths, gravity and known motion
    height: float  # of the object, with noise [model units]
    rng_of: Callable[..., np.random.Generator]  # streams by name

    def mask(self, damage: str) -> BoolArray:
        """The object's mask in the first camera; see `damaged_mask`."""
        shown = self.instance.scene, KEYPOINT_CAMERA, self.instance.cam_from_model
        return damaged_mask(cast_geometry(*shown).mask, damage, self.rng_of(damage))


def draw_object(model: AnnotatedModel, view: int, *, noise: float, seed: int) -> SeenObject:
    """Draw a view of a model, its stretch, further cameras, and all noise.

    The result depends only on (seed, category, model id, view) and ``noise``. The cameras are
    rotated about a vertical axis through the centre of the object's box. ``noise`` is the standard
    deviation of the keypoints [px], and a factor of all other noise.
    """
    rng_of = partial(instance_rng, seed, model.category, model.model_id, str(view))
    how: Row = {"noise_px": noise, "min_visible": _LEAST_KEYPOINTS, "seed": seed}
    instance = make_instance(model, view_index=view, scene=scene_of(model), **how)
    shown, pose, stretch = instance.scene, instance.cam_from_model, 1 / instance.gt.scale
    rng = rng_of("evidence")
    centre = pose.apply(shown.bounds.mean(axis=0)[None])[0]
    views = []
    for place in _TURNS:
        motion = np.eye(4)
        motion[:3, :3] = rotation_from_vector(np.radians([0.0, place * _TURN_DEG, 0.0]))
        motion[:3, 3] = centre - motion[:3, :3] @ centre
        views.append(_view(instance, model.keypoints.xyz, motion, rng, noise))
    off = noise * _LENGTH_SIGMA * rng.standard_normal()
    return SeenObject(
        category=model.category,
        instance=instance,
        model=Model(
            points_3d=model.keypoints.xyz * stretch,
            bounds=instance.bounds,
            mesh=Mesh(shown.mesh.vertices * stretch, shown.mesh.faces),
        ),
        views=tuple(views),
        height=float(np.ptp(shown.bounds[:, 1]) * (1 + off)),
        rng_of=rng_of,
    )


def _view(
    instance: Instance, xyz: FloatArray, motion: FloatArray, rng: np.random.Generator, noise: float
) -> View:
    pose = move(instance.cam_from_model, motion)
    of_pixels = noise * rng.standard_normal((len(xyz), 2))
    of_depths = noise * _DEPTH_SIGMA * rng.standard_normal(len(xyz))
    about = noise * np.radians(_UP_SIGMA_DEG) * rng.standard_normal(2)
    rows = np.flatnonzero(visible_keypoints(instance.scene, xyz, KEYPOINT_CAMERA, pose))
    in_camera = pose.apply(xyz[rows])
    return View(
        KEYPOINT_CAMERA,
        KEYPOINT_CAMERA.project(in_camera) + of_pixels[rows],
        ids=rows.tolist(),
        depth=in_camera[:, 2] * (1 + of_depths[rows]),
        depth_sigma=_DEPTH_SIGMA,
        # The model's y axis, rotated about the other two axes.
        up=rotation_from_vector(pose.rotation[:, [0, 2]] @ about) @ pose.rotation[:, 1],
        up_sigma_deg=_UP_SIGMA_DEG,
        cam_from_rig=motion,
    )


def move(pose: Alignment, motion: FloatArray) -> Alignment:
    """Transform a pose from the first camera to another one by the motion (4, 4) between them."""
    rotation, shift = motion[:3, :3], motion[:3, 3]
    return Alignment(rotation @ pose.rotation, rotation @ pose.translation + shift, pose.scale)


def align_with(kind: str, seen: SeenObject) -> Result:
    """Estimate from keypoints and one kind of evidence."""
    count = int(kind.split("-")[1]) if kind.startswith("views") else 1
    first, *others = seen.views[:count]
    if kind.endswith("-free"):
        others = [view for view in others if len(view.ids or ()) >= _LEAST_FREE]
    fields = dict.fromkeys(chain.from_iterable(_FIELDS.values()))
    for name in _FIELDS.get(kind, ()):
        del fields[name]
    views = [replace(view, **fields) for view in (first, *others)]
    if kind.startswith("mask"):
        views = [replace(views[0], mask=seen.mask(kind.removeprefix("mask-")))]
    size = Size(height=seen.height, sigma=_LENGTH_SIGMA) if kind == "length" else None
    return align(seen.model, views, size=size)


def _measure(kind: str, drawn: tuple[SeenObject, SeenObject]) -> Row:
    (noisy, ideal), instance = drawn, drawn[0].instance
    est, gt = align_with(kind, noisy).alignment, instance.gt
    errors = alignment_errors(est=est, gt=gt, length=instance.diagonal)
    est_box, gt_box = (Box.from_model(instance.bounds, each) for each in (est, gt))
    box_iou = overlap(est=est_box, gt=gt_box)
    row: Row = {
        "R, deg": errors["rotation_error_deg"],
        "t": errors["translation_error"],
        "s_y, %": 100 * errors["scale_y_error"],
        "s_z, %": 100 * errors["scale_z_error"],
        "box IoU": box_iou,
        "of bottles": box_iou if noisy.category == "bottle" else None,
    }
    if kind.startswith("mask"):
        return row
    bound = align_with(kind, ideal).fisher_covariance
    turns = noisy.rng_of("bound").multivariate_normal(np.zeros(9), bound, _DRAWS, method="eigh")
    turn = float(np.median(np.degrees(np.linalg.norm(turns[:, :3], axis=1))))
    return row | {"R over bound": errors["rotation_error_deg"] / turn}


def damaged_mask(mask: BoolArray, kind: str, rng: np.random.Generator) -> BoolArray:
    """Damage a mask (h, w): exact, dilated (by 2 px), smoothed (contour noise of 2 px), or hidden
    (a quarter of the area).
    """
    pixels = mask.astype(np.uint8)
    if kind == "dilated":
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
        return np.asarray(cv2.dilate(pixels, disc) > 0)
    if kind == "smoothed":
        inside = cv2.distanceTransform(pixels, cv2.DIST_L2, 5)
        outside = cv2.distanceTransform(1 - pixels, cv2.DIST_L2, 5)
        field = cv2.GaussianBlur(rng.normal(size=pixels.shape), (0, 0), _WANDER_LENGTH)
        return np.asarray(inside - outside + field * (_WANDER / field.std()) > 0)
    if kind == "hidden":
        turns = int(rng.integers(4))
        rest = np.rot90(pixels, turns).copy()
        shares = np.cumsum(rest.sum(axis=1)) / rest.sum()
        rest[: int(np.searchsorted(shares, _HIDDEN)) + 1] = 0
        return np.rot90(rest, -turns) > 0
    return pixels > 0
