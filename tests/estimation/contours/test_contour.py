"""Contours of masks: sub-pixel positions, outward normals, borders, small pieces."""

from __future__ import annotations

from typing import NamedTuple, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cadalign import Camera, View
from cadalign.errors import InputError
from cadalign.estimation.contours.contour import (
    SPACING,
    Contour,
    Sight,
    contour_of,
    crossings,
    find_rims,
    interpolate,
    mask_contour,
)
from cadalign.estimation.contours.outline import Noise, OutlineSupport, correlation_length
from cadalign.estimation.contours.rounds import likeliest_offset
from cadalign.estimation.contours.sources import MaskSource

WIDTH, HEIGHT = 160, 120


def distances(center: tuple[float, float]) -> np.ndarray:
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    return np.hypot(columns - center[0], rows - center[1])


def test_images_are_read_at_exact_places_and_beyond_them_at_their_border() -> None:
    rows, columns = np.mgrid[:3, :4000]
    inside = np.random.default_rng(0).uniform([0, 0], [3999, 2], (1000, 2))
    ramp = (columns + 7 * rows).astype(np.float32)
    assert np.abs(interpolate(ramp, inside) - inside @ [1, 7]).max() < 1e-9
    outside = np.array([[-5.0, 1.25], [4100.0, -np.inf], [12.5, np.inf], [np.nan, 9.0]])
    assert interpolate(ramp, outside).tolist() == [8.75, 3999.0, 26.5, 14.0]


def disc(center: tuple[float, float], radius: float) -> np.ndarray:
    return distances(center) < radius


@pytest.mark.long
@given(x=st.floats(60, 100), y=st.floats(50, 70), radius=st.floats(12, 40), soft=st.booleans())
def test_a_disc_has_its_own_radius_and_normals(
    x: float, y: float, radius: float, soft: bool
) -> None:
    mask = np.clip(radius - distances((x, y)) + 0.5, 0, 1) if soft else disc((x, y), radius)
    contour = contour_of(mask)
    outwards = contour.points - [x, y]
    found = np.linalg.norm(outwards, axis=1)
    of_area = np.sqrt(mask.sum() / np.pi)  # of the pixels, whose number is whole
    assert abs(found.mean() - of_area) < 0.08
    assert np.abs(found - radius).max() < (0.2 if soft else 0.7)
    assert ((outwards / found[:, None] * contour.normals).sum(axis=1) > 0.95).all()
    steps = np.linalg.norm(np.diff(contour.points, axis=0), axis=1)
    assert abs(steps.mean() - SPACING) < 0.2


def test_a_ring_has_two_curves_with_normals_away_from_the_object() -> None:
    ring = disc((80, 60), 40) & ~disc((80, 60), 20)
    contour = contour_of(ring)
    assert set(contour.curve.tolist()) == {0, 1}
    radii = np.linalg.norm(contour.points - [80, 60], axis=1)
    outwards = ((contour.points - [80, 60]) * contour.normals).sum(axis=1)
    assert (outwards[radii > 30] > 0).all()
    assert (outwards[radii < 30] < 0).all()


def test_nothing_is_told_at_the_border_of_the_image() -> None:
    contour = contour_of(disc((0, 60), 30))
    assert contour.points[:, 0].min() > 2
    assert np.abs(np.linalg.norm(contour.points - [0, 60], axis=1) - 30).max() < 0.7
    assert len(set(contour.curve.tolist())) == 1


def test_small_pieces_and_holes_are_dropped() -> None:
    clean = disc((60, 60), 30)
    spotted = (clean & ~disc((60, 60), 1.2)) | disc((140, 100), 1.8)
    assert len(contour_of(spotted).points) == len(contour_of(clean).points)


@pytest.mark.parametrize(
    ("mask", "words"),
    [
        (np.zeros((HEIGHT, WIDTH), dtype=bool), "larger than a few pixels"),
        (np.ones((HEIGHT, WIDTH)), "larger than a few pixels"),
        (disc((80, 60), 1.0), "larger than a few pixels"),
        (
            np.random.default_rng(0).uniform(size=(480, 640)) < 0.5,  # of which a fit takes minutes
            r"has a contour of 56,\d\d\d px, longer than an object's: the mask is noisy; remove",
        ),
    ],
)
def test_masks_without_a_contour_are_refused(mask: np.ndarray, words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        mask_contour(mask, "views[1].mask")
    assert "views[1].mask" in str(caught.value)


def test_correlated_residuals_count_less() -> None:
    rng = np.random.default_rng(0)
    count = 4000
    contour = Contour(np.zeros((count, 2)), np.zeros((count, 2)), np.zeros(count, dtype=int))
    every = np.ones(count, dtype=bool)
    independent = rng.normal(size=count)
    alike = np.convolve(independent, np.ones(10) / np.sqrt(10), mode="same")
    assert correlation_length(contour, independent, every) < 1.3
    assert 8 < correlation_length(contour, alike, every) < 12
    assert correlation_length(contour, alike, every, least=100.0) < 1.1  # far below the noise


@pytest.mark.parametrize("place", [2.0, 0.7, 0.5, 0.0])
def test_an_offset_has_the_deviation_that_its_own_place_shows(place: float) -> None:
    """The likeliest offset of a contour at ``place``, for a prior of 1 px and a variance."""
    offset = likeliest_offset(place / (1 + 0.36), 1 / (1 / 0.36 + 1), Noise(1.0, 1.0, 1.0))
    assert offset == pytest.approx(max(np.sqrt(max(place**2 - 0.36, 0.0)), 0.1))


@pytest.mark.parametrize("shift", [-0.3, -0.1, 0.1, 0.3])
def test_the_nearest_of_two_lines_is_taken_on_either_side(shift: float) -> None:
    """Places where the level falls along the normal, nearest to an offset."""
    columns = np.where(np.isin(np.arange(40), [*range(20), 21]), 1.0, 0.0)
    level = np.tile(columns.astype(np.float32), (5, 1))  # falls at 19.5 and 21.5
    place, normal = np.array([[18.5 + shift, 2.0]]), np.array([[1.0, 0.0]])
    found = crossings(level, place, normal, np.array([2.0]))
    assert found == pytest.approx([(19.5 if shift < 0 else 21.5) - place[0, 0]], abs=0.02)


class Stripes(NamedTuple):
    """A sight of stripes parallel to the y axis, between pairs of ``edges`` [px]."""

    edges: list[float]

    def covers(self, pixels: np.ndarray) -> np.ndarray:
        return np.asarray(np.searchsorted(self.edges, pixels[..., 0]) % 2 == 1)

    def hits(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros(len(pixels), dtype=int), np.column_stack([pixels, np.ones(len(pixels))])


@given(
    edges=st.lists(st.floats(-40, 40), min_size=2, max_size=8, unique=True),
    starts=st.lists(st.floats(-30, 30), min_size=1, max_size=5),
    reach=st.floats(1, 40),
)
def test_the_exit_nearest_to_each_sample_is_its_rim(
    edges: list[float], starts: list[float], reach: float
) -> None:
    sight, count = Stripes(sorted(edges)), len(starts)
    points = np.column_stack([starts, np.zeros(count)])
    contour = Contour(points, np.tile([1.0, 0.0], (count, 1)), np.zeros(count, dtype=int))
    rims = find_rims(cast(Sight, sight), contour, reach)
    steps = np.linspace(-reach, reach, 2 * int(min(np.ceil(reach / 1.5), 24)) + 1)
    covered = sight.covers(contour.offset_points(steps[:, None] + np.zeros(count)))
    for start, column, found, offset in zip(
        starts, covered.T, rims.found, rims.offset, strict=True
    ):
        (exits,) = np.nonzero(column[:-1] & ~column[1:])
        assert found == bool(len(exits))
        if not found:
            continue
        middles = (steps[exits] + steps[exits + 1]) / 2
        nearest = exits[np.argmin(np.round(np.abs(middles), 9))]
        assert steps[nearest] <= offset <= steps[nearest + 1]
        assert np.abs(np.array(sight.edges[1::2]) - start - offset).min() < 0.03


def test_an_uneven_mask_that_is_met_in_parts_alone_is_doubted() -> None:
    mask = np.zeros((100, 100), dtype=bool)
    mask[30:70, 20:80] = True
    camera = Camera(100, 100, 100, 100, 49.5, 49.5)
    view = View(camera, [[30, 40], [60, 40], [50, 60]], mask=mask)
    source = MaskSource.from_view(0, view, camera)
    uneven = OutlineSupport(share=0.75, agreeing=100, rms=1.8, rms_sigmas=1.0)
    assert "only 75 % of its contour meets" in (source.doubt(uneven) or "")
    for support in (uneven._replace(rms=0.1), uneven._replace(share=0.97)):
        assert source.doubt(support) is None
