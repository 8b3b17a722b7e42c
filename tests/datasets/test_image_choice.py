"""One object out of those of a detector's file: what is asked for is listed."""

from __future__ import annotations

import numpy as np
import pytest

from cadalign.datasets.detections.image_keypoints import ImageKeypoints, choose_object
from cadalign.errors import InputError


@pytest.mark.parametrize(("count", "end"), [(4, "3.png"), (5, "4.png"), (6, "4.png, ...")])
def test_at_most_five_images_are_listed(count: int, end: str) -> None:
    point = np.zeros((1, 2))
    objects = [
        ImageKeypoints(points_2d=point, image=f"{n}.png", source="a.json") for n in range(count)
    ]
    with pytest.raises(InputError) as caught:
        choose_object(objects)
    assert str(caught.value).endswith(end)
