"""The canvas: positions of legends, dashes and markers."""

from __future__ import annotations

import numpy as np
import pytest

from cadalign.render.canvas import Canvas, _dashes

RED = (255, 0, 0)
NOWHERE = np.zeros((0, 2))


def test_texts_of_a_legend_stand_beside_their_samples() -> None:
    canvas = Canvas(np.zeros((480, 640, 3), np.uint8))
    canvas.legend([("found", RED, "line")], keep_clear=NOWHERE)
    light = (canvas.image.min(axis=2) > 180).any(axis=0)
    red = (canvas.image[:, :, 0].astype(int) - canvas.image[:, :, 1] > 100).any(axis=0)
    assert np.flatnonzero(light).min() > np.flatnonzero(red).max()


@pytest.mark.parametrize(("right", "below"), [(False, False), (True, False), (False, True)])
def test_a_legend_stands_in_the_corner_that_is_free(right: bool, below: bool) -> None:
    canvas = Canvas(np.zeros((480, 640, 3), np.uint8))
    x, y = np.meshgrid(np.arange(0, 640, 8.0), np.arange(0, 480, 8.0))
    free = ((x > 320) == right) & ((y > 240) == below)
    drawn = np.stack([x[~free], y[~free]], axis=1)
    canvas.legend([("found", RED, "line")], keep_clear=drawn)
    rows, columns = np.nonzero(canvas.finish().any(axis=2))
    assert ((columns > 320) == right).all()
    assert ((rows > 240) == below).all()


@pytest.mark.parametrize("size", [(40, 640), (640, 40)])
def test_a_legend_without_room_is_omitted(size: tuple[int, int]) -> None:
    before = np.full((*size, 3), 90, np.uint8)
    canvas = Canvas(before)
    canvas.legend([(f"line {n}", RED, "line") for n in range(6)], keep_clear=NOWHERE)
    np.testing.assert_array_equal(canvas.finish(), before)


def test_dashes_are_spread_over_a_line_and_end_with_it() -> None:
    parts = _dashes(np.array([[10.0, 5.0], [60.0, 5.0], [110.0, 5.0]]), 6.0, 4.0)
    begins, ends = [part[0, 0] for part in parts], [part[-1, 0] for part in parts]
    assert len(parts) == 10
    assert (begins[0], ends[-1]) == pytest.approx((10.0, 110.0))
    np.testing.assert_allclose(np.subtract(begins[1:], ends[:-1]), 4.0)
    np.testing.assert_allclose(np.diff(begins), 10.4)


@pytest.mark.parametrize("size", [(480, 640), (1920, 2560)])
def test_a_cross_is_as_large_as_its_radius_in_any_photo(size: tuple[int, int]) -> None:
    canvas = Canvas(np.zeros((*size, 3), np.uint8))
    canvas.cross(np.array([200.0, 150.0]), RED, radius=8.0)
    picture = canvas.finish().astype(int)
    rows, columns = np.nonzero(picture[:, :, 0] - picture[:, :, 1] > 100)  # without the casing
    reach = 8.0 * size[0] / 480
    ends = columns.min(), columns.max(), rows.min(), rows.max()
    wanted = 200 - reach, 200 + reach, 150 - reach, 150 + reach
    np.testing.assert_allclose(ends, wanted, atol=3.0)
