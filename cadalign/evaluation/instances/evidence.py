"""Keypoints with further evidence: one object before several cameras, methods, errors, bounds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from cadalign.arrays import BoolArray, FloatArray, IntArray, instance_rng
from cadalign.datasets import AnnotatedModel
from cadalign.errors import DataError, InputError, quote
from cadalign.estimation.align import align
from cadalign.estimation.estimates import pose_and_border, pose_and_lengths
from cadalign.estimation.model import Model
from cadalign.estimation.result import Result
from cadalign.estimation.view import View
from cadalign.evaluation.benchmark import VIEW_NAMES, Benchmark, Case, Setting
from cadalign.evaluation.experiments.evidence import (
    BOUNDS,
    COLUMNS,
    COMBINED,
    DAMAGED,
    DEPTH,
    GRAVITY,
    IMAGE,
    LENGTH,
    MASK,
    MASK_ALONE,
    METHODS,
    VIEWS_FREE,
    VIEWS_KNOWN,
    EvidenceRunOptions,
)
from cadalign.evaluation.instances.instance import (
    KEYPOINT_CAMERA,
    KeypointTask,
    example_view,
    make_instance,
    scene_of,
)
from cadalign.evaluation.methods.method import Method, MethodInput
from cadalign.evaluation.metrics.cramer_rao import cramer_rao_bound
from cadalign.evaluation.metrics.errors import alignment_errors, overlap
from cadalign.evaluation.runs.work import Row
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.box import Box
from cadalign.geometry.mesh import Mesh
from cadalign.geometry.metrics import nearest_truth
from cadalign.geometry.rotations import rotation_from_vector
from cadalign.geometry.symmetry import Symmetry
from cadalign.io.evidence import Size
from cadalign.io.images import ByteImage
from cadalign.render import RaycastRenderer, Scene, cast_geometry, visible_keypoints
from cadalign.solvers.constants import LINEAR
from cadalign.solvers.joint.covariance import joint_covariance

_DRAWS = 1000
EVERYTHING = "all"
"""The method that gives evidence of each kind."""
_LEAST_FREE = 3  # keypoints of a view that moved in an unknown way
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
    symmetry: Symmetry  # of the object
    cam_from_shown: Alignment  # its pose in the first camera
    names: tuple[str, ...]  # names of the instance, for its randomness
    options: EvidenceRunOptions  # the seed, and the accuracy of the evidence

    def mask(self, damage: str = "exact") -> BoolArray:
        """The object's mask in the first camera; see `damaged_mask`."""
        mask = cast_geometry(self.shown, KEYPOINT_CAMERA, self.cam_from_shown).mask
        return damaged_mask(mask, damage, instance_rng(self.options.seed, *self.names, damage))

    def photo(self) -> ByteImage:
        """The object in the first camera, before a random texture."""
        camera, rng = KEYPOINT_CAMERA, instance_rng(self.options.seed, *self.names, "photo")
        frame = RaycastRenderer().render(self.shown, camera, self.cam_from_shown, samples=4)
        return frame.composite(random_texture(camera.height, camera.width, rng))

    def truth_for(self, est: Alignment) -> Alignment:
        """The truth whose rotation is nearest, among those by which the object looks the same."""
        rigid = replace(self.gt, scale=np.ones(3))  # the object has it, not its model
        return replace(
            nearest_truth(est=est, gt=rigid, symmetry=self.symmetry), scale=self.gt.scale
        )


def make_scene(model: AnnotatedModel, view: int, options: EvidenceRunOptions) -> ObjectScene:
    """Draw a view of a model, its stretch, the other cameras, and the noise of everything.

    Everything random follows from (seed, category, model id, view). The cameras turn about the
    vertical axis of the first one through the centre of the object's box.
    """
    names = (model.category, model.model_id, str(view))
    instance = make_instance(model, view_index=view, scene=scene_of(model), **options.drawn)
    shown = instance.scene
    assert shown is not None
    stretch = 1 / instance.gt.scale
    rng = instance_rng(options.seed, *names, "evidence")
    pose = instance.cam_from_model
    centre = pose.apply(shown.bounds.mean(axis=0)[None])[0]
    shots = []
    for place in _TURNS:
        motion = np.eye(4)
        turn = np.radians(place * options.turn_deg)
        motion[:3, :3] = rotation_from_vector(np.array([0.0, turn, 0.0]))
        motion[:3, 3] = centre - motion[:3, :3] @ centre
        shots.append(_shoot(shown, model.keypoints.xyz, pose, motion, rng, options))
    height = float(np.ptp(shown.bounds[:, 1]) * (1 + options.length_sigma * rng.standard_normal()))
    mesh = Mesh(shown.mesh.vertices * stretch, shown.mesh.faces)
    return ObjectScene(
        model=Model(points_3d=model.keypoints.xyz * stretch, bounds=instance.bounds, mesh=mesh),
        gt=instance.gt,
        shots=tuple(shots),
        height=height,
        diagonal=instance.diagonal,
        shown=shown,
        symmetry=model.symmetry,
        cam_from_shown=pose,
        names=names,
        options=options,
    )


def _shoot(
    shown: Scene,
    xyz: FloatArray,
    first_pose: Alignment,
    motion: FloatArray,
    rng: np.random.Generator,
    options: EvidenceRunOptions,
) -> Shot:
    pose = _moved(first_pose, motion)
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


def _moved(pose: Alignment, motion: FloatArray) -> Alignment:
    """A pose in the first camera as another camera has it, after its motion (4, 4)."""
    rotation, shift = motion[:3, :3], motion[:3, 3]
    return Alignment(rotation @ pose.rotation, rotation @ pose.translation + shift, pose.scale)


def truth_in(shot: Shot, gt: Alignment) -> Alignment:
    """The truth in the camera of a shot."""
    return _moved(gt, shot.cam_from_first)


# Methods ------------------------------------------------------------------------------------------


class Given(NamedTuple):
    """Arguments of `align`, and the shots that they are of."""

    views: tuple[View, ...]
    shots: tuple[Shot, ...]
    size: Size | None


@dataclass(frozen=True, eq=False)
class EvidenceEstimate:
    """An estimate, and what it was made from, unless a registered function made it."""

    alignment: Alignment
    result: Result | None = None
    given: Given | None = None


def _align_with(scene: ObjectScene, *, method: str) -> EvidenceEstimate:
    given = evidence_for(method, scene)
    result = align(scene.model, given.views, size=given.size)
    return EvidenceEstimate(result.alignment, result, given)


def evidence_for(method: str, scene: ObjectScene) -> Given:
    """The views and the size that a method gives."""
    options = scene.options
    if method == MASK_ALONE:
        return Given((View(KEYPOINT_CAMERA, mask=scene.mask()),), scene.shots[:1], None)
    kinds = COMBINED.get(method, (method,))
    count = next((VIEWS_KNOWN[kind] for kind in kinds if kind in VIEWS_KNOWN), 1)
    shots = scene.shots[: VIEWS_FREE.get(method, count)]
    if method in VIEWS_FREE:
        others = (shot for shot in shots[1:] if len(shot.rows) >= _LEAST_FREE)
        shots = (shots[0], *others)
    views = tuple(
        View(
            KEYPOINT_CAMERA,
            shot.points_2d,
            ids=shot.rows.tolist(),
            sigma=options.sigma,
            cam_from_rig=shot.cam_from_first if count > 1 else None,
            **(_of_first(kinds, scene) if number == 0 else {}),
        )
        for number, shot in enumerate(shots)
    )
    size = Size(height=scene.height, sigma=options.length_sigma) if LENGTH in kinds else None
    return Given(views, shots, size)


def _of_first(kinds: tuple[str, ...], scene: ObjectScene) -> dict[str, Any]:
    shot, options = scene.shots[0], scene.options
    fields: dict[str, Any] = {}
    if DEPTH in kinds:
        fields |= {"depth": shot.depths, "depth_sigma": options.depth_sigma}
    if GRAVITY in kinds:
        fields |= {"up": shot.up, "up_sigma_deg": options.up_sigma_deg}
    for kind in kinds:
        if kind == MASK or kind in DAMAGED:
            fields["mask"] = scene.mask(DAMAGED.get(kind, "exact"))
    if IMAGE in kinds:
        fields["image"] = scene.photo()
    return fields


def evidence_benchmark(options: EvidenceRunOptions) -> Benchmark:
    """The kinds of evidence of the options on views of models."""
    own = {name: Method(name, partial(_align_with, method=name)) for name in METHODS}
    return Benchmark.chosen(EvidenceScenes(options), options.methods, own, metrics=options.metrics)


# Errors -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class EvidenceScenes(Setting):
    """Views of annotated models with meshes: the setting of the experiment."""

    names = VIEW_NAMES
    columns = COLUMNS

    options: EvidenceRunOptions

    def warm_up(self) -> Sequence[KeypointTask]:
        """Compile the kernels."""
        points, pixels, pose = example_view()
        for up in (None, [0.0, 1.0, 0.0]):
            align(Model(points_3d=points), View(KEYPOINT_CAMERA, pixels, up=up))
        box = Box.from_model([points.min(axis=0), points.max(axis=0)], pose)
        overlap(est=box, gt=box)
        return ()

    def case(self, task: KeypointTask) -> Case:
        if task.problem:
            raise DataError(task.problem)
        assert task.model is not None
        return Case(task.names, instance=make_scene(task.model, task.view, self.options))

    def given(self, scene: ObjectScene) -> MethodInput:
        shot = scene.shots[0]
        return MethodInput(
            np.asarray(scene.model.points_3d)[shot.rows],
            shot.points_2d,
            KEYPOINT_CAMERA,
            self.options.sigma,
            bounds=np.asarray(scene.model.bounds),
            gt=scene.gt,
            make_views=lambda: (scene.model, evidence_for(EVERYTHING, scene).views),
        )

    def answered(
        self, method: Method, scene: ObjectScene, answer: Alignment | Result
    ) -> EvidenceEstimate:
        # The first view alone was given, for which no bound is known.
        if isinstance(answer, Alignment):
            return EvidenceEstimate(answer)
        return EvidenceEstimate(answer.alignment, answer)

    def row(self, method: Method, scene: ObjectScene, estimate: EvidenceEstimate) -> Row:
        est, bounds = estimate.alignment, np.asarray(scene.model.bounds)
        # Keypoints distinguish poses of the same outline.
        gt = scene.truth_for(est) if method.name == MASK_ALONE else scene.gt
        boxes = {"est": Box.from_model(bounds, est), "gt": Box.from_model(bounds, gt)}
        values: Row = {
            **alignment_errors(est=est, gt=gt, length=scene.diagonal),
            "box_iou": overlap(**boxes),
        }
        result, given = estimate.result, estimate.given
        if given is None or result is None:
            return values
        limits = self._bounds(bound_of(result, given, scene), scene)
        return {
            **values,
            "keypoints": sum(len(view.keypoint_ids) for view in given.views),
            **limits,
            "over_limit": values["rotation_error_deg"] / limits["rotation_bound_deg"],
            "warnings": len(result.warnings),
        }

    def _bounds(self, bound: FloatArray, scene: ObjectScene) -> Row:
        """Median errors of a Gaussian with the bound as its covariance."""
        rng = instance_rng(self.options.seed, *scene.names, "bound")
        drawn = rng.multivariate_normal(np.zeros(9), bound, size=_DRAWS, method="eigh")
        values = (
            np.degrees(np.linalg.norm(drawn[:, :3], axis=1)),
            np.linalg.norm(drawn[:, 3:6], axis=1) / scene.diagonal,
            np.abs(np.expm1(drawn[:, 7])),
            np.abs(np.expm1(drawn[:, 8])),
        )
        return dict(zip(BOUNDS, (float(np.median(each)) for each in values), strict=True))


def bound_of(result: Result, given: Given, scene: ObjectScene) -> FloatArray:
    """The Cramer-Rao bound (9, 9) of an estimate from such evidence, as `Result.covariance`.

    Contours have the measured standard deviation.
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


# Photos and masks ---------------------------------------------------------------------------------

DAMAGES = ("exact", "dilated", "eroded", "smoothed", "hidden", "hole", "blob")
"""Kinds of masks: without damage; with a contour 2 px outside or inside; with a contour that
wanders by 2 px; a quarter hidden by a rectangle; with a hole; with a blob of the background."""

_SHIFT = 2  # [px], of a dilated or eroded contour
_WANDER = 2.0  # [px], standard deviation of a smoothed contour
_WANDER_LENGTH = 5.0  # [px], over which it wanders
_HIDDEN = 0.25  # share of the area
_SIZE = 0.13  # radius of holes and blobs, relative to the root of the area


_GRAINS = (2.0, 8.0, 32.0)  # [px]
_TEXTURE = 30.0  # standard deviation of a channel [grey levels]
_COLOURED = 0.3  # part of it that is a channel's own


def random_texture(height: int, width: int, rng: np.random.Generator) -> ByteImage:
    """A picture (h, w, 3) of a random colour with grains of several sizes."""
    picture = np.zeros((height, width, 3)) + rng.uniform(60, 200, 3)
    for grain in _GRAINS:
        noise = rng.normal(size=(height, width, 1)) + _COLOURED * rng.normal(size=picture.shape)
        blurred = cv2.GaussianBlur(noise, (0, 0), grain)
        picture += _TEXTURE / len(_GRAINS) ** 0.5 * blurred / blurred.std()
    return np.asarray(np.clip(picture, 0, 255), dtype=np.uint8)


def damaged_mask(mask: npt.ArrayLike, kind: str, rng: np.random.Generator) -> BoolArray:
    """A mask (h, w) with a damage of one of the kinds `DAMAGES`.

    Raises InputError if the kind is unknown.
    """
    pixels = np.asarray(mask).astype(np.uint8)
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
