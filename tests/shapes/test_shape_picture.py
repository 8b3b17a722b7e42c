"""The picture of a shape model: any model is drawn."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from cadalign.errors import DataError
from cadalign.shapes.model import ShapeModel
from cadalign.shapes.outputs import draw_shape


@pytest.mark.parametrize("name", ["picture.xyz", "picture"])
def test_a_name_of_no_picture_is_refused(tmp_path: Path, name: str) -> None:
    model = ShapeModel.from_basis(np.eye(4, 3), np.ones((1, 4, 3)), [0.1])
    with pytest.raises(DataError, match="is no picture's name"):
        draw_shape(tmp_path / name, model)


@pytest.mark.long
@pytest.mark.parametrize("up_axis", ["x", "y", "z", None])
@pytest.mark.parametrize("modes", [0, 1, 6])
def test_a_picture_is_drawn(tmp_path: Path, up_axis: str | None, modes: int) -> None:
    rng = np.random.default_rng(0)
    model = ShapeModel.from_basis(
        rng.normal(size=(5, 3)),
        rng.normal(size=(modes, 5, 3)),
        np.full(modes, 0.1),
        up_axis=up_axis,  # type: ignore[arg-type]
    )
    draw_shape(tmp_path / "picture.png", model)
    with Image.open(tmp_path / "picture.png") as picture:
        assert picture.width > 400
        assert np.ptp(np.asarray(picture.convert("L"))) > 100
