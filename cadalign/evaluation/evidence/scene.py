"""One object before several cameras: the truth, the evidence that methods get, and its bound."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray
from cadalign.datasets import AnnotatedModel
from cadalign.estimation.align import align
from cadalign.estimation.estimates import pose_and_border, pose_and_lengths
from cadalign.estimation.model import Model
from cadalign.estimation.result import Result
from cadalign.estimation.view import View
from cadalign.evaluation.accuracy.cramer_rao import cramer_rao_bound
from cadalign.evaluation.accuracy.masks import damaged_mask
from cadalign.evaluation.evidence.options import (
    COMBINED,
    DAMAGED,
    DEPTH,
    GRAVITY,
    LENGTH,
    MASK,
    METHODS,
    VIEWS_FREE,
    VIEWS_KNOWN,
    EvidenceRunOptions,
)
from cadalign.evaluation.instances.instance import KEYPOINT_CAMERA, load_scene, make_instance
from cadalign.evaluation.methods.method import Method
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.io.evidence import Size
from cadalign.render import Scene, cast_geometry, visible_keypoints
from cadalign.seeding import instance_rng
from cadalign.solvers.constants import LINEAR
from cadalign.solvers.joint.covariance import joint_covariance

_TURNS = (0, 1, -1, 2, -2)  # places of the cameras around the object


@dataclass(frozen=True, eq=False)
class Shot:
    """One camera's image.

    Parameters
    ----------
    cam_from_first : (4, 4) float
        Motion of the camera.
    rows : (n,) int
        The visible keypoints.
    points_2d : (n, 2) float
        With noise [px].
    depths : (n,) float
        With noise [model units].
    up : (3,) float
        With noise.
    """

    cam_from_first: FloatArray
    rows: IntArray
    points_2d: FloatArray
    depths: FloatArray
    up: FloatArray


@dataclass(frozen=True, eq=False)
class ObjectScene:
    """An object, its stretched model, and shots from all cameras.

    Parameters
    ----------
    model : Model
        The stretched model with its mesh.
    gt : Alignment
        The truth in the first camera.
    shots : tuple of Shot
    height : float
        Of the object, with noise [model units].
    diagonal : float
        Of the object's box [model units].
    shown : Scene
        The object as it is.
    cam_from_shown : Alignment
        Its pose in the first camera.
    names : tuple of str
        Of the instance, for its randomness.
    seed : int
    """

    model: Model
    gt: Alignment
    shots: tuple[Shot, ...]
    height: float
    diagonal: float
    shown: Scene
    cam_from_shown: Alignment
    names: tuple[str, ...]
    seed: int

    def mask(self, damage: str = "exact") -> BoolArray:
        """The object's mask in the first camera; see `damaged_mask`."""
        mask = cast_geometry(self.shown, KEYPOINT_CAMERA, self.cam_from_shown).mask
        return damaged_mask(mask, damage, instance_rng(self.seed, *self.names, damage))


_scene_of = lru_cache(maxsize=1)(load_scene)  # views of one model come one after another


def make_scene(model: AnnotatedModel, view: int, options: EvidenceRunOptions) -> ObjectScene:
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
        seed=options.seed,
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
    options: EvidenceRunOptions,
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


EVERYTHING = "all"
"""The method that gives evidence of each kind."""
_LEAST_FREE = 3  # keypoints of a view that moved in an unknown way


@dataclass(frozen=True, eq=False)
class Given:
    """Arguments of `align`, and the shots that they are of."""

    views: tuple[View, ...]
    shots: tuple[Shot, ...]
    size: Size | None


@dataclass(frozen=True, eq=False)
class EvidenceInstance:
    """A scene, and the accuracy of its evidence."""

    scene: ObjectScene
    options: EvidenceRunOptions


@dataclass(frozen=True, eq=False)
class EvidenceEstimate:
    """An estimate, and what it was made from, unless a registered function made it."""

    answer: Alignment | Result
    given: Given | None

    @property
    def alignment(self) -> Alignment:
        """The estimated alignment."""
        return self.answer if isinstance(self.answer, Alignment) else self.answer.alignment


def align_with(method: str, instance: EvidenceInstance) -> EvidenceEstimate:
    """Align the scene's model with the evidence that a method gives."""
    given = evidence_for(method, instance)
    return EvidenceEstimate(align(instance.scene.model, given.views, size=given.size), given)


OWN_METHODS = {name: Method(name, partial(align_with, name)) for name in METHODS}
"""The experiment's methods by name: each is `align` with some evidence."""


def evidence_for(method: str, instance: EvidenceInstance) -> Given:
    """The views and the size that a method gives."""
    scene, options = instance.scene, instance.options
    kinds = COMBINED.get(method, (method,))
    count = next((VIEWS_KNOWN[kind] for kind in kinds if kind in VIEWS_KNOWN), 1)
    shots = scene.shots[:count]
    if method in VIEWS_FREE:
        shots = tuple(
            shot
            for number, shot in enumerate(scene.shots[: VIEWS_FREE[method]])
            if number == 0 or len(shot.rows) >= _LEAST_FREE
        )
    views = tuple(
        View(
            KEYPOINT_CAMERA,
            shot.points_2d,
            ids=shot.rows.tolist(),
            sigma=options.noise_px or 1.0,
            cam_from_rig=shot.cam_from_first if count > 1 else None,
            **(_of_first(kinds, scene, options) if number == 0 else {}),
        )
        for number, shot in enumerate(shots)
    )
    size = Size(height=scene.height, sigma=options.length_sigma) if LENGTH in kinds else None
    return Given(views, shots, size)


def bound_of(result: Result, given: Given, scene: ObjectScene) -> FloatArray:
    """The Cramer-Rao bound (9, 9) of an estimate from such evidence, as `Result.covariance`.

    Contours have the deviation that was measured.
    """
    basis = result.statistics.basis
    if basis is None:
        (view,), (shot,) = given.views, given.shots
        points = np.asarray(scene.model.points_3d)[shot.rows]
        assert view.sigma is not None
        return cramer_rao_bound(points, view.camera, scene.gt, sigma=view.sigma, focal="known")
    evidence, state = basis.evidence, basis.state
    loss = np.full_like(evidence.sightings.loss, LINEAR)
    evidence = evidence._replace(sightings=evidence.sightings._replace(loss=loss))
    truths = [truth_in(shot, scene.gt) for shot in given.shots[: len(state.poses)]]
    poses = [np.concatenate([each.rotation.ravel(), each.translation]) for each in truths]
    true_state = state._replace(poses=np.array(poses), log_scales=np.log(scene.gt.scale))
    unknowns = pose_and_border(joint_covariance(evidence, true_state), 0)
    return pose_and_lengths(evidence, true_state, unknowns)


def truth_in(shot: Shot, gt: Alignment) -> Alignment:
    """The truth in the camera of a shot."""
    rotation, shift = shot.cam_from_first[:3, :3], shot.cam_from_first[:3, 3]
    return Alignment(rotation @ gt.rotation, rotation @ gt.translation + shift, gt.scale)


def _of_first(
    kinds: tuple[str, ...], scene: ObjectScene, options: EvidenceRunOptions
) -> dict[str, Any]:
    """Fields of the first view beyond its keypoints."""
    shot = scene.shots[0]
    fields: dict[str, Any] = {}
    if DEPTH in kinds:
        fields |= {"depth": shot.depths, "depth_sigma": options.depth_sigma}
    if GRAVITY in kinds:
        fields |= {"up": shot.up, "up_sigma_deg": options.up_sigma_deg}
    for kind in kinds:
        if kind == MASK or kind in DAMAGED:
            fields["mask"] = scene.mask(DAMAGED.get(kind, "exact"))
    return fields
