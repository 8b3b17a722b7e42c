"""Cameras that projections in PyTorch take."""

from __future__ import annotations

import pytest

pytest.importorskip("torch", reason='needs pip install -e ".[torch]"')
from cadalign import Camera
from cadalign.errors import InputError
from cadalign.torch.poses import calibrations

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


def test_calibrations_are_those_of_the_cameras() -> None:
    other = Camera(64, 48, 30.0, 31.0, 31.5, 24.5)
    assert calibrations(PLAIN, 5).tolist() == [[300.0, 310.0, 315.0, 245.0]]
    assert calibrations([PLAIN, other], 2).tolist()[1] == [30.0, 31.0, 31.5, 24.5]
