"""Cameras that projections in PyTorch take."""

from __future__ import annotations

import pytest

from cadalign import Camera
from cadalign.errors import InputError

torch = pytest.importorskip("torch", reason='needs pip install -e ".[torch]"')
from cadalign.torch import PoseBatch, reprojection_loss  # noqa: E402
from cadalign.torch.poses import calibrations  # noqa: E402

PLAIN = Camera(640, 480, 300.0, 310.0, 315.0, 245.0)


@pytest.mark.parametrize(
    "lens",
    [
        Camera(640, 480, 300.0, 310.0, 315.0, 245.0, (-0.2, 0.05, 0.0, 0.0)),
        Camera(640, 480, 300.0, 310.0, 315.0, 245.0, (), lens="fisheye"),
    ],
)
def test_cameras_that_bend_straight_lines_are_refused(lens: Camera) -> None:
    """Those of a wide lens, too, whose distortion is not stated."""
    with pytest.raises(InputError, match="camera: projections in PyTorch know no lens distortion"):
        calibrations([PLAIN, lens], 2)


def test_unknown_focal_lengths_are_refused_where_poses_have_none() -> None:
    unknown = Camera.without_focal(640, 480)
    pose = torch.eye(3)[None], torch.tensor([[0.0, 0.0, 4.0]]), torch.ones(1, 3)
    estimated = PoseBatch(*pose, focal=torch.tensor([400.0]))
    found = estimated.project(torch.tensor([[1.0, 0.0, 0.0]]), unknown)
    assert found[0].tolist() == [[419.5, 239.5]]
    with pytest.raises(InputError, match="camera: the focal length is unknown"):
        reprojection_loss(estimated, PoseBatch(*pose), torch.eye(3), unknown)


def test_calibrations_are_those_of_the_cameras() -> None:
    other = Camera(64, 48, 30.0, 31.0, 31.5, 24.5)
    assert calibrations(PLAIN, 5).tolist() == [[300.0, 310.0, 315.0, 245.0]]
    assert calibrations([PLAIN, other], 2).tolist()[1] == [30.0, 31.0, 31.5, 24.5]
