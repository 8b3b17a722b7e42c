"""Simulated videos with a known answer: an object that moves smoothly, with missed keypoints."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.estimation.tracks.motion import Motion, moved_by
from cadalign.estimation.view import View
from cadalign.evaluation.simulation import random_rotation
from cadalign.geometry.alignment import Alignment
from cadalign.geometry.camera import Camera

TRACK_CAMERA = Camera(width=640, height=480, fx=600.0, fy=600.0, cx=319.5, cy=239.5)
USUAL_MOTION = Motion(angular_sigma=20.0, linear_sigma=0.15)
"""Strengths of the simulated accelerations, of an object of about unit size."""
_DEPTH = 2.5
_STEPS = 4  # of the motion, between frames
_MARGIN = 0.5  # of the model's origin from the image's borders, over half its size
_NEAREST, _FARTHEST = 1.5, 5.0  # depths of the origin
_TRIES = 200


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
