"""Masks of COCO annotations, as polygons and run lengths, compared with pycocotools."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pycocotools import mask as coco
from support.refusals import refusal_text

from cadalign.datasets.coco import decode_segmentation

WIDTH, HEIGHT = 37, 23


def random_mask(seed: int) -> np.ndarray:
    """A mask of blobs, some touching the border."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    mask = np.zeros((HEIGHT, WIDTH), dtype=bool)
    for _ in range(int(rng.integers(1, 6))):
        x, y, r = rng.uniform(0, WIDTH), rng.uniform(0, HEIGHT), rng.uniform(1, 12)
        mask ^= (u - x) ** 2 + (v - y) ** 2 < r * r
    mask[HEIGHT // 2, WIDTH // 2] = True
    return mask


@pytest.mark.long
@given(st.integers(0, 10**6))
def test_run_lengths_agree_with_pycocotools(seed: int) -> None:
    mask = random_mask(seed)
    compressed: Any = coco.encode(np.asfortranarray(mask.astype(np.uint8)))
    text = {"size": compressed["size"], "counts": compressed["counts"].decode()}
    np.testing.assert_array_equal(decode_segmentation(text, width=WIDTH, height=HEIGHT), mask)
    flat = mask.T.ravel()
    starts = np.flatnonzero(np.diff(np.concatenate([[0], flat, [2]])))
    counts = np.diff(np.concatenate([[0], starts])).tolist()
    plain = {"size": [HEIGHT, WIDTH], "counts": counts}
    np.testing.assert_array_equal(decode_segmentation(plain, width=WIDTH, height=HEIGHT), mask)


def test_polygons_are_filled_together() -> None:
    first = [2.0, 3.0, 10.0, 3.0, 10.0, 12.0, 2.0, 12.0]
    second = [20.0, 5.0, 36.5, 5.0, 28.0, 20.0]
    mask = decode_segmentation([first, second], width=WIDTH, height=HEIGHT)
    expected = np.zeros((HEIGHT, WIDTH), dtype=bool)
    expected[3:12, 2:10] = True
    assert (mask[:, :15] == expected[:, :15]).all()
    assert mask[6, 28]
    assert not mask[19, 21]
    assert mask[:, 15:].sum() == pytest.approx(16.5 * 15 / 2, rel=0.1)


def test_a_polygon_may_leave_the_image() -> None:
    mask = decode_segmentation([[-9.0, -9, 50, -9, 50, 5, -9, 5]], width=WIDTH, height=HEIGHT)
    assert mask[:5].all()
    assert not mask[5:].any()


@pytest.mark.parametrize(
    ("segmentation", "text"),
    [
        (7, "segmentation: 7 is not a list"),
        ([[1.0] * 4], "segmentation[0]: expected x, y of three or more points, got 4 numbers; "),
        ([[1.0] * 7], "segmentation[0]: expected x, y of three or more points, got 7 numbers; "),
        ([[0.0, 0, 1e9, 0, 1e9, 9]], "segmentation[0]: has points far outside the image; "),
        ([[0.0, 0, 1, float("nan"), 3, 4]], "segmentation[0][3]: nan is not a finite number"),
        ([], "segmentation: the mask is empty; "),
        ({"size": [23, 37]}, "segmentation.counts: missing"),
        (
            {"size": [37, 23], "counts": [851]},
            "segmentation.size: the mask is 23 x 37, the image 37 x 23; ",
        ),
        (
            {"size": [23, 37], "counts": [1, 2]},
            "segmentation.counts: the runs have 3 pixels, the image has 851; ",
        ),
        ({"size": [23, 37], "counts": [851]}, "segmentation: the mask is empty; "),
        *(
            ({"size": [23, 37], "counts": text}, "segmentation.counts: the compressed run")
            for text in ("b\x00", "o", "o" * 99, "", "22", "22o")
        ),
    ],
)
def test_invalid_masks_are_refused(segmentation: Any, text: str) -> None:
    assert refusal_text(
        lambda: decode_segmentation(segmentation, width=WIDTH, height=HEIGHT)
    ).startswith(text)


@given(st.text(st.characters(min_codepoint=48, max_codepoint=111), max_size=40))
def test_any_text_is_decoded_or_refused(text: str) -> None:
    from cadalign.errors import CadalignError

    try:
        mask = decode_segmentation({"size": [2, 3], "counts": text}, width=3, height=2)
    except CadalignError:
        return
    assert mask.shape == (2, 3)
