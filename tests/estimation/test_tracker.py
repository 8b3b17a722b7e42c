"""`cadalign.Tracker`: accuracy beside the whole track, gaps, mistakes, refusals."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from cadalign import (
    Alignment,
    Camera,
    Model,
    Motion,
    RansacOptions,
    ShapeModel,
    Tracker,
    View,
    align,
)
from cadalign.errors import InputError
from cadalign.estimation.tracks.tracker import TrackUpdate
from cadalign.evaluation.simulated_tracks import SimulatedTrack, simulate_track, with_mistakes
from cadalign.geometry.rotations import angle_between, rotation_from_vector

pytestmark = pytest.mark.slow

POINTS = 10


def category() -> ShapeModel:
    rng = np.random.default_rng(0)
    mean, modes = rng.uniform(-0.4, 0.4, (POINTS, 3)), 0.05 * rng.normal(size=(5, POINTS, 3))
    return ShapeModel.from_basis(mean, modes, np.ones(5), ids=list(range(POINTS)))


CATEGORY = category()


def video(seed: int, frames: int) -> SimulatedTrack:
    rng = np.random.default_rng(seed)
    component = CATEGORY.components[0]
    shape = component.mean + np.tensordot(rng.normal(size=5), component.modes, 1)
    return simulate_track(rng, shape[:POINTS], range(POINTS), frames=frames)


def errors(updates: list[TrackUpdate], track: SimulatedTrack) -> np.ndarray:
    """Rotation errors [deg], NaN where there is no pose."""
    return np.array(
        [
            np.nan
            if update.pose is None
            else angle_between(update.pose.alignment.rotation, pose.rotation)
            for update, pose in zip(updates, track.poses, strict=True)
        ]
    )


@pytest.mark.parametrize("seed", [0, 1])
def test_the_newest_frame_is_better_than_frame_by_frame_with_a_shared_shape(seed: int) -> None:
    track = video(seed, 80)
    tracker = Tracker(CATEGORY)
    online = errors([tracker.update(view) for view in track.views], track)
    views = align(CATEGORY, track.views).views
    joint = [
        angle_between(v.alignment.rotation, p.rotation)
        for v, p in zip(views, track.poses, strict=True)
    ]
    assert np.isfinite(online[10:]).all()
    assert np.median(online[20:]) < 1.1 * np.median(joint)
    assert not tracker.is_lost
    whole = tracker.smooth()
    assert len(whole.views) == 80
    assert tracker.points_3d == pytest.approx(whole.points_3d, abs=0.03)


def test_the_strength_of_the_motion_becomes_that_of_the_whole_track() -> None:
    track = video(1, 80)
    tracker = Tracker(CATEGORY)
    strengths = []
    for view in track.views:
        tracker.update(view)
        if tracker._window is not None:
            strengths.append(tracker._window.prior.strength)
    motion = tracker.smooth().trajectory.motion
    whole = motion.strength(np.full(2, np.nan))
    assert (strengths[0] > 2 * whole).all(), "a few frames do not show it"
    assert strengths[-1] == pytest.approx(whole, rel=0.3)
    given = Tracker(CATEGORY, motion=Motion(angular_sigma=20.0))
    for view in track.views[:20]:
        given.update(view)
    assert given._window is not None
    assert np.degrees(given._window.prior.strength[0]) == pytest.approx(20.0)


def test_flipped_frames_and_outliers_do_not_lose_the_object() -> None:
    track = video(2, 80)
    wrong = with_mistakes(track, np.random.default_rng(2), flipped=0.1, outliers=0.2)
    tracker = Tracker(CATEGORY, ransac=RansacOptions())
    updates = [tracker.update(view) for view in wrong.views]
    assert np.nanmax(errors(updates, track)[10:]) < 8.0
    assert not any(update.is_lost for update in updates[14:])


def test_an_object_that_is_gone_is_lost_and_found_again() -> None:
    track = video(3, 120)
    views = [
        replace(view, points_2d=(), ids=()) if 40 <= k < 100 else view
        for k, view in enumerate(track.views)
    ]
    tracker = Tracker(CATEGORY)
    updates = [tracker.update(view) for view in views]
    assert updates[99].is_lost
    assert not updates[105].is_lost
    assert not any(update.is_lost for update in updates if update.is_new)
    assert errors(updates, track)[105:].max() < 5.0
    in_gap, before = updates[60].pose, updates[39].pose
    assert in_gap is not None
    assert before is not None
    assert in_gap.rotation_std_deg > 3 * before.rotation_std_deg


def test_an_object_that_jumps_is_reported_and_found_again() -> None:
    track, other = video(4, 60), video(5, 60)
    later = [
        replace(view, points_2d=view.camera.project(pose.apply(track.points_3d)), ids=range(POINTS))
        for view, pose in zip(other.views, other.poses, strict=True)
    ]
    views = [*track.views[:30], *later[30:]]
    tracker = Tracker(CATEGORY)
    updates = [tracker.update(view) for view in views]
    assert any(update.is_new for update in updates[31:]) or not updates[-1].is_lost
    last = updates[-1].pose
    assert last is not None
    assert angle_between(last.alignment.rotation, other.poses[-1].rotation) < 5.0


def test_keypoints_that_fit_no_pose_lose_the_object_until_others_do() -> None:
    rng, track = np.random.default_rng(1), video(4, 60)
    views = [
        replace(view, points_2d=rng.uniform(0, 400, (POINTS, 2)), ids=range(POINTS))
        if 30 <= k < 46
        else view
        for k, view in enumerate(track.views)
    ]
    tracker = Tracker(CATEGORY)
    updates = [tracker.update(view) for view in views]
    lost = [k for k, update in enumerate(updates) if update.is_lost and k > 10]
    assert lost[0] == 33, "four frames in a row that contradict the track"
    assert lost == list(range(33, lost[-1] + 1)), "no track of such keypoints begins"
    assert lost[-1] < 59
    assert not updates[-1].is_lost
    last = updates[-1].pose
    assert last is not None
    assert angle_between(last.alignment.rotation, track.poses[-1].rotation) < 8.0


def test_too_few_frames_have_no_pose() -> None:
    tracker = Tracker(CATEGORY)
    update = tracker.update(video(0, 2).views[0])
    assert update.pose is None
    assert update.is_lost
    assert tracker.points_3d is None


POINTS_3D = np.random.default_rng(0).uniform(-0.5, 0.5, (POINTS, 3))
BOX = Model(points_3d=POINTS_3D, stretch="none")
CAMERA = Camera(640, 480, 900, 900, 319.5, 239.5)


def moving(k: int) -> Alignment:
    turn = rotation_from_vector(np.array([0.1, 0.02 * k, 0.05])) @ np.diag([-1.0, -1.0, 1.0])
    return Alignment(turn, [0.3 + 0.01 * k, 0.2, 6.0], np.ones(3))


def seen(k: int, rng: np.random.Generator, noise_px: float = 1.0, **more: Any) -> View:
    pixels = CAMERA.project(moving(k).apply(POINTS_3D))
    return View(CAMERA, pixels + noise_px * rng.normal(size=pixels.shape), time=k / 30, **more)


@pytest.mark.parametrize("kind", ["up", "camera_height", "depth", "depth image"])
def test_further_evidence_counts_as_for_the_whole_track(kind: str) -> None:
    def more(k: int) -> dict[str, Any]:
        pose = moving(k)
        up = pose.rotation[:, 1]
        if kind == "up":
            return {"up": up, "up_sigma_deg": 0.3}
        if kind == "camera_height":
            lowest = pose.apply([[0.0, POINTS_3D[:, 1].min(), 0.0]])[0]
            return {"up": up, "camera_height": float(-up @ lowest)}
        depth = pose.apply(POINTS_3D)[:, 2]
        if kind == "depth":
            return {"depth": depth, "depth_sigma": 0.005}
        image = np.zeros((480, 640))
        for (u, v), z in zip(CAMERA.project(pose.apply(POINTS_3D)), depth, strict=True):
            image[round(v) - 3 : round(v) + 4, round(u) - 3 : round(u) + 4] = z
        return {"depth": image}

    rng = np.random.default_rng(1)
    tracker = Tracker(BOX)
    for k in range(35):
        newest = tracker.update(seen(k, rng, **more(k)))
    whole = tracker.smooth().views[-1]
    assert newest.pose is not None
    assert whole.std is not None
    assert newest.inliers.all()
    assert angle_between(newest.pose.alignment.rotation, whole.alignment.rotation) < 0.3
    assert newest.pose.rotation_std_deg == pytest.approx(whole.std.rotation_deg, rel=0.2)
    off = newest.pose.alignment.translation - whole.alignment.translation
    assert (np.abs(off) < whole.std.translation).all()


def test_noise_that_is_not_given_is_estimated() -> None:
    rng = np.random.default_rng(1)
    tracker, told = Tracker(BOX), Tracker(BOX)
    for k in range(20):
        view = seen(k, rng, noise_px=6.0, sigma=6.0)
        known = told.update(view)
        newest = tracker.update(replace(view, sigma=None))
    assert known.pose is not None
    assert newest.pose is not None
    assert newest.inliers.all()
    assert newest.pose.rotation_std_deg == pytest.approx(known.pose.rotation_std_deg, rel=0.3)


def test_a_view_that_is_refused_leaves_the_track_as_it_was() -> None:
    rng = np.random.default_rng(1)
    views = [seen(k, rng) for k in range(12)]
    whole, tracker = Tracker(BOX), Tracker(BOX)
    for k, view in enumerate(views):
        expected = whole.update(view)
        for change, message in {
            "ids": r"view.ids: the model has no keypoint 99; the model has 0, 1, 2",
            "camera": "camera: the focal length is unknown",
            "cam_from_rig": r"view.cam_from_rig: only some views have a known pose",
        }.items():
            wrong = {"ids": [*range(9), 99], "camera": Camera.without_focal(640, 480)}
            given = wrong | {"cam_from_rig": np.eye(4)}
            if change != "cam_from_rig" or k > 0:
                with pytest.raises(InputError, match=message):
                    tracker.update(replace(view, **{change: given[change]}))
        newest = tracker.update(view)
    assert len(tracker.views) == 12
    assert newest.pose is not None
    assert expected.pose is not None
    assert (newest.pose.alignment.rotation == expected.pose.alignment.rotation).all()


def test_bad_arguments_are_refused() -> None:
    with pytest.raises(InputError, match=r"ransac: expected a cadalign.RansacOptions, got bool"):
        Tracker(CATEGORY, ransac=True)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="lag: 1 is not a whole number from 3 on"):
        Tracker(CATEGORY, lag=1)
    camera = Camera(640, 480, 600, 600, 319.5, 239.5)
    tracker = Tracker(CATEGORY)
    with pytest.raises(InputError, match=r"view.time: a tracked view needs one; give seconds"):
        tracker.update(View(camera))
    tracker.update(View(camera, time=1.0))
    with pytest.raises(InputError, match=r"view.time: 0.5 is not later than 1.0"):
        tracker.update(View(camera, time=0.5))
