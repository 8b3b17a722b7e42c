"""Evidence beside keypoints: errors, how near they come to the Cramer-Rao bound, and masks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import cv2
import numpy as np

from benchmarks import section
from benchmarks.section import BenchmarkData, Row, Tables
from cadalign import Alignment, Model, Result, View, align
from cadalign.arrays import BoolArray, FloatArray, IntArray, instance_rng
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
_LEAST_FREE = 3  # keypoints of a view that moved in an unknown way
_DRAWS = 1000  # of an ideal estimator's errors
_WANDER = 2.0  # [px], standard deviation of a smoothed contour
_WANDER_LENGTH = 5.0  # [px], over which it wanders
_HIDDEN = 0.25  # share of the area
_ALL = ("mask", "depth", "gravity", "length", "views-2")
_KINDS = (
    *("keypoints", "gravity", "length", "depth", "views-2-free", "views-5-free"),
    *("views-2", "views-5", "mask", "mask-dilated", "mask-hidden", "mask-smoothed", "all"),
)


def evidence(given: BenchmarkData) -> Tables:
    """Medians with keypoints alone, and with further evidence.

    Each view shows a model with a mesh as it is; the alignment gets its visible keypoints with
    noise of 1 px and the model stretched by factors from 0.5 to 2 along y and z. The last column is
    the ratio of the rotation error to that of an ideal estimator, from the inverse of the Fisher
    information of the view without noise; masks, whose noise is estimated from themselves, have
    none.

    Kinds are keypoints alone, these and one kind of evidence, and all: mask, depth, gravity, length
    and two views. Views with -free have an unknown motion.
    """
    dataset = KeypointNet(given.folder("keypointnet")).subset(with_mesh=True)
    drawn = [
        (
            section.attempt(draw_object, model, view, noise=1.0, seed=given.seed),
            section.attempt(draw_object, model, view, noise=0.0, seed=given.seed),
        )
        for model in dataset
        for view in range(given.count or 8)
    ]
    seen = [each for each in drawn if None not in each]
    rows = []
    for kind in _KINDS:
        found = [(noisy, section.attempt(_measured, kind, noisy, ideal)) for noisy, ideal in seen]
        solved = [row for _, row in found if row is not None]
        bottles = [row["box IoU"] for each, row in found if row and each.category == "bottle"]
        medians = section.summary(solved)
        rows.append({"evidence": kind, **medians, "of bottles": float(np.median(bottles))})
    yield f"evidence beside keypoints, {len(seen)} views: medians", rows


class Shot(NamedTuple):
    """One camera's image."""

    cam_from_first: FloatArray  # (4, 4), motion of the camera
    rows: IntArray  # (n,), the visible keypoints
    points_2d: FloatArray  # (n, 2), with noise [px]
    depths: FloatArray  # (n,), with noise [model units]
    up: FloatArray  # (3,), with noise


@dataclass(frozen=True, eq=False)
class SeenObject:
    """An object before several cameras, and its stretched model."""

    category: str
    instance: Instance  # in the first camera
    model: Model  # the stretched model with its mesh
    shots: tuple[Shot, ...]
    height: float  # of the object, with noise [model units]
    rng_of: Callable[..., np.random.Generator]  # streams by name

    def mask(self, damage: str = "exact") -> BoolArray:
        """The object's mask in the first camera; see `damaged_mask`."""
        shown = self.instance.scene, KEYPOINT_CAMERA, self.instance.cam_from_model
        return damaged_mask(cast_geometry(*shown).mask, damage, self.rng_of(damage))


def draw_object(model: AnnotatedModel, view: int, *, noise: float, seed: int) -> SeenObject:
    """Draw a view of a model, its stretch, the other cameras, and the noise of everything.

    Everything random follows from (seed, category, model id, view). The cameras turn about the
    vertical axis of the first one through the centre of the object's box. ``noise`` is that of the
    keypoints [px], and a factor on all other.
    """
    rng_of = partial(instance_rng, seed, model.category, model.model_id, str(view))
    how: Row = {"noise_px": noise, "min_visible": _LEAST_KEYPOINTS, "seed": seed}
    instance = make_instance(model, view_index=view, scene=scene_of(model), **how)
    shown, pose, stretch = instance.scene, instance.cam_from_model, 1 / instance.gt.scale
    rng = rng_of("evidence")
    centre = pose.apply(shown.bounds.mean(axis=0)[None])[0]
    shots = []
    for place in _TURNS:
        motion = np.eye(4)
        motion[:3, :3] = rotation_from_vector(np.radians([0.0, place * _TURN_DEG, 0.0]))
        motion[:3, 3] = centre - motion[:3, :3] @ centre
        shots.append(_shoot(instance, model.keypoints.xyz, motion, rng, noise))
    off = noise * _LENGTH_SIGMA * rng.standard_normal()
    return SeenObject(
        category=model.category,
        instance=instance,
        model=Model(
            points_3d=model.keypoints.xyz * stretch,
            bounds=instance.bounds,
            mesh=Mesh(shown.mesh.vertices * stretch, shown.mesh.faces),
        ),
        shots=tuple(shots),
        height=float(np.ptp(shown.bounds[:, 1]) * (1 + off)),
        rng_of=rng_of,
    )


def _shoot(
    instance: Instance, xyz: FloatArray, motion: FloatArray, rng: np.random.Generator, noise: float
) -> Shot:
    pose = moved(instance.cam_from_model, motion)
    of_pixels = noise * rng.standard_normal((len(xyz), 2))
    of_depths = noise * _DEPTH_SIGMA * rng.standard_normal(len(xyz))
    about = noise * np.radians(_UP_SIGMA_DEG) * rng.standard_normal(2)
    rows = np.flatnonzero(visible_keypoints(instance.scene, xyz, KEYPOINT_CAMERA, pose))
    in_camera = pose.apply(xyz[rows])
    return Shot(
        motion,
        rows,
        KEYPOINT_CAMERA.project(in_camera) + of_pixels[rows],
        in_camera[:, 2] * (1 + of_depths[rows]),
        # The model's y axis, turned about the two axes across it.
        rotation_from_vector(pose.rotation[:, [0, 2]] @ about) @ pose.rotation[:, 1],
    )


def moved(pose: Alignment, motion: FloatArray) -> Alignment:
    """A pose in the first camera as another camera has it, after its motion (4, 4)."""
    rotation, shift = motion[:3, :3], motion[:3, 3]
    return Alignment(rotation @ pose.rotation, rotation @ pose.translation + shift, pose.scale)


def aligned(kind: str, seen: SeenObject) -> Result:
    """The estimate from a kind of evidence."""
    kinds = _ALL if kind == "all" else (kind,)
    counts = [int(each.split("-")[1]) for each in kinds if each.startswith("views-")]
    shots = seen.shots[: counts[0] if counts else 1]
    is_free = kind.endswith("-free")
    if is_free:
        shots = (shots[0], *(shot for shot in shots[1:] if len(shot.rows) >= _LEAST_FREE))
    fields: dict[str, Any] = {}
    if "depth" in kinds:
        fields |= {"depth": shots[0].depths, "depth_sigma": _DEPTH_SIGMA}
    if "gravity" in kinds:
        fields |= {"up": shots[0].up, "up_sigma_deg": _UP_SIGMA_DEG}
    for each in kinds:
        if each.startswith("mask"):
            fields["mask"] = seen.mask(each.removeprefix("mask").removeprefix("-") or "exact")
    views = tuple(
        View(
            KEYPOINT_CAMERA,
            shot.points_2d,
            ids=shot.rows.tolist(),
            sigma=1.0,
            cam_from_rig=shot.cam_from_first if counts and not is_free else None,
            **({} if number else fields),
        )
        for number, shot in enumerate(shots)
    )
    size = Size(height=seen.height, sigma=_LENGTH_SIGMA) if "length" in kinds else None
    return align(seen.model, views, size=size)


def _measured(kind: str, noisy: SeenObject, ideal: SeenObject) -> Row:
    instance = noisy.instance
    est, gt = aligned(kind, noisy).alignment, instance.gt
    errors = alignment_errors(est=est, gt=gt, length=instance.diagonal)
    est_box, gt_box = (Box.from_model(instance.bounds, each) for each in (est, gt))
    row: Row = {
        "R, deg": errors["rotation_error_deg"],
        "t": errors["translation_error"],
        "s_y, %": 100 * errors["scale_y_error"],
        "s_z, %": 100 * errors["scale_z_error"],
        "box IoU": overlap(est=est_box, gt=gt_box),
    }
    if "mask" in kind or kind == "all":
        return row
    bound = aligned(kind, ideal).fisher_covariance
    drawn = noisy.rng_of("bound").multivariate_normal(np.zeros(9), bound, _DRAWS, method="eigh")
    turn = float(np.median(np.degrees(np.linalg.norm(drawn[:, :3], axis=1))))
    return row | {"R over bound": errors["rotation_error_deg"] / turn}


def damaged_mask(mask: BoolArray, kind: str, rng: np.random.Generator) -> BoolArray:
    """A mask (h, w) with a damage.

    It is exact, dilated by 2 px, smoothed (its contour wanders by 2 px), or a quarter is hidden.
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
