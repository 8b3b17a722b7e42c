"""Absolute and relative errors of trajectories: invariances and known values."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cadalign.errors import InputError
from cadalign.estimation.tracks.motion import moved_by
from cadalign.evaluation.metrics.errors import (
    absolute_pose_error,
    count_flips,
    relative_pose_error,
    rotation_jitter_deg,
)
from cadalign.export.camera_files import write_tum

ORIGIN = np.concatenate([np.eye(3).ravel(), np.zeros(3)])


def screw(twist: np.ndarray, frames: int = 12) -> np.ndarray:
    return np.array([moved_by(ORIGIN, k * twist) for k in range(frames)])


def placed(poses: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """Poses in another frame."""
    turn = motion[:9].reshape(3, 3)
    rotations = (turn @ poses[:, :9].reshape(-1, 3, 3)).reshape(-1, 9)
    return np.concatenate([rotations, poses[:, 9:] @ turn.T + motion[9:]], axis=1)


def test_the_errors_of_the_truth_are_zero() -> None:
    poses = screw(np.array([0.1, 0.2, 0.0, 0.3, 0.0, 0.1]))
    assert absolute_pose_error(est=poses, gt=poses).translation == 0
    assert relative_pose_error(est=poses, gt=poses, step=3).rotation_deg < 1e-5
    assert count_flips(est=poses, gt=poses) == 0


def test_relative_errors_do_not_depend_on_the_frame() -> None:
    poses = screw(np.array([0.1, 0.2, 0.0, 0.3, 0.0, 0.1]))
    other = screw(np.array([0.1, 0.25, 0.0, 0.3, 0.1, 0.1]))
    moved = placed(other, moved_by(ORIGIN, np.array([0.5, 1.0, -0.3, 2.0, 1.0, 0.0])))
    errors = [relative_pose_error(est=each, gt=poses, step=2) for each in (other, moved)]
    assert errors[0].rotation_deg == pytest.approx(errors[1].rotation_deg, rel=1e-6)
    assert errors[0].translation == pytest.approx(errors[1].translation, rel=1e-9)
    assert absolute_pose_error(est=moved, gt=other).translation > 1.0


def test_a_constant_twist_has_no_jitter_and_noise_has() -> None:
    poses = screw(np.array([0.1, 0.2, 0.0, 0.3, 0.0, 0.1]))
    assert rotation_jitter_deg(poses) < 1e-5
    rng = np.random.default_rng(0)
    noisy = np.array([moved_by(each, 0.01 * rng.normal(size=6)) for each in poses])
    assert rotation_jitter_deg(noisy) == pytest.approx(np.degrees(0.01 * np.sqrt(6)), rel=0.3)


def test_motions_over_frames_without_a_pose_do_not_count() -> None:
    poses = screw(np.array([0.1, 0.2, 0.0, 0.3, 0.0, 0.1]))
    other = screw(np.array([0.1, 0.25, 0.0, 0.3, 0.1, 0.1]))
    whole = relative_pose_error(est=other, gt=poses)
    other[[4, 5, 8]] = np.nan
    assert rotation_jitter_deg(other) < 1e-5
    lost = relative_pose_error(est=other, gt=poses)
    assert (lost.rotation_deg, lost.translation) == pytest.approx(
        (whole.rotation_deg, whole.translation), rel=1e-9
    )
    other[1::2] = np.nan
    with pytest.raises(InputError, match="no two frames that far apart have a pose"):
        relative_pose_error(est=other, gt=poses)
    with pytest.raises(InputError, match="no three successive frames have a pose"):
        rotation_jitter_deg(other)


def test_half_turns_are_flips() -> None:
    poses = screw(np.zeros(6), frames=4)
    wrong = poses.copy()
    wrong[1] = moved_by(wrong[1], np.array([0.0, np.pi, 0.0, 0.0, 0.0, 0.0]))
    assert count_flips(est=wrong, gt=poses) == 1


def test_other_frames_than_true_ones_are_refused() -> None:
    poses = screw(np.zeros(6), frames=4)
    with pytest.raises(InputError, match="est: 3 poses for 4 true ones"):
        absolute_pose_error(est=poses[:3], gt=poses)
    with pytest.raises(InputError, match="est: 4 poses, but 6 are needed"):
        relative_pose_error(est=poses, gt=poses, step=5)


@pytest.mark.slow
def test_pose_errors_are_those_of_evo_on_the_same_files(tmp_path: Path) -> None:
    """TUM files of a trajectory and its truth, frames matched by their times."""
    reason = "evo, the reference implementation of trajectory errors, is not installed"
    evo = pytest.importorskip("evo.core.metrics", reason=reason)
    from evo.core import sync
    from evo.core.units import Unit
    from evo.tools import file_interface

    rng = np.random.default_rng(4)
    times = np.arange(60) / 30.0
    gt = screw(np.array([0.05, -0.02, 0.05, 0.1, 0.0, 0.03]), frames=len(times))
    est = np.array([moved_by(pose, 0.05 * rng.normal(size=6)) for pose in gt])
    for name, poses in (("est", est), ("gt", gt)):
        write_tum(tmp_path / f"{name}.tum", times, poses)
    read = [file_interface.read_tum_trajectory_file(tmp_path / f"{n}.tum") for n in ("gt", "est")]
    pair = sync.associate_trajectories(*read)
    parts = (evo.PoseRelation.rotation_angle_deg, evo.PoseRelation.translation_part)

    def rms(metric: object) -> float:
        metric.process_data(pair)  # type: ignore[attr-defined]
        return float(metric.get_statistic(evo.StatisticsType.rmse))  # type: ignore[attr-defined]

    absolute = absolute_pose_error(est=est, gt=gt)
    assert [rms(evo.APE(part)) for part in parts] == pytest.approx(
        [absolute.rotation_deg, absolute.translation], rel=1e-6
    )
    for step in (1, 10):
        relative = relative_pose_error(est=est, gt=gt, step=step)
        found = [
            rms(evo.RPE(part, delta=step, delta_unit=Unit.frames, all_pairs=True)) for part in parts
        ]
        assert found == pytest.approx([relative.rotation_deg, relative.translation], rel=1e-6)
