"""Errors of a detector that successive frames have in common: found, and taken into account."""

from __future__ import annotations

import numpy as np
import pytest

from cadalign import ShapeModel, Tracker, align
from cadalign.estimation.result import Result
from cadalign.estimation.tracks.frames import SuccessiveErrors
from cadalign.evaluation.simulated_tracks import (
    SimulatedTrack,
    simulate_track,
    with_correlated_errors,
)
from cadalign.geometry.rotations import vector_from_rotation

POINTS, FRAMES, VIDEOS = 10, 50, 6
OF_95 = 7.815  # squared radius, three degrees of freedom

rng = np.random.default_rng(0)
MEAN, MODES = rng.uniform(-0.4, 0.4, (POINTS, 3)), 0.05 * rng.normal(size=(5, POINTS, 3))
SHAPE = ShapeModel.from_basis(MEAN, MODES, np.ones(5), ids=range(POINTS))


def video(seed: int, correlation: float) -> SimulatedTrack:
    rng = np.random.default_rng(seed)
    points = MEAN + np.tensordot(rng.normal(size=5), MODES, 1)
    track = simulate_track(rng, points, range(POINTS), frames=FRAMES)
    return with_correlated_errors(track, rng, noise_px=2.0, correlation=correlation)


def inside(result: Result, track: SimulatedTrack) -> list[bool]:
    """Whether the stated 95 % regions hold the rotations of all frames."""
    held = []
    for view, pose in zip(result.views, track.poses, strict=True):
        turn = vector_from_rotation(view.alignment.rotation @ pose.rotation.T)
        assert view.covariance is not None
        held.append(bool(turn @ np.linalg.solve(view.covariance[:3, :3], turn) < OF_95))
    return held


def test_correlated_errors_of_a_simulated_video_are_those_asked_for() -> None:
    track = video(0, 0.8)
    errors = np.full((FRAMES, POINTS, 2), np.nan)
    for k, (view, pose) in enumerate(zip(track.views, track.poses, strict=True)):
        rows = [int(str(name)) for name in view.keypoint_ids]
        errors[k, rows] = view.points_2d - view.camera.project(pose.apply(track.points_3d[rows]))
    assert np.nanstd(errors) == pytest.approx(2.0, rel=0.2)
    products = np.nanmean(errors[1:] * errors[:-1]) / np.nanmean(errors**2)
    assert products == pytest.approx(0.8, abs=0.12)


@pytest.mark.slow
@pytest.mark.parametrize("correlation", [0.0, 0.6, 0.9])
def test_regions_hold_the_truth_whatever_the_correlation(correlation: float) -> None:
    """Without the correlation in the noise model they hold 72 % at 0.6, and 47 % at 0.9."""
    tracks = [video(seed, correlation) for seed in range(VIDEOS)]
    results = [align(SHAPE, track.views, motion="smooth") for track in tracks]
    found = [each.trajectory.correlation for each in results if each.trajectory is not None]
    assert abs(float(np.mean(found)) - correlation) < 0.2
    held = [inside(*pair) for pair in zip(results, tracks, strict=True)]
    assert 0.85 < np.mean(held) <= 1


@pytest.mark.slow
def test_the_online_estimate_learns_the_correlation() -> None:
    stds = []
    for correlation in (0.0, 0.9):
        tracker = Tracker(SHAPE)
        for view in video(3, correlation).views:
            newest = tracker.update(view)
        assert newest.pose is not None
        stds.append(newest.pose.rotation_std_deg)
    assert stds[1] > 1.3 * stds[0]


def test_a_few_pairs_are_no_correlation() -> None:
    assert SuccessiveErrors().correlation == 0
    assert SuccessiveErrors(0.5, 1.0, 4).correlation == 0
    assert SuccessiveErrors(0.5, 1.0, 400).correlation == 0.5
    assert SuccessiveErrors(-0.5, 1.0, 400).correlation == 0
    assert SuccessiveErrors(3.0, 4.0, 200).correlation == pytest.approx(0.75)
