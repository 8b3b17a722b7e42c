"""Simulated problems with a known answer: the AEPnP paper's, boxes on the ground, and videos.

In a video an object moves smoothly, and some of its keypoints are missed.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cadalign.arrays import BoolArray, FloatArray
from cadalign.estimation.tracks.motion import Motion, moved_by
from cadalign.estimation.view import View
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera
from cadalign.geometry.rotations import rotation_from_quat_wxyz, rotation_from_vector

SIMULATION_CAMERA = Camera(width=640, height=480, fx=150.0, fy=150.0, cx=319.5, cy=239.5)
"""The paper's virtual camera."""
TRACK_CAMERA = Camera(width=640, height=480, fx=600.0, fy=600.0, cx=319.5, cy=239.5)
USUAL_MOTION = Motion(angular_sigma=20.0, linear_sigma=0.15)
"""Strengths of the simulated accelerations, of an object of about unit size."""
_DEPTH = 2.5
_STEPS = 4  # of the motion, between frames
_MARGIN = 0.5  # of the model's origin from the image's borders, over half its size
_NEAREST, _FARTHEST = 1.5, 5.0  # depths of the origin
_TRIES = 200


@dataclass(frozen=True, eq=False)
class Problem:
    """Keypoints on a model (n, 3) and in an image (n, 2) [px], and the alignment that joins them.

    ``outliers`` (n,) are the observations that have nothing to do with their points; None where
    there are none.
    """

    points_3d: FloatArray
    points_2d: FloatArray
    camera: Camera
    alignment: Alignment
    outliers: BoolArray | None


def simulate_problem(
    rng: np.random.Generator,
    *,
    points: int,
    noise_px: float,
    outlier_share: float = 0.0,
    camera: Camera = SIMULATION_CAMERA,
    depth: tuple[float, float] = (4.0, 8.0),
    stretch: tuple[float, float] = (0.5, 2.0),
) -> Problem:
    """Draw one problem of the paper's simulation.

    The object's points are uniform in the cube [-1, 1)^3 and the rotation is uniform. The model is
    the object with y and z divided by stretches drawn from ``stretch``, so the true scale is (1,
    s_y, s_z). The object's centre lies at a depth drawn from ``depth``, up to one unit off the
    optical axis. ``noise_px`` is the standard deviation of the Gaussian noise on each image
    coordinate; ``outlier_share`` of the observations, rounded to a whole number of them, are moved
    to anywhere in the image instead. All randomness comes from ``rng``.

    Examples
    --------
    >>> problem = simulate_problem(np.random.default_rng(0), points=8, noise_px=0.0)
    >>> reprojected = problem.camera.project(problem.alignment.apply(problem.points_3d))
    >>> bool(np.allclose(reprojected, problem.points_2d))
    True
    """
    scale = np.array([1.0, *rng.uniform(*stretch, 2)])
    translation = np.array([*rng.uniform(-1, 1, 2), rng.uniform(*depth)])
    alignment = Alignment(random_rotation(rng), translation, scale)
    points_3d = rng.uniform(-1, 1, (points, 3)) / scale
    points_2d = camera.project(alignment.apply(points_3d))
    points_2d = points_2d + noise_px * rng.standard_normal(points_2d.shape)
    count = round(outlier_share * points)
    if not count:
        return Problem(points_3d, points_2d, camera, alignment, None)
    outliers = np.zeros(points, dtype=bool)
    outliers[rng.choice(points, size=count, replace=False)] = True
    points_2d[outliers] = rng.uniform(-0.5, [camera.width - 0.5, camera.height - 0.5], (count, 2))
    return Problem(points_3d, points_2d, camera, alignment, outliers)


UNIT_BOUNDS: FloatArray = np.array([[-0.5] * 3, [0.5] * 3])
"""Lowest and highest coordinates of a unit cube."""


def simulate_standing_boxes(
    rng: np.random.Generator,
    *,
    objects: int,
    camera: Camera,
    camera_height: float = 1.6,
    points: int = 10,
    noise_px: float = 1.0,
) -> tuple[list[Problem], FloatArray]:
    """Draw objects that stand on the ground, 3 to 5 ahead of a camera that looks down at them.

    They have a unit cube's bounds, stretched. Returns the problem of each, and the direction (3,)
    against gravity in the camera.

    Examples
    --------
    >>> camera = Camera(640, 480, 700, 700, 319.5, 239.5)
    >>> boxes, up = simulate_standing_boxes(np.random.default_rng(0), objects=2, camera=camera)
    >>> lowest = [each.alignment.apply(UNIT_BOUNDS)[0] for each in boxes]
    >>> np.round([-up @ corner for corner in lowest], 6).tolist()
    [1.6, 1.6]
    """
    tilt = rotation_from_vector(np.array([rng.uniform(0.17, 0.5), 0.0, 0.0]))
    up: FloatArray = tilt @ [0.0, -1.0, 0.0]
    ahead = np.array([0.0, 0.0, 1.0]) - up * up[2]
    problems: list[Problem] = []
    while len(problems) < objects:
        model = rng.uniform(-0.5, 0.5, (points, 3))
        scale = np.array([1.0, *np.exp(rng.normal(0.0, 0.2, 2))])
        turn = rotation_from_vector(np.array([0.0, rng.uniform(0, 2 * np.pi), 0.0]))
        upright = tilt @ rotation_from_vector(np.array([np.pi, 0.0, 0.0]))
        place = rng.uniform(3, 5) * ahead / np.linalg.norm(ahead)
        place = place + [rng.uniform(-1, 1), 0.0, 0.0] - up * (camera_height - scale[1] / 2)
        pose = Alignment(upright @ turn, place, scale)
        pixels = camera.project(pose.apply(model))
        if camera.contains(pixels).all():
            pixels = pixels + noise_px * rng.normal(size=pixels.shape)
            problems.append(Problem(model, pixels, camera, pose, None))
    return problems, up


def random_rotation(rng: np.random.Generator) -> FloatArray:
    """A rotation matrix (3, 3), uniform over all rotations."""
    return rotation_from_quat_wxyz(rng.standard_normal(4))


@dataclass(frozen=True, eq=False)
class SimulatedTrack:
    """Frames of a video, the true ``poses`` (P,), and the object's ``points_3d`` (m, 3)."""

    views: tuple[View, ...]
    poses: tuple[Alignment, ...]
    points_3d: FloatArray
    ids: tuple[Hashable, ...]
    motion: Motion

    @property
    def times(self) -> FloatArray:
        """Times of the frames (P,) [s]."""
        return np.array([view.time for view in self.views], dtype=float)


def simulate_track(
    rng: np.random.Generator,
    points_3d: FloatArray,
    ids: Sequence[Hashable],
    *,
    frames: int,
    noise_px: float = 2.0,
    visible: float = 0.7,
    rate: float = 30.0,
    motion: Motion = USUAL_MOTION,
    camera: Camera = TRACK_CAMERA,
) -> SimulatedTrack:
    """Draw a video of an object whose acceleration is white noise.

    Each frame shows a random ``visible`` share of the keypoints, at least one, with Gaussian noise
    of ``noise_px``; ``rate`` is that of the frames [1/s]. A path that comes near the camera or the
    image's borders is drawn again; of long videos the motion's strengths are weakened such that one
    stays there.

    Raises
    ------
    ValueError
        If no path stays in the image.

    Examples
    --------
    >>> corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) - 0.5
    >>> track = simulate_track(np.random.default_rng(0), corners, range(8), frames=10)
    >>> len(track.views), len(track.views[0].ids)
    (10, 6)
    """
    seconds = frames / rate
    weak = Motion(
        motion.angular_sigma, min(motion.linear_sigma or 1.0, 0.6 / max(seconds, 1e-9) ** 1.5)
    )
    for _ in range(_TRIES):
        poses = _drawn_path(rng, frames, 1.0 / rate, weak.strength(np.ones(2)))
        if _stays(poses[:, 9:], camera):
            break
    else:
        raise ValueError("no path stays in the image")
    points = points_3d - points_3d.mean(axis=0)
    truth = tuple(
        Alignment(pose[:9].reshape(3, 3), pose[9:], np.ones(3)).apply(points) for pose in poses
    )
    count = max(round(visible * len(points)), 1)
    views = []
    for k, in_camera in enumerate(truth):
        seen = np.sort(rng.choice(len(points), count, replace=False))
        pixels = camera.project(in_camera[seen]) + rng.normal(0.0, noise_px, (count, 2))
        chosen = [ids[row] for row in seen]
        views.append(View(camera, pixels, ids=chosen, sigma=noise_px, time=k / rate))
    shift = points_3d.mean(axis=0)
    alignments = [
        Alignment(rotation, pose[9:] - rotation @ shift, np.ones(3))
        for pose in poses
        for rotation in [pose[:9].reshape(3, 3)]
    ]
    return SimulatedTrack(tuple(views), tuple(alignments), points_3d, tuple(ids), weak)


def _drawn_path(
    rng: np.random.Generator, frames: int, seconds: float, strength: FloatArray
) -> FloatArray:
    """Poses (P, 12) of a body whose velocity is a random walk."""
    step = seconds / _STEPS
    spread = np.repeat(strength, 3) * np.sqrt(step)
    translation = np.array([*rng.uniform(-0.3, 0.3, 2), _DEPTH])
    pose = np.concatenate([random_rotation(rng).ravel(), translation])
    velocity = rng.normal(size=6) * np.repeat([0.5, 0.1], 3)
    poses = [pose]
    for _ in range(frames - 1):
        for _ in range(_STEPS):
            changed = velocity + spread * rng.normal(size=6)
            pose = moved_by(pose, step * (velocity + changed) / 2)
            velocity = changed
        poses.append(pose)
    return np.array(poses)


def _stays(places: FloatArray, camera: Camera) -> bool:
    """True if the model's origin stays in the middle of the image at usual depths."""
    depths = places[:, 2]
    if depths.min() < _NEAREST or depths.max() > _FARTHEST:
        return False
    half = np.array([camera.width, camera.height]) / 2
    return bool((np.abs(camera.project(places) - half) < (1 - _MARGIN) * half).all())


def with_correlated_errors(
    track: SimulatedTrack, rng: np.random.Generator, *, noise_px: float, correlation: float
) -> SimulatedTrack:
    """The track with errors of each keypoint that are correlated from frame to frame.

    An autoregression of first order takes the place of independent noise, of the same standard
    deviation ``noise_px``.
    """
    rows = {name: row for row, name in enumerate(track.ids)}
    errors = rng.normal(size=(len(rows), 2))
    views = []
    for view, pose in zip(track.views, track.poses, strict=True):
        fresh = rng.normal(size=errors.shape)
        errors = correlation * errors + np.sqrt(1 - correlation**2) * fresh
        seen = [rows[name] for name in view.keypoint_ids]
        pixels = view.camera.project(pose.apply(track.points_3d[seen]))
        views.append(replace(view, points_2d=pixels + noise_px * errors[seen]))
    return replace(track, views=tuple(views))


def with_mistakes(
    track: SimulatedTrack,
    rng: np.random.Generator,
    *,
    flipped: float = 0.0,
    outliers: float = 0.0,
) -> SimulatedTrack:
    """The track with a share of its frames turned by 180 degrees, and keypoints moved anywhere.

    A flipped frame shows the object turned about the model's y axis, as a detector that takes front
    for rear does; outliers are uniform in the image.
    """
    half_turn = np.diag([-1.0, 1.0, -1.0])
    rows = {name: row for row, name in enumerate(track.ids)}
    centre = track.points_3d.mean(axis=0)
    wrong = set(rng.permutation(len(track.views))[: round(flipped * len(track.views))].tolist())
    views = []
    for k, (view, pose) in enumerate(zip(track.views, track.poses, strict=True)):
        pixels, camera = np.array(view.points_2d), view.camera
        seen = track.points_3d[[rows[name] for name in view.keypoint_ids]]
        if k in wrong:
            turned = (seen - centre) @ half_turn.T + centre
            pixels += camera.project(pose.apply(turned)) - camera.project(pose.apply(seen))
        moved = rng.random(len(pixels)) < outliers
        size = [camera.width - 0.5, camera.height - 0.5]
        pixels[moved] = rng.uniform(-0.5, size, (int(moved.sum()), 2))
        views.append(replace(view, points_2d=pixels))
    return replace(track, views=tuple(views))
