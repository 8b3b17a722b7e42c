"""Test instances of an annotated model: a view, a stretch, noisy visible keypoints, symmetry.

Visible keypoints are found by casting rays at the mesh. Without a mesh, a keypoint counts as
visible if one of its faces of the keypoints' convex hull faces the camera. Its faces are the
nearest ones, with a tolerance of 1 % of the keypoints' extent. Keypoints in one plane, or fewer
than 4, all count as visible. The hull has no holes and no parts that hide others, so more keypoints
of an object such as a chair count as visible than really are.

`cadalign.datasets.keypoints.annotated_symmetry` finds the rotations that map a model onto itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from cadalign.arrays import BoolArray, FloatArray, IntArray, instance_rng
from cadalign.datasets import AnnotatedModel, KeypointNet, check_solid
from cadalign.datasets.keypoints import annotated_symmetry
from cadalign.errors import CadalignError, TooFewVisibleError
from cadalign.evaluation.runs.work import Row
from cadalign.geometry.alignment import Alignment, Box, extent
from cadalign.geometry.camera import Camera
from cadalign.geometry.pixels import perspective
from cadalign.geometry.symmetry import Symmetry

if TYPE_CHECKING:
    # Imported late elsewhere: workers without meshes must not load the renderer.
    from cadalign.render import Scene

KEYPOINT_CAMERA = Camera(width=640, height=480, fx=935.0, fy=935.0, cx=319.5, cy=239.5)
"""The camera of the experiments on keypoints."""
STRETCH_RANGE = (0.5, 2.0)

# Ranges of azimuth [rad], sine of the elevation, and filled share of the image, as in sample_view.
_LOWEST = np.array([-np.pi, 0.0, 0.7])
_HIGHEST = np.array([np.pi, np.sin(np.radians(60.0)), 0.95])
_ATTEMPTS = 100
_SLACK = 0.01
_CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) - 0.5


# Views of keypoints without a mesh ----------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class KeypointHull:
    """The convex hull of a model's keypoints (k, 3) [model units]."""

    xyz: FloatArray

    @cached_property
    def bounds(self) -> FloatArray:
        """Lowest and highest coordinates, (2, 3) float."""
        return extent(self.xyz)

    def visible_from(self, position: FloatArray) -> BoolArray:
        """Mask (k,) of the keypoints that count as visible from a position (3,)."""
        if self._faces is None:
            return np.ones(len(self.xyz), dtype=bool)
        faces, beside = self._faces
        facing = faces[:, :3] @ position + faces[:, 3] > 0
        return np.asarray(beside @ facing)  # a product of booleans is True if any pair is

    @cached_property
    def _faces(self) -> tuple[FloatArray, BoolArray] | None:
        """Outward planes (f, 4) of the faces, and a mask (k, f) of each keypoint's faces."""
        from scipy.spatial import ConvexHull, QhullError

        if len(self.xyz) < 4:
            return None
        try:
            planes = ConvexHull(self.xyz).equations
        except QhullError:  # all in one plane
            return None
        depth = -(self.xyz @ planes[:, :3].T + planes[:, 3])
        low, high = self.bounds
        slack = _SLACK * float(np.linalg.norm(high - low))
        return planes, depth <= depth.min(axis=1, keepdims=True) + slack


HullView = tuple[Alignment, BoolArray]
"""A view: the pose, and a mask (k,) of the keypoints that count as visible."""


def sample_hull_view(hull: KeypointHull, *, rng: np.random.Generator, min_visible: int) -> HullView:
    """Draw a view with enough visible keypoints, from `cadalign.render.sample_view`'s distribution.

    Raises TooFewVisibleError if no view shows enough keypoints.
    """
    (found,) = sample_hull_views([hull], rngs=[rng], min_visible=min_visible)
    if isinstance(found, TooFewVisibleError):
        raise found
    return found


def sample_hull_views(
    hulls: Sequence[KeypointHull], *, rngs: Sequence[np.random.Generator], min_visible: int
) -> list[HullView | TooFewVisibleError]:
    """Draw a view of each hull from its own random stream; see `sample_hull_view`."""
    counts = [len(hull.xyz) for hull in hulls]
    found: dict[int, HullView] = {}
    best = [0] * len(hulls)
    left = [k for k, count in enumerate(counts) if count >= min_visible]
    for _ in range(_ATTEMPTS if left else 0):
        draws = np.array([rngs[k].random(3) for k in left])
        bounds = np.array([hulls[k].bounds for k in left])
        poses = _framed_poses(_LOWEST + (_HIGHEST - _LOWEST) * draws, bounds)
        for k, rotation, translation, position in zip(left, *poses, strict=True):
            visible = hulls[k].visible_from(position)
            best[k] = max(best[k], int(np.count_nonzero(visible)))
            if best[k] >= min_visible:
                pose = Alignment(rotation, translation, np.ones(3), is_valid=True)
                found[k] = (pose, visible)
        left = [k for k in left if k not in found]
        if not left:
            break
    return [found.get(k) or _too_few(count, best[k], min_visible) for k, count in enumerate(counts)]


def _too_few(count: int, best: int, min_visible: int) -> TooFewVisibleError:
    found = f"the best of {_ATTEMPTS} views shows {best}" if best else f"there are only {count}"
    return TooFewVisibleError(
        f"{min_visible} keypoints should be visible, but {found}",
        where="keypoints",
        fix="lower min_visible, or leave this model out",
    )


def _framed_poses(
    drawn: FloatArray, bounds: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Rotations (n, 3, 3), translations (n, 3) and camera positions (n, 3) of framed views.

    ``drawn`` (n, 3) are azimuth [rad], sine of the elevation, and filled share of the image.
    ``bounds`` (n, 2, 3) are the boxes of the models.
    """
    low, high = bounds[:, 0], bounds[:, 1]
    rotations = _upright_rotations(drawn[:, 0], np.arcsin(drawn[:, 1]))
    corners = (high - low)[:, None] * _CORNERS @ rotations.transpose(0, 2, 1)
    centers = _framed_centers(corners, fill=drawn[:, 2])
    middles = ((low + high) / 2)[:, :, None]
    translations = centers - (rotations @ middles)[:, :, 0]
    positions = -(rotations.transpose(0, 2, 1) @ translations[:, :, None])[:, :, 0]
    return rotations, translations, positions


def _upright_rotations(azimuths: FloatArray, elevations: FloatArray) -> FloatArray:
    """Rotations (n, 3, 3) from model to camera with y up; angles [rad] as in `look_at`."""
    sin_a, cos_a = np.sin(azimuths), np.cos(azimuths)
    sin_e, cos_e = np.sin(elevations), np.cos(elevations)
    rows = [
        *(cos_a, np.zeros_like(sin_a), -sin_a),
        *(sin_e * sin_a, -cos_e, sin_e * cos_a),
        *(-cos_e * sin_a, -sin_e, -cos_e * cos_a),
    ]
    return np.stack(rows, axis=-1).reshape(-1, 3, 3)


def _framed_centers(corners: FloatArray, *, fill: FloatArray) -> FloatArray:
    """Positions (n, 3) of boxes' centres in the camera frame, to fill shares (n,) of the image.

    ``corners`` (n, 8, 3) are relative to the centres. Let a be the ray through the image's centre.
    With the box's centre at depth d on it, a corner X projects to f |X - a X_z| / (X_z + d) from
    the image's centre. This is solved for d; the largest d of all corners and directions is used.
    """
    camera = KEYPOINT_CAMERA
    size = np.array([camera.width, camera.height])
    focal = np.array([camera.fx, camera.fy])
    ray = ((size - 1) / 2 - (camera.cx, camera.cy)) / focal
    across = np.abs(corners[..., :2] - ray * corners[..., 2:])
    depths = 2 * focal * across / (size * fill[:, None, None]) - corners[..., 2:]
    return np.asarray(depths.max(axis=(1, 2))[:, None] * np.append(ray, 1.0))


# Instances ----------------------------------------------------------------------------------------
NO_SYMMETRY = Symmetry.none()
NO_KEYPOINTS = KeypointHull(np.empty((0, 3)))


@dataclass(frozen=True, eq=False)
class KeypointTask:
    """One view of one model."""

    category: str
    model_id: str
    view: int = 0
    hull: KeypointHull = NO_KEYPOINTS
    """Keypoints (k, 3) and their convex hull."""
    ids: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    symmetry: Symmetry = NO_SYMMETRY
    model: AnnotatedModel | None = None
    """The model with its mesh; None if it is evaluated on keypoints only."""
    problem: str = ""  # why the model cannot be evaluated; empty if it can

    @property
    def names(self) -> Row:
        """The cells that identify its rows, without the method."""
        return {"category": self.category, "model_id": self.model_id, "view": self.view}

    @classmethod
    def from_model(
        cls, dataset: KeypointNet, category: str, model_id: str, *, hull: bool
    ) -> KeypointTask:
        """Make the task of a model's first view; ``hull`` ignores the mesh.

        The task of a malformed model has a problem.
        """
        try:
            model = dataset[category, model_id]
        except CadalignError as error:
            return cls(category, model_id, problem=str(error))
        return cls(
            category,
            model_id,
            hull=KeypointHull(model.keypoints.xyz),
            ids=model.keypoints.ids,
            symmetry=annotated_symmetry(model.keypoints.xyz, model.symmetries),
            model=None if hull or model.mesh_path is None else model,
        )


@dataclass(frozen=True, eq=False)
class Instance:
    """One view of a model, and the input of methods.

    The image shows the original model. Methods get the model stretched along y and z by unknown
    factors, so the true scale is their inverse.
    """

    camera: Camera
    cam_from_model: Alignment  # pose of the original model
    points_3d: FloatArray  # (n, 3), visible keypoints of the stretched model
    points_2d: FloatArray  # (n, 2), noisy observations [px]
    ids: IntArray
    bounds: FloatArray
    """(2, 3), lowest and highest coordinates of the stretched model; without a mesh, of its
    keypoints."""
    gt: Alignment  # the truth: pose and inverse stretch
    visibility: str  # "rays" or "hull": how visible keypoints were found
    scene: Scene | None  # the original model; None without a mesh
    diagonal: float
    """Diagonal of the original model's bounding box [model units]; 1 without a mesh, as
    KeypointNet's models are normalised."""

    @cached_property
    def gt_box(self) -> Box:
        """The true box."""
        return Box.from_model(self.bounds, self.gt)


@lru_cache(maxsize=1)  # views of a model follow each other
def scene_of(model: AnnotatedModel) -> Scene:
    """Read a model's mesh for `make_instance`."""
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

    The instance depends only on (seed, category, model id, view index). ``scene`` is the model's,
    from `scene_of`.
    """
    from cadalign.render import sample_view

    rng = instance_rng(seed, model.category, model.model_id, str(view_index))
    xyz = model.keypoints.xyz
    view = sample_view(scene, xyz, KEYPOINT_CAMERA, rng=rng, min_visible=min_visible)
    ids = model.keypoints.ids
    seen = _View(view.cam_from_model, xyz[view.visible], ids[view.visible], scene.bounds, rng)
    (instance,) = _stretch([seen], noise_px=noise_px, scene=scene)
    return instance


def make_hull_instances(
    views: Sequence[KeypointTask], *, noise_px: float, min_visible: int, seed: int
) -> list[Instance | TooFewVisibleError]:
    """Draw views, stretches and keypoint noise [px] for models without a mesh.

    Visibility and boxes are found from the keypoints. The result is an error for a model without a
    view of enough keypoints. See `make_instance`.
    """
    rngs = [instance_rng(seed, each.category, each.model_id, str(each.view)) for each in views]
    hulls = [each.hull for each in views]
    sampled = sample_hull_views(hulls, rngs=rngs, min_visible=min_visible)
    seen = [
        _View(found[0], each.hull.xyz[found[1]], each.ids[found[1]], each.hull.bounds, rng)
        for each, rng, found in zip(views, rngs, sampled, strict=True)
        if not isinstance(found, TooFewVisibleError)
    ]
    instances = iter(_stretch(seen, noise_px=noise_px, scene=None))
    return [e if isinstance(e, TooFewVisibleError) else next(instances) for e in sampled]


class _View(NamedTuple):
    """The visible keypoints (n, 3) of a model, and its bounds (2, 3)."""

    cam_from_model: Alignment
    xyz: FloatArray
    ids: IntArray
    bounds: FloatArray
    rng: np.random.Generator


def _stretch(views: Sequence[_View], *, noise_px: float, scene: Scene | None) -> list[Instance]:
    if not views:
        return []
    low, high = STRETCH_RANGE
    stretches = np.ones((len(views), 3))
    stretches[:, 1:] = low + (high - low) * np.array([view.rng.random(2) for view in views])
    bounds = np.array([view.bounds for view in views])
    poses = [view.cam_from_model for view in views]  # with scale 1
    in_camera = [
        view.xyz @ pose.rotation.T + pose.translation
        for view, pose in zip(views, poses, strict=True)
    ]
    exact = KEYPOINT_CAMERA.pixels_from_normalized(perspective(np.concatenate(in_camera)))
    noise = np.concatenate([view.rng.standard_normal((len(view.xyz), 2)) for view in views])
    points_2d = np.split(
        exact + noise_px * noise, np.cumsum([len(view.xyz) for view in views[:-1]])
    )
    diagonal = 1.0 if scene is None else float(np.linalg.norm(np.ptp(scene.bounds, axis=0)))
    return [
        Instance(
            camera=KEYPOINT_CAMERA,
            cam_from_model=view.cam_from_model,
            points_3d=view.xyz * stretch,
            points_2d=observed,
            ids=view.ids,
            bounds=stretched_bounds,
            gt=Alignment(
                view.cam_from_model.rotation, view.cam_from_model.translation, scale, is_valid=True
            ),
            visibility="hull" if scene is None else "rays",
            scene=scene,
            diagonal=diagonal,
        )
        for view, stretch, scale, stretched_bounds, observed in zip(
            views, stretches, 1 / stretches, bounds * stretches[:, None], points_2d, strict=True
        )
    ]
