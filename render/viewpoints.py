"""Viewpoints of an object: on a sphere, at random or by name, and visible keypoints."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
import numpy.typing as npt

from cadalign.arrays import FloatArray, as_floats, as_points
from cadalign.errors import InputError, RenderError, TooFewVisibleError
from cadalign.geometry.alignment import Alignment, Box, model_rays
from cadalign.geometry.camera import Camera
from cadalign.render.posed_scene import within_lens_field
from cadalign.render.scene import Scene

_ATTEMPTS = 100
_DISTANCE_STEPS = 50
_FILL_TOLERANCE = 1e-3
_STILL_FILL = 0.88  # share of the image that the model fills in `pose_in_view`


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """A pose of an object, and its visible keypoints."""

    cam_from_model: Alignment
    """Pose of the object in the camera frame."""
    visible: npt.NDArray[np.bool_]
    """(k,) bool, which keypoints are visible."""


def look_at(
    *,
    azimuth: float,
    elevation: float,
    distance: float,
    roll: float = 0.0,
    scale: npt.ArrayLike = (1.0, 1.0, 1.0),
) -> Alignment:
    """Pose of a model seen from a point on a sphere, with its y axis up in the image.

    Parameters
    ----------
    azimuth : float
        Angle about the model's y axis [degrees]: 0 looks from +z, 90 from +x.
    elevation : float
        Angle above the model's xz plane [degrees], -90 to 90.
    distance : float
        Distance from the camera to the model's origin [model units], positive. The origin projects
        to the principal point.
    roll : float
        Rotation of the camera about its optical axis [degrees]; a positive roll rotates the object
        counterclockwise in the image.
    scale : (3,) float
        The stretch along the model's axes.

    Returns
    -------
    Alignment

    Raises
    ------
    InputError
        If a value is not finite, the elevation is out of range, or the distance or a scale is not
        positive.

    Examples
    --------
    >>> pose = look_at(azimuth=0, elevation=0, distance=3)
    >>> pose.apply([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]).tolist()
    [[0.0, 0.0, 3.0], [1.0, 0.0, 3.0], [0.0, -1.0, 3.0]]
    """
    values = as_floats([azimuth, elevation, distance, roll], name="look_at", shape=(4,))
    if abs(elevation) > 90:
        raise InputError(f"{elevation:g} is not between -90 and 90 degrees", where="elevation")
    if distance <= 0:
        raise InputError(f"{distance:g} is not positive", where="distance")
    rotation = _looking_rotation(*values[[0, 1, 3]])
    stretch = as_floats(scale, name="scale", shape=(3,))
    return Alignment(rotation, np.array([0, 0, distance]), stretch)


def sample_view(
    scene: Scene,
    keypoints: npt.ArrayLike,
    camera: Camera,
    *,
    rng: np.random.Generator,
    min_visible: int = 6,
    elevation: tuple[float, float] = (0.0, 60.0),
    fill: tuple[float, float] = (0.7, 0.95),
    roll: float = 0.0,
    scale: npt.ArrayLike = (1.0, 1.0, 1.0),
) -> Viewpoint:
    """Sample a random view, uniformly over the sphere, in which enough keypoints are visible.

    The object's box is centred in the image and inside it.

    Parameters
    ----------
    scene : Scene
        The object.
    keypoints : (k, 3) float
        Keypoints in model coordinates.
    camera : Camera
    rng : numpy.random.Generator
        The same state gives the same view.
    min_visible : int
        Least number of visible keypoints.
    elevation : tuple of 2 float
        Lowest and highest elevation [degrees].
    fill : tuple of 2 float
        Range of the share of the image, in width or height, that the object's box fills; at 1 it
        touches the border.
    roll : float
        Largest rotation of the camera about its optical axis [degrees].
    scale : (3,) float
        The stretch along the model's axes.

    Returns
    -------
    Viewpoint

    Raises
    ------
    TooFewVisibleError
        A RenderError, if no view shows enough keypoints.
    InputError
        If an argument is out of range.
    """
    points = as_points(keypoints, name="keypoints", dimension=3)
    _check_range(elevation, name="elevation", low=-90.0, high=90.0)
    _check_range(fill, name="fill", low=0.01, high=1.0)
    best = 0
    attempts = _ATTEMPTS if len(points) >= min_visible else 0
    for _ in range(attempts):
        azimuth = rng.uniform(-180.0, 180.0)
        low, high = np.sin(np.radians(elevation))
        height = np.degrees(np.arcsin(rng.uniform(low, high)))
        rotation = _looking_rotation(azimuth, height, rng.uniform(-roll, roll))
        pose = frame_object(
            scene.bounds, camera, rotation=rotation, fill=rng.uniform(*fill), scale=scale
        )
        visible = visible_keypoints(scene, points, camera, pose)
        if visible.sum() >= min_visible:
            return Viewpoint(cam_from_model=pose, visible=visible)
        best = max(best, int(visible.sum()))
    found = f"the best of {attempts} views shows {best}" if attempts else "there are no more"
    raise TooFewVisibleError(
        f"{min_visible} of {len(points)} keypoints should be visible, but {found}",
        where=scene.mesh.source,
        fix="lower min_visible, widen the range of elevations, or leave this model out",
    )


def frame_object(
    bounds: npt.ArrayLike,
    camera: Camera,
    *,
    rotation: npt.ArrayLike,
    fill: float,
    scale: npt.ArrayLike = (1.0, 1.0, 1.0),
) -> Alignment:
    """Pose of an object of given orientation that fills a given share of the image.

    The centre of the object's box projects to the image's centre.

    Parameters
    ----------
    bounds : (2, 3) float
        The model's lowest and highest coordinates, before the stretch.
    camera : Camera
    rotation : (3, 3) float
    fill : float
        Share of half the width or height that the farthest corner reaches.
    scale : (3,) float

    Returns
    -------
    Alignment

    Raises
    ------
    RenderError
        If no distance gives that share, for example because of strong lens distortion.
    """
    placed = Alignment(
        as_floats(rotation, name="rotation", shape=(3, 3)),
        np.zeros(3),
        as_floats(scale, name="scale", shape=(3,)),
    )
    box = Box.from_model(bounds, placed)
    corners = box.corners - box.center
    size = float(np.linalg.norm(box.extents)) or 1.0
    middle = np.array([[(camera.width - 1) / 2, (camera.height - 1) / 2]])
    (axis,), _ = camera.rays_where_valid(middle)
    # Depths of the box's centre. At the near one, a corner may touch the camera plane.
    near, far = size / 2, 1e6 * size
    for _ in range(_DISTANCE_STEPS):
        depth = float(np.sqrt(near * far))
        share = _share(corners + depth * axis, camera, middle[0])
        if abs(share - fill) < _FILL_TOLERANCE * fill:
            break
        near, far = (depth, far) if share > fill else (near, depth)
    else:
        raise RenderError(
            f"the object cannot be made to fill {fill:g} of the image", where="camera"
        )
    return Alignment(placed.rotation, depth * axis - box.center, placed.scale)


def _share(corners: FloatArray, camera: Camera, middle: FloatArray) -> float:
    """Largest distance of a corner from the image's centre, as a share of that to the border."""
    if not within_lens_field(camera, corners).all():
        return np.inf
    offset = np.abs(camera.pixels_of_rays(corners) - middle)
    return float((2 * offset / (camera.width, camera.height)).max())


def _looking_rotation(azimuth: float, elevation: float, roll: float) -> FloatArray:
    """Rotation (3, 3) from model to camera axes; angles in degrees."""
    turn, rise, tilt = np.radians([azimuth, elevation, roll])
    forward = -np.array([np.cos(rise) * np.sin(turn), np.sin(rise), np.cos(rise) * np.cos(turn)])
    right = np.array([np.cos(turn), 0.0, -np.sin(turn)])
    upright = np.stack([right, np.cross(forward, right), forward])
    c, s = np.cos(tilt), np.sin(tilt)
    return np.asarray(np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ upright)


def _check_range(value: tuple[float, float], *, name: str, low: float, high: float) -> None:
    first, last = as_floats(value, name=name, shape=(2,))
    if not low <= first <= last <= high:
        raise InputError(
            f"{first:g} to {last:g} is not a range within {low:g} to {high:g}", where=name
        )


VIEWS: dict[str, tuple[float, float]] = {
    "iso": (145.0, 25.0),
    "front": (180.0, 0.0),
    "right": (90.0, 0.0),
    "back": (0.0, 0.0),
    "left": (-90.0, 0.0),
    "top": (180.0, 90.0),
    "bottom": (180.0, -90.0),
}
"""Azimuth and elevation [degrees] of the named views, see `look_at`. ShapeNet models face -z."""


@dataclass(frozen=True)
class Angles:
    """Viewing angles of a model [degrees]; see `look_at`."""

    azimuth: float
    elevation: float
    roll: float = 0.0

    @classmethod
    def parse(cls, text: str) -> Angles:
        """Parse a view's name, ``azimuth,elevation`` or ``azimuth,elevation,roll``.

        Raises
        ------
        InputError
            If the text is none of these.

        Examples
        --------
        >>> Angles.parse("30,-10")
        Angles(azimuth=30.0, elevation=-10.0, roll=0.0)
        """
        if text in VIEWS:
            return cls(*VIEWS[text])
        try:
            values = [float(word) for word in text.split(",")]
        except ValueError:
            values = []
        if len(values) not in (2, 3) or not np.isfinite(values).all():
            raise InputError(
                f"{text!r} is not a view",
                where="view",
                fix=f"give one of {', '.join(VIEWS)}, or azimuth,elevation[,roll] in degrees",
            )
        return cls(*values)


def pose_in_view(
    scene: Scene, camera: Camera, angles: Angles, *, scale: npt.ArrayLike = (1.0, 1.0, 1.0)
) -> Alignment:
    """Pose of a model that fills the image, seen from given angles.

    Raises
    ------
    InputError
        If an angle or a scale is out of its range.
    """
    rotation = look_at(**asdict(angles), distance=1.0, scale=scale).rotation
    return frame_object(scene.bounds, camera, rotation=rotation, fill=_STILL_FILL, scale=scale)


_DEPTH_SLACK = 2e-3  # depth below the surface at which a keypoint is still visible [diagonals]
# The centre and four points around it: many keypoints are on corners and edges, where a ray to the
# keypoint itself may graze the surface beside it.
_RAY_OFFSETS = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]], dtype=float)


def visible_keypoints(
    scene: Scene,
    points_3d: npt.ArrayLike,
    camera: Camera,
    cam_from_model: Alignment,
) -> npt.NDArray[np.bool_]:
    """Find the keypoints that are inside the image and not hidden by the object.

    Five rays are cast to each keypoint: to the point itself and to four points beside it, at 0.2 %
    of the stretched model's diagonal. The keypoint is hidden if all of them hit the surface more
    than this distance in front of their targets. So a keypoint may lie as deep below the surface.

    Parameters
    ----------
    scene : Scene
        The object.
    points_3d : (k, 3) float
        Keypoints in model coordinates, on or near the surface.
    camera : Camera
    cam_from_model : Alignment

    Returns
    -------
    (k,) bool

    Raises
    ------
    InputError
        If the points are not finite or not (k, 3).

    Examples
    --------
    >>> from cadalign import Mesh
    >>> plate = Scene(Mesh([[-1, -1, 0], [1, -1, 0], [0, 2, 0]], [[0, 1, 2]]))
    >>> camera = Camera.from_fov(640, 480, fov_x=60.0)
    >>> pose = Alignment(np.eye(3), [0, 0, 4], [1, 1, 1])
    >>> visible_keypoints(plate, [[0, 0, 0], [0, 0, 0.5], [9, 0, 0]], camera, pose).tolist()
    [True, False, False]
    """
    points = as_points(points_3d, name="points_3d", dimension=3)
    in_camera = cam_from_model.apply(points)
    visible = seen_in_image(camera, in_camera)
    chosen = np.flatnonzero(visible)
    if not len(chosen):
        return visible
    slack = _DEPTH_SLACK * scene.stretched_diagonal(cam_from_model)
    targets = in_camera[chosen, None] + slack * _ray_offsets(in_camera[chosen])
    # In the camera frame a ray ends at its target; in the model frame its parameter is the same.
    origin, model_from_ray = model_rays(cam_from_model)
    _, distance = scene.caster.first_hits(origin, targets.reshape(-1, 3) @ model_from_ray.T)
    reach = 1 - slack / np.linalg.norm(targets, axis=2)
    visible[chosen] = (distance.reshape(reach.shape) >= reach).any(axis=1)
    return visible


def seen_in_image(camera: Camera, points_cam: FloatArray) -> npt.NDArray[np.bool_]:
    """Mark points (k, 3) in the camera frame that are visible inside its image, (k,) bool."""
    seen = within_lens_field(camera, points_cam)
    seen[seen] = camera.contains(camera.pixels_of_rays(points_cam[seen]))
    return seen


def _ray_offsets(points_cam: FloatArray) -> FloatArray:
    """Offsets perpendicular to the line of sight, of length 0 or 1, (k, 5, 3)."""
    sight = points_cam / np.linalg.norm(points_cam, axis=1, keepdims=True)
    across = np.column_stack([sight[:, 2], np.zeros(len(sight)), -sight[:, 0]])
    across[np.abs(sight[:, 1]) > 0.99] = (1.0, 0.0, 0.0)  # only seen by wide lenses
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    upright = np.cross(sight, across)
    axes = np.stack([across, upright], axis=1)
    return np.asarray(np.einsum("ra,kax->krx", _RAY_OFFSETS, axes))
