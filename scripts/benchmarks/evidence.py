"""Evidence beside keypoints: errors, and how near they come to the Cramer-Rao bound."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple
from unittest.mock import patch

import cv2
import numpy as np

from benchmarks import section
from benchmarks.section import BenchmarkData, Row, Tables
from cadalign import Alignment, Model, Result, View, align
from cadalign.arrays import BoolArray, FloatArray, IntArray, instance_rng
from cadalign.datasets import AnnotatedModel, KeypointNet
from cadalign.estimation import joint
from cadalign.estimation.estimates import pose_and_lengths
from cadalign.evaluation.instances.instance import (
    KEYPOINT_CAMERA,
    Instance,
    make_instance,
    scene_of,
)
from cadalign.evaluation.metrics.cramer_rao import cramer_rao_bound
from cadalign.evaluation.metrics.errors import alignment_errors, overlap
from cadalign.geometry.alignment import Box
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.io.evidence import Size
from cadalign.render import cast_geometry, visible_keypoints
from cadalign.solvers.constants import LINEAR
from cadalign.solvers.joint.covariance import joint_covariance, pose_and_border
from cadalign.solvers.joint.evidence import Evidence, State

Weighed = tuple[Evidence, State]

_DEPTH_SIGMA = 0.005  # relative
_UP_SIGMA_DEG = 1.0
_LENGTH_SIGMA = 0.01  # relative
_TURN_DEG = 25.0  # about the object, between neighbouring cameras
_TURNS = (0, 1, -1, 2, -2)  # places of the cameras around the object
_LEAST_KEYPOINTS = 6
_LEAST_FREE = 3  # keypoints of a view that moved in an unknown way
_DRAWS = 1000  # of an ideal estimator's errors

DAMAGES = ("exact", "dilated", "eroded", "smoothed", "hidden", "hole", "blob")
"""Kinds of masks: without damage; with a contour 2 px outside or inside; with a contour that
wanders by 2 px; a quarter hidden by a rectangle; with a hole; with a blob of the background."""
_ALL = ("mask", "depth", "gravity", "length", "views-2")
_USUAL = (
    *("keypoints", "gravity", "length", "depth", "views-2-free", "views-5-free"),
    *("views-2", "views-5", "mask", "mask-dilated", "mask-hidden", "mask-smoothed", "all"),
)


def evidence(
    given: BenchmarkData, *, views: int = 8, kinds: tuple[str, ...] = _USUAL, noise_px: float = 1.0
) -> Tables:
    """Medians with keypoints alone, and with further evidence.

    Each view shows a model with a mesh as it is; the alignment gets its visible keypoints with
    noise and the model stretched by factors from 0.5 to 2 along y and z. The last column is the
    ratio of the rotation error to that of an ideal estimator, from the bound of each view.

    Parameters
    ----------
    views : int
        Views of every model.
    kinds : tuple[str, ...]
        keypoints: these alone; gravity, length (the height), depth (of the keypoints), mask (of the
        first view): these and one kind of evidence; views-2, views-5: views with known camera
        motion, views-2-free, views-5-free with unknown motion; mask- with a name of `DAMAGES`; all:
        mask, depth, gravity, length, and two views.
    noise_px : float
        Noise of the keypoints.
    """
    dataset = KeypointNet(given.needed()).subset(with_mesh=True)
    draw = partial(section.attempt, draw_object, noise_px=noise_px, seed=given.seed)
    drawn = [draw(model, view) for model in dataset for view in range(views)]
    seen = [each for each in drawn if each is not None]
    rows = []
    for kind in kinds:
        found = [(each, section.attempt(_measured, kind, each)) for each in seen]
        solved = [row for _, row in found if row is not None]
        bottles = [row["box IoU"] for each, row in found if row and each.names[0] == "bottle"]
        count = {"evidence": kind, "views": len(found), "failed": len(found) - len(solved)}
        medians = {name: float(np.median([row[name] for row in solved])) for name in solved[0]}
        of_bottles = {"IoU of bottles": float(np.median(bottles)) if bottles else None}
        rows.append(count | medians | of_bottles)
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

    source: AnnotatedModel
    instance: Instance  # in the first camera
    model: Model  # the stretched model with its mesh
    shots: tuple[Shot, ...]
    height: float  # of the object, with noise [model units]
    sigma: float  # of the keypoints [px]
    rng_of: Callable[..., np.random.Generator]  # streams by name

    @property
    def names(self) -> tuple[str, str]:
        """Category and model."""
        return self.source.category, self.source.model_id

    def mask(self, damage: str = "exact") -> BoolArray:
        """The object's mask in the first camera; see `damaged_mask`."""
        shown = self.instance.scene, KEYPOINT_CAMERA, self.instance.cam_from_model
        return damaged_mask(cast_geometry(*shown).mask, damage, self.rng_of(damage))


def draw_object(model: AnnotatedModel, view: int, *, noise_px: float, seed: int) -> SeenObject:
    """Draw a view of a model, its stretch, the other cameras, and the noise of everything.

    Everything random follows from (seed, category, model id, view). The cameras turn about the
    vertical axis of the first one through the centre of the object's box.
    """
    rng_of = partial(instance_rng, seed, model.category, model.model_id, str(view))
    how: Row = {"noise_px": noise_px, "min_visible": _LEAST_KEYPOINTS, "seed": seed}
    instance = make_instance(model, view_index=view, scene=scene_of(model), **how)
    shown, pose, stretch = instance.scene, instance.cam_from_model, 1 / instance.gt.scale
    rng = rng_of("evidence")
    centre = pose.apply(shown.bounds.mean(axis=0)[None])[0]
    shots = []
    for place in _TURNS:
        motion = np.eye(4)
        motion[:3, :3] = rotation_from_vector(np.radians([0.0, place * _TURN_DEG, 0.0]))
        motion[:3, 3] = centre - motion[:3, :3] @ centre
        shots.append(_shoot(instance, model.keypoints.xyz, motion, rng, noise_px))
    return SeenObject(
        source=model,
        instance=instance,
        model=Model(
            points_3d=model.keypoints.xyz * stretch,
            bounds=instance.bounds,
            mesh=Mesh(shown.mesh.vertices * stretch, shown.mesh.faces),
        ),
        shots=tuple(shots),
        height=float(np.ptp(shown.bounds[:, 1]) * (1 + _LENGTH_SIGMA * rng.standard_normal())),
        sigma=noise_px or 1.0,
        rng_of=rng_of,
    )


def _shoot(
    instance: Instance,
    xyz: FloatArray,
    motion: FloatArray,
    rng: np.random.Generator,
    noise_px: float,
) -> Shot:
    pose = moved(instance.cam_from_model, motion)
    noise, of_depths = rng.standard_normal((len(xyz), 2)), rng.standard_normal(len(xyz))
    about = rng.standard_normal(2)
    rows = np.flatnonzero(visible_keypoints(instance.scene, xyz, KEYPOINT_CAMERA, pose))
    in_camera = pose.apply(xyz[rows])
    # The model's y axis, turned about the two axes across it.
    turn = np.radians(_UP_SIGMA_DEG) * (pose.rotation[:, [0, 2]] @ about)
    return Shot(
        motion,
        rows,
        KEYPOINT_CAMERA.project(in_camera) + noise_px * noise[rows],
        in_camera[:, 2] * (1 + _DEPTH_SIGMA * of_depths[rows]),
        rotation_from_vector(turn) @ pose.rotation[:, 1],
    )


def moved(pose: Alignment, motion: FloatArray) -> Alignment:
    """A pose in the first camera as another camera has it, after its motion (4, 4)."""
    rotation, shift = motion[:3, :3], motion[:3, 3]
    return Alignment(rotation @ pose.rotation, rotation @ pose.translation + shift, pose.scale)


class Given(NamedTuple):
    """Arguments of `align`, and the shots that they are of."""

    views: tuple[View, ...]
    shots: tuple[Shot, ...]
    size: Size | None


def evidence_for(kind: str, seen: SeenObject) -> Given:
    """The views and the size of a kind of evidence."""
    kinds = _ALL if kind == "all" else (kind,)
    counts = [int(each.split("-")[1]) for each in kinds if each.startswith("views-")]
    shots = seen.shots[: counts[0] if counts else 1]
    is_free = kind.endswith("-free")
    if is_free:
        shots = (shots[0], *(shot for shot in shots[1:] if len(shot.rows) >= _LEAST_FREE))
    first = _of_first(kinds, seen)
    views = tuple(
        View(
            KEYPOINT_CAMERA,
            shot.points_2d,
            ids=shot.rows.tolist(),
            sigma=seen.sigma,
            cam_from_rig=shot.cam_from_first if counts and not is_free else None,
            **({} if number else first),
        )
        for number, shot in enumerate(shots)
    )
    size = Size(height=seen.height, sigma=_LENGTH_SIGMA) if "length" in kinds else None
    return Given(views, shots, size)


def _of_first(kinds: tuple[str, ...], seen: SeenObject) -> dict[str, Any]:
    shot = seen.shots[0]
    fields: dict[str, Any] = {}
    if "depth" in kinds:
        fields |= {"depth": shot.depths, "depth_sigma": _DEPTH_SIGMA}
    if "gravity" in kinds:
        fields |= {"up": shot.up, "up_sigma_deg": _UP_SIGMA_DEG}
    for kind in kinds:
        if kind.startswith("mask"):
            fields["mask"] = seen.mask(kind.removeprefix("mask").removeprefix("-") or "exact")
    return fields


def _measured(kind: str, seen: SeenObject) -> Row:
    given, instance = evidence_for(kind, seen), seen.instance
    wall, _, (result, weighed) = section.clocked(partial(aligned, seen.model, given))
    est, gt = result.alignment, instance.gt
    errors = alignment_errors(est=est, gt=gt, length=instance.diagonal)
    bound = bound_of(weighed, given, seen)
    drawn = seen.rng_of("bound").multivariate_normal(np.zeros(9), bound, size=_DRAWS, method="eigh")
    ideal = float(np.median(np.degrees(np.linalg.norm(drawn[:, :3], axis=1))))
    est_box, gt_box = (Box.from_model(instance.bounds, each) for each in (est, gt))
    return {
        "R": errors["rotation_error_deg"],
        "t": errors["translation_error"],
        "s_y, %": 100 * errors["scale_y_error"],
        "s_z, %": 100 * errors["scale_z_error"],
        "box IoU": overlap(est=est_box, gt=gt_box),
        "R over bound": errors["rotation_error_deg"] / ideal,
        "ms": 1e3 * wall,
    }


def aligned(model: Model, given: Given) -> tuple[Result, Weighed | None]:
    """The estimate, and the evidence and state that it states; None for one view's keypoints."""
    with patch.object(joint, "summaries_of", wraps=joint.summaries_of) as stated:
        result = align(model, given.views, size=given.size)
    return result, stated.call_args and stated.call_args.args[:2]


def bound_of(weighed: Weighed | None, given: Given, seen: SeenObject) -> FloatArray:
    """The Cramer-Rao bound (9, 9) of an estimate from such evidence, as `Result.covariance`.

    Contours have the measured standard deviation.
    """
    gt = seen.instance.gt
    if weighed is None:
        points = np.asarray(seen.model.points_3d)[given.shots[0].rows]
        return cramer_rao_bound(points, KEYPOINT_CAMERA, gt, sigma=seen.sigma, focal="known")
    evidence, state = weighed
    linear = np.full_like(evidence.sightings.loss, LINEAR)
    known = evidence._replace(sightings=evidence.sightings._replace(loss=linear))
    truths = [moved(gt, shot.cam_from_first) for shot in given.shots[: len(state.poses)]]
    poses = np.array([[*each.rotation.ravel(), *each.translation] for each in truths])
    true_state = state._replace(poses=poses, log_scales=np.log(gt.scale))
    unknowns = pose_and_border(joint_covariance(known, true_state), 0)
    return pose_and_lengths(known, true_state, unknowns)


# Masks ---------------------------------------------------------------------------------

_SHIFT = 2  # [px], of a dilated or eroded contour
_WANDER = 2.0  # [px], standard deviation of a smoothed contour
_WANDER_LENGTH = 5.0  # [px], over which it wanders
_HIDDEN = 0.25  # share of the area
_SIZE = 0.13  # radius of holes and blobs, relative to the root of the area


def damaged_mask(mask: np.ndarray, kind: str, rng: np.random.Generator) -> BoolArray:
    """A mask (h, w) with a damage of one of the kinds `DAMAGES`."""
    pixels = mask.astype(np.uint8)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _SHIFT + 1, 2 * _SHIFT + 1))
    match kind:
        case "exact":
            return pixels > 0
        case "dilated":
            return np.asarray(cv2.dilate(pixels, disc) > 0)
        case "eroded":
            return np.asarray(cv2.erode(pixels, disc) > 0)
        case "smoothed":
            return _wandering(pixels, rng)
        case "hidden":
            return _hidden(pixels, rng)
        case "hole":
            return _with_disc(pixels, np.argwhere(pixels > 0), 0, rng)
        case "blob":
            edge = (pixels > 0) & (cv2.erode(pixels, np.ones((3, 3), np.uint8)) == 0)
            return _with_disc(pixels, np.argwhere(edge), 1, rng)
    raise ValueError(f"{kind} is none of {', '.join(DAMAGES)}")


def _wandering(pixels: np.ndarray, rng: np.random.Generator) -> BoolArray:
    inside = cv2.distanceTransform(pixels, cv2.DIST_L2, 5)
    outside = cv2.distanceTransform(1 - pixels, cv2.DIST_L2, 5)
    field = cv2.GaussianBlur(rng.normal(size=pixels.shape), (0, 0), _WANDER_LENGTH)
    return np.asarray(inside - outside + field * (_WANDER / field.std()) > 0)


def _hidden(pixels: np.ndarray, rng: np.random.Generator) -> BoolArray:
    """The mask without all that lies beyond a line of pixels, at a random side."""
    turns = int(rng.integers(4))
    turned = np.rot90(pixels, turns)
    shares = np.cumsum(turned.sum(axis=1)) / turned.sum()
    rest = turned.copy()
    rest[: int(np.searchsorted(shares, _HIDDEN)) + 1] = 0
    return np.rot90(rest, -turns) > 0


def _with_disc(
    pixels: np.ndarray,
    centres: np.ndarray,
    value: int,
    rng: np.random.Generator,
) -> BoolArray:
    row, column = centres[rng.integers(len(centres))].tolist()
    drawn = pixels.copy()
    radius = round(_SIZE * float(np.sqrt(pixels.sum())))
    cv2.circle(drawn, (column, row), radius, value, thickness=-1)
    return drawn > 0
