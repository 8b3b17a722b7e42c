"""Inflation by the number of given keypoints."""

from __future__ import annotations

import pytest

from cadalign.errors import InputError
from cadalign.shapes.parts import FEW, FewKeypoints, inflation_with


def test_the_whole_inflation_stands_from_the_typical_number_on() -> None:
    few = FewKeypoints(typical=12.0, share=0.7)
    assert inflation_with(12, 1.5, few) == inflation_with(100, 1.5, few) == 1.5
    assert inflation_with(3, 1.5, few) == inflation_with(FEW, 1.5, few) == pytest.approx(1.05)
    assert 1.05 < inflation_with(8, 1.5, few) < inflation_with(10, 1.5, few) < 1.5


def test_it_is_constant_without_a_decrease() -> None:
    assert inflation_with(3, 1.5, None) == 1.5


@pytest.mark.parametrize("share", [0.0, 1.1, float("nan")])
def test_a_share_out_of_range_is_refused(share: float) -> None:
    with pytest.raises(InputError, match="share"):
        FewKeypoints(typical=12.0, share=share)


@pytest.mark.parametrize("typical", [6.0, float("nan")])
def test_a_typical_number_out_of_range_is_refused(typical: float) -> None:
    with pytest.raises(InputError, match="typical"):
        FewKeypoints(typical=typical, share=0.9)
