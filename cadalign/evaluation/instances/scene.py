"""One object before several cameras, with the noise of everything, and masks as of real photos."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.datasets import AnnotatedModel
from cadalign.errors import InputError, quote
from cadalign.estimation.model import Model
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA, load_scene, make_instance
from cadalign.evaluation.options import SceneOptions
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.render import Scene, cast_geometry, visible_keypoints
from cadalign.seeding import instance_rng

_TURNS = (0, 1, -1, 2, -2)  # places of the cameras around the object


@dataclass(frozen=True, eq=False)
class Shot:
    """One camera's image."""

    cam_from_first: FloatArray  # (4, 4), motion of the camera
    rows: IntArray  # (n,), the visible keypoints
    points_2d: FloatArray  # (n, 2), with noise [px]
    depths: FloatArray  # (n,), with noise [model units]
    up: FloatArray  # (3,), with noise


@dataclass(frozen=True, eq=False)
class ObjectScene:
    """An object, its stretched model, and shots from all cameras."""

    model: Model  # the stretched model with its mesh
    gt: Alignment  # the truth in the first camera
    shots: tuple[Shot, ...]
    height: float  # of the object, with noise [model units]
    diagonal: float  # of the object's box [model units]
    shown: Scene  # the object as it is
    cam_from_shown: Alignment  # its pose in the first camera
    names: tuple[str, ...]  # names of the instance, for its randomness
    options: SceneOptions  # the seed, and the accuracy of the evidence

    def mask(self, damage: str = "exact") -> BoolArray:
        """The object's mask in the first camera; see `damaged_mask`."""
        mask = cast_geometry(self.shown, KEYPOINT_CAMERA, self.cam_from_shown).mask
        return damaged_mask(mask, damage, instance_rng(self.options.seed, *self.names, damage))


_scene_of = lru_cache(maxsize=1)(load_scene)  # views of one model come one after another


def make_scene(model: AnnotatedModel, view: int, options: SceneOptions) -> ObjectScene:
    """Draw a view of a model, its stretch, the other cameras, and the noise of everything.

    Everything random follows from (seed, category, model id, view). The cameras turn about the
    vertical axis of the first one through the centre of the object's box.
    """
    names = (model.category, model.model_id, str(view))
    instance = make_instance(
        model,
        noise_px=options.noise_px,
        min_visible=options.min_visible,
        seed=options.seed,
        view_index=view,
        scene=_scene_of(model),
    )
    shown = instance.scene
    assert shown is not None
    stretch = 1 / instance.gt.scale
    rng = instance_rng(options.seed, *names, "evidence")
    pose = instance.cam_from_model
    centre = pose.apply(shown.bounds.mean(axis=0)[None])[0]
    shots = []
    for place in _TURNS:
        motion = _motion(centre, np.radians(place * options.turn_deg))
        moved = Alignment(
            motion[:3, :3] @ pose.rotation,
            motion[:3, :3] @ pose.translation + motion[:3, 3],
            pose.scale,
        )
        shots.append(_shoot(shown, model.keypoints.xyz, moved, motion, rng, options))
    height = float(np.ptp(shown.bounds[:, 1]) * (1 + options.length_sigma * rng.standard_normal()))
    mesh = Mesh(shown.mesh.vertices * stretch, shown.mesh.faces)
    return ObjectScene(
        model=Model(points_3d=model.keypoints.xyz * stretch, bounds=instance.bounds, mesh=mesh),
        gt=instance.gt,
        shots=tuple(shots),
        height=height,
        diagonal=instance.diagonal,
        shown=shown,
        cam_from_shown=pose,
        names=names,
        options=options,
    )


def _motion(centre: FloatArray, angle: float) -> FloatArray:
    """Motion (4, 4) of a camera about a point in the first camera's frame."""
    motion = np.eye(4)
    motion[:3, :3] = rotation_from_vector(np.array([0.0, angle, 0.0]))
    motion[:3, 3] = centre - motion[:3, :3] @ centre
    return motion


def _shoot(
    shown: Scene,
    xyz: FloatArray,
    pose: Alignment,
    motion: FloatArray,
    rng: np.random.Generator,
    options: SceneOptions,
) -> Shot:
    noise, of_depths = rng.standard_normal((len(xyz), 2)), rng.standard_normal(len(xyz))
    about = rng.standard_normal(2)
    rows = np.flatnonzero(visible_keypoints(shown, xyz, KEYPOINT_CAMERA, pose))
    in_camera = pose.apply(xyz[rows])
    # The model's y axis, turned about the two axes across it.
    turn = np.radians(options.up_sigma_deg) * (pose.rotation[:, [0, 2]] @ about)
    return Shot(
        motion,
        rows,
        KEYPOINT_CAMERA.project(in_camera) + options.noise_px * noise[rows],
        in_camera[:, 2] * (1 + options.depth_sigma * of_depths[rows]),
        rotation_from_vector(turn) @ pose.rotation[:, 1],
    )


def truth_in(shot: Shot, gt: Alignment) -> Alignment:
    """The truth in the camera of a shot."""
    rotation, shift = shot.cam_from_first[:3, :3], shot.cam_from_first[:3, 3]
    return Alignment(rotation @ gt.rotation, rotation @ gt.translation + shift, gt.scale)


DAMAGES = ("exact", "dilated", "eroded", "smoothed", "hidden", "hole", "blob")
"""Kinds of masks: without damage; with a contour 2 px outside or inside; with a contour that
wanders by 2 px; a quarter hidden by a rectangle; with a hole; with a blob of the background."""

_SHIFT = 2  # [px], of a dilated or eroded contour
_WANDER = 2.0  # [px], standard deviation of a smoothed contour
_WANDER_LENGTH = 5.0  # [px], over which it wanders
_HIDDEN = 0.25  # share of the area
_SIZE = 0.13  # radius of holes and blobs, relative to the root of the area


def damaged_mask(mask: npt.ArrayLike, kind: str, rng: np.random.Generator) -> BoolArray:
    """A mask (h, w) with a damage of one of the kinds `DAMAGES`.

    Raises InputError if the kind is unknown.
    """
    pixels = np.asarray(mask).astype(np.uint8)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _SHIFT + 1, 2 * _SHIFT + 1))
    if kind == "exact":
        return pixels > 0
    if kind == "dilated":
        return np.asarray(cv2.dilate(pixels, disc) > 0)
    if kind == "eroded":
        return np.asarray(cv2.erode(pixels, disc) > 0)
    if kind == "smoothed":
        return _wandering(pixels, rng)
    if kind == "hidden":
        return _hidden(pixels, rng)
    if kind == "hole":
        return _with_disc(pixels, np.argwhere(pixels > 0), 0, rng)
    if kind == "blob":
        edge = (pixels > 0) & (cv2.erode(pixels, np.ones((3, 3), np.uint8)) == 0)
        return _with_disc(pixels, np.argwhere(edge), 1, rng)
    raise InputError(f"{quote(kind)} is none of {', '.join(DAMAGES)}", where="kind")


def _wandering(pixels: npt.NDArray[np.uint8], rng: np.random.Generator) -> BoolArray:
    inside = cv2.distanceTransform(pixels, cv2.DIST_L2, 5)
    outside = cv2.distanceTransform(1 - pixels, cv2.DIST_L2, 5)
    field = cv2.GaussianBlur(rng.normal(size=pixels.shape), (0, 0), _WANDER_LENGTH)
    return np.asarray(inside - outside + field * (_WANDER / field.std()) > 0)


def _hidden(pixels: npt.NDArray[np.uint8], rng: np.random.Generator) -> BoolArray:
    """The mask without all that lies beyond a line of pixels, at a random side."""
    turns = int(rng.integers(4))
    turned = np.rot90(pixels, turns)
    shares = np.cumsum(turned.sum(axis=1)) / turned.sum()
    rest = turned.copy()
    rest[: int(np.searchsorted(shares, _HIDDEN)) + 1] = 0
    return np.rot90(rest, -turns) > 0


def _with_disc(
    pixels: npt.NDArray[np.uint8],
    centres: npt.NDArray[np.int64],
    value: int,
    rng: np.random.Generator,
) -> BoolArray:
    row, column = centres[rng.integers(len(centres))].tolist()
    drawn = pixels.copy()
    radius = round(_SIZE * float(np.sqrt(pixels.sum())))
    cv2.circle(drawn, (column, row), radius, value, thickness=-1)
    return drawn > 0
