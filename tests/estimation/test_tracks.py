"""`cadalign.align` with a motion: accuracy, gaps, outliers, times, refusals."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from cadalign import Motion, RansacOptions, Result, ShapeModel, View, align
from cadalign.errors import DegenerateError, InputError
from cadalign.evaluation.simulated_tracks import SimulatedTrack, simulate_track, with_mistakes
from cadalign.geometry.rotations import angle_between, vector_from_rotation

pytestmark = pytest.mark.slow

POINTS, MODES = 10, 5
CHI_SQUARE_95 = 7.81  # of three degrees of freedom


def category(seed: int = 0) -> ShapeModel:
    rng = np.random.default_rng(seed)
    mean = rng.uniform(-0.4, 0.4, (POINTS, 3))
    modes = 0.05 * rng.normal(size=(MODES, POINTS, 3))
    return ShapeModel.from_basis(mean, modes, np.ones(MODES), ids=list(range(POINTS)))


CATEGORY = category()


def track_of(seed: int, frames: int = 40, **options: float) -> SimulatedTrack:
    rng = np.random.default_rng(seed)
    component = CATEGORY.components[0]
    shape = component.mean + np.tensordot(rng.normal(size=MODES), component.modes, 1)
    return simulate_track(rng, shape[:POINTS], range(POINTS), frames=frames, **options)


def errors(result: Result, track: SimulatedTrack) -> np.ndarray:
    """Rotation errors [deg] of all frames."""
    pairs = zip(result.views, track.poses, strict=True)
    return np.array([angle_between(v.alignment.rotation, pose.rotation) for v, pose in pairs])


def test_motion_improves_every_quantile_and_is_covered_by_the_stated_regions() -> None:
    with_motion, without, covered = [], [], []
    for seed in range(12):
        track = track_of(seed, frames=25)
        smooth = align(CATEGORY, track.views, motion="smooth")
        with_motion.append(errors(smooth, track))
        without.append(errors(align(CATEGORY, track.views), track))
        for view, pose in zip(smooth.views, track.poses, strict=True):
            turn = vector_from_rotation(view.alignment.rotation @ pose.rotation.T)
            assert view.covariance is not None
            covered.append(turn @ np.linalg.solve(view.covariance[:3, :3], turn) < CHI_SQUARE_95)
        assert not smooth.warnings
    assert np.median(with_motion) < 0.8 * np.median(without)
    assert np.quantile(with_motion, 0.9) < 0.8 * np.quantile(without, 0.9)
    assert 0.85 < np.mean(covered) < 1.0


def test_components_of_a_shape_that_are_as_likely_widen_what_is_stated() -> None:
    (small,) = CATEGORY.components
    large = replace(small, mean=1.1 * small.mean)  # no photo distinguishes sizes
    both = replace(CATEGORY, components=(replace(small, weight=0.6), replace(large, weight=0.4)))
    views = track_of(3, frames=25).views
    alone = align(CATEGORY, views, motion="smooth")
    result = align(both, views, motion="smooth")
    assert result.component == 0
    assert alone.covariance is not None
    assert result.covariance is not None
    spread = [
        float(np.sqrt(each.covariance[5, 5])) / each.alignment.translation[2]
        for each in (alone, result)
    ]
    assert spread[0] < 0.03
    assert 0.03 < spread[1] < 0.07  # of two distances that differ by a tenth


def test_the_strength_of_the_motion_is_estimated() -> None:
    found = [
        align(CATEGORY, track.views, motion="smooth").trajectory.motion  # type: ignore[union-attr]
        for track in (track_of(seed, frames=80) for seed in range(4))
    ]
    angular = np.array([motion.angular_sigma for motion in found], dtype=float)
    assert 10.0 < np.exp(np.log(angular).mean()) < 40.0  # of 20


def test_frames_without_keypoints_take_part_and_are_less_certain() -> None:
    track = track_of(1, frames=60)
    views = [
        replace(view, points_2d=(), ids=()) if 25 <= k < 35 else view
        for k, view in enumerate(track.views)
    ]
    views[50] = replace(
        views[50], points_2d=np.asarray(views[50].points_2d)[:1], ids=views[50].keypoint_ids[:1]
    )
    result = align(CATEGORY, views, motion="smooth")
    assert errors(result, track).max() < 8.0
    in_gap, beside = result.views[30].std, result.views[20].std
    assert in_gap is not None
    assert beside is not None
    assert in_gap.rotation_deg > 1.2 * beside.rotation_deg


@pytest.mark.parametrize("seed", [2, 3])
def test_flipped_frames_and_outliers_are_resolved_by_their_neighbours(seed: int) -> None:
    track = track_of(seed, frames=60)
    rng = np.random.default_rng(seed)
    clean = errors(align(CATEGORY, track.views, motion="smooth"), track)
    wrong = with_mistakes(track, rng, flipped=0.1, outliers=0.2)
    result = align(CATEGORY, wrong.views, motion="smooth", ransac=RansacOptions())
    assert np.median(errors(result, track)) < 1.5 * np.median(clean) + 0.2
    assert errors(result, track).max() < 3 * clean.max() + 1.0


def test_a_swap_of_two_keypoints_in_many_frames_is_found() -> None:
    track = track_of(4, frames=80)
    views = [_swapped(view) if 20 <= k < 50 else view for k, view in enumerate(track.views)]
    result = align(CATEGORY, views, motion="smooth", ransac=RansacOptions())
    rejected = [
        name
        for view in result.views[20:50]
        for name, kept in zip(view.ids, view.inliers, strict=True)
        if not kept
    ]
    assert set(rejected) <= {0, 1, *rejected}
    wrong = sum({0, 1} <= set(view.keypoint_ids) for view in views[20:50])
    assert rejected.count(0) >= 0.9 * wrong
    assert errors(result, track).max() < 5.0


def _swapped(view: View) -> View:
    ids, pixels = list(view.keypoint_ids), np.array(view.points_2d)
    if 0 in ids and 1 in ids:
        rows = [ids.index(0), ids.index(1)]
        pixels[rows] = pixels[rows[::-1]]
    return replace(view, points_2d=pixels)


def still_views(seed: int, frames: int = 10) -> list[View]:
    """Frames of an object that does not move."""
    track = track_of(seed, frames=2)
    pose, (first, *_) = track.poses[0], track.views
    rng = np.random.default_rng(seed)
    pixels = first.camera.project(pose.apply(track.points_3d))
    return [
        View(first.camera, pixels + rng.normal(size=pixels.shape), ids=range(POINTS), time=k / 30)
        for k in range(frames)
    ]


@pytest.mark.parametrize("strength", [1e-2, 1e-5, 1e-8, 1e-12])
def test_a_weak_motion_states_what_all_frames_determine(strength: float) -> None:
    views = still_views(5)
    alone = align(CATEGORY, views[:1]).std.rotation_deg
    moving = align(CATEGORY, views, motion=Motion(strength, strength / 50))
    stated = [view.std.rotation_deg for view in moving.views]
    assert alone / np.sqrt(10) * 0.9 < min(stated)
    assert max(stated) < alone


def test_equal_frames_state_no_more_than_one() -> None:
    views = still_views(5)
    alone = align(CATEGORY, views[:1]).std.rotation_deg
    same = [replace(views[0], time=k / 30) for k in range(10)]
    assert align(CATEGORY, same, motion="smooth").std.rotation_deg > 0.8 * alone


def test_one_frame_with_keypoints_determines_no_motion() -> None:
    views = still_views(5)[:1] + [View(still_views(5)[0].camera, time=k / 30) for k in (1, 2)]
    with pytest.raises(DegenerateError, match="keypoints, in two frames at least"):
        align(CATEGORY, views, motion="smooth")


def test_poses_between_frames_and_beyond_them() -> None:
    track = track_of(5, frames=61)
    every_third = track.views[::3]
    result = align(CATEGORY, every_third, motion="smooth")
    assert result.trajectory is not None
    path = result.trajectory
    for k in (1, 20, 40):
        found = path.at(track.times[k])
        assert angle_between(found.alignment.rotation, track.poses[k].rotation) < 4.0
        assert found.velocity.shape == (6,)
    inside, beyond = path.at(0.05), path.at(track.times[-1] + 0.5)
    assert beyond.rotation_std_deg > 2 * inside.rotation_std_deg
    at_frame = path.at(track.times[30])
    assert at_frame.alignment.rotation == pytest.approx(result.views[10].alignment.rotation)
    near = path.at(track.times[30] + 1e-7)
    assert near.covariance == pytest.approx(at_frame.covariance, rel=1e-3, abs=1e-9)
    with pytest.raises(InputError, match=r"time: nan is not a finite number"):
        path.at(float("nan"))

    document = json.loads(json.dumps(result.to_dict(), allow_nan=False))
    read = Result.from_dict(document)
    assert read.to_dict() == result.to_dict()
    assert read.trajectory is not None
    assert read.trajectory.at(0.05).covariance == pytest.approx(inside.covariance)
    given = document["trajectory"]
    for wrong, message in (
        ({"times": given["times"][::-1]}, r"result: trajectory.times: expected increasing times"),
        ({"poses": given["poses"][1:]}, r"result: trajectory.poses: shape"),
    ):
        with pytest.raises(InputError, match=message):
            Result.from_dict(document | {"trajectory": given | wrong})
    del document["trajectory"]  # as of files before it was one of their fields
    assert Result.from_dict(document).trajectory is None


def test_views_of_one_time_share_a_pose_and_tell_the_size() -> None:
    track = track_of(6, frames=30)
    beside = np.eye(4)
    beside[0, 3] = -0.5
    views = [
        replace(view, cam_from_rig=motion, points_2d=view.camera.project(placed), ids=range(POINTS))
        for view, pose in zip(track.views, track.poses, strict=True)
        for motion in (np.eye(4), beside)
        for placed in [pose.apply(track.points_3d) * 1.5 + motion[:3, 3]]
    ]
    result = align(CATEGORY, views, motion="smooth")
    assert result.trajectory is not None
    assert len(result.trajectory) == 30
    assert np.ptp(result.stretch / 1.5) < 0.5
    assert result.trajectory.translations[0] == pytest.approx(
        1.5 * track.poses[0].translation, rel=0.05, abs=0.05
    )


def test_a_camera_that_moves_and_is_known_leaves_the_motion_of_the_object() -> None:
    track = track_of(7, frames=40)
    views = []
    for k, view in enumerate(track.views):
        shake = np.eye(4)
        shake[:3, 3] = 0.2 * np.sin([3.0 * k, 2.0 * k, 5.0 * k])
        seen = track.poses[k].apply(track.points_3d) + shake[:3, 3]
        rows = list(view.keypoint_ids)
        pixels = view.camera.project(seen[rows])
        views.append(replace(view, points_2d=pixels, cam_from_rig=shake))
    result = align(CATEGORY, views, motion="smooth")
    assert result.trajectory is not None
    gaps = result.trajectory.translations - [pose.translation for pose in track.poses]
    assert np.abs(gaps).max() < 0.1


def test_time_is_linear_in_frames_by_the_work_done() -> None:
    result = align(CATEGORY, track_of(8, frames=300).views, motion="smooth")
    assert result.stats.seconds < 10.0  # 0.5 s on an idle machine


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"motion": "rough"}, "motion: 'rough' is no motion"),
        ({"motion": 3}, "motion: 3 is no motion"),
    ],
)
def test_what_is_no_motion_is_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        align(CATEGORY, track_of(0, frames=3).views, **change)  # type: ignore[arg-type]


def test_contributions_are_refused_as_what_a_motion_does_not_have() -> None:
    result = align(CATEGORY, track_of(0, frames=3).views, motion="smooth")
    with pytest.raises(InputError, match="contributions: an estimate with a motion has none"):
        result.contributions()


def test_times_that_do_not_tell_the_frames_are_refused() -> None:
    views = track_of(0, frames=3).views
    with pytest.raises(InputError, match=r"views\[1\].time: only some views have a time"):
        align(CATEGORY, [views[0], replace(views[1], time=None)], motion="smooth")
    with pytest.raises(InputError, match="views: all views have the same time"):
        align(CATEGORY, [views[0], views[0]], motion="smooth")
    with pytest.raises(InputError, match="angular_sigma"):
        Motion(angular_sigma=-1.0)
    with pytest.raises(InputError, match="time: 'now' is not a finite number"):
        replace(views[0], time="now")  # type: ignore[arg-type]


def test_few_frames_with_keypoints_tell_how_strong_the_motion_is() -> None:
    # The first path is straight between them, as if nothing ever changed there.
    between, stated = [], []
    for seed in range(6):
        track = track_of(seed, frames=60)
        views = [
            view if number % 10 == 0 else replace(view, points_2d=(), ids=None, sigma=1.0)
            for number, view in enumerate(track.views)
        ]
        result = align(CATEGORY, views, motion="smooth")
        assert result.rms < 4
        between.append(errors(result, track))
        stated.append([view.std.rotation_deg for view in result.views if view.std is not None])
    assert 0.4 < np.sqrt(np.mean(np.square(between)) / np.mean(np.square(stated))) < 2
