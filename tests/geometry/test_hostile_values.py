"""Values of any type in place of numbers: only cadalign's errors, and no warnings."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from support.refusals import refusal_text

from cadalign import Alignment, CadalignError, Camera, Result
from cadalign.arrays import as_floats
from cadalign.geometry.camera import COLMAP_PARAMS

VALUES: list[Any] = [
    *(None, True, "1", "x" * 10**5, b"x", "\0", object(), float, 1 + 1j),
    *(1e308, -1e308, 1e-320, float("nan"), float("inf"), 10**400, 10**5000),
    *([], {}, [1] * 10**5, [[]], {"a": [1]}, np.array(3), np.array([1, 2])),
]
CAMERA = Camera(640, 480, 600, 600, 319.5, 239.5)


@pytest.fixture(autouse=True)
def _no_warnings() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def read_or_refuse(act: Callable[[], object]) -> None:
    """Call ``act``; it may only raise a short `CadalignError`."""
    message = ""
    try:
        act()
    except CadalignError as error:
        message = str(error)
    assert len(message) < 700


@pytest.mark.parametrize("value", VALUES, ids=lambda value: type(value).__name__)
def test_cameras_and_alignments_read_or_refuse_any_value(value: Any) -> None:
    camera, alignment = CAMERA.to_dict(), Alignment.identity().to_dict()
    for reader in (Camera, Alignment, Result):
        read_or_refuse(lambda reader=reader: reader.from_dict(value))  # type: ignore[misc]
    for key in camera:
        read_or_refuse(lambda key=key: Camera.from_dict({**camera, key: value}))  # type: ignore[misc]
    for key in alignment:
        read_or_refuse(lambda key=key: Alignment.from_dict({**alignment, key: value}))  # type: ignore[misc]
    read_or_refuse(lambda: Alignment(np.eye(3), [0, 0, value], [1, 1, 1]))
    read_or_refuse(lambda: Alignment([[1, 0, 0], [0, value, 0], [0, 0, 1]], [0] * 3, [1] * 3))
    for name in ("width", "height", "fx", "fy", "cx", "cy", "distortion"):
        given = {**vars(CAMERA), name: value}
        read_or_refuse(lambda given=given: Camera(**given))  # type: ignore[misc]
    read_or_refuse(lambda: Camera.from_fov(640, 480, fov_x=value))
    read_or_refuse(lambda: Camera.from_fov(value, 480, fov_x=50))
    read_or_refuse(lambda: Camera.from_fov(640, value, fov_x=50))
    read_or_refuse(lambda: Camera.from_size(value, 480))
    read_or_refuse(lambda: CAMERA.replace_focal(value))


@pytest.mark.slow
@pytest.mark.parametrize("value", VALUES, ids=lambda value: type(value).__name__)
@pytest.mark.parametrize("model", COLMAP_PARAMS)
def test_lens_parameters_of_any_type_are_read_or_refused(model: str, value: Any) -> None:
    for place in range(len(COLMAP_PARAMS[model])):
        params: list[Any] = [500.0] * len(COLMAP_PARAMS[model])
        params[place] = value
        data = {"model": model, "width": 640, "height": 480, "params": params}
        read_or_refuse(lambda data=data: Camera.from_dict(data).project([[0, 0.1, 1]]))  # type: ignore[misc]
        read_or_refuse(lambda data=data: Camera.from_dict(data).normalize([[0, 0]]))  # type: ignore[misc]


@pytest.mark.parametrize("value", ["1.0", b"1", ["1.0"], [1.0, "2"], np.array(["1"])])
def test_texts_are_refused_as_numbers(value: Any) -> None:
    shape = (None,) * np.ndim(value)
    assert refusal_text(lambda: as_floats(value, name="sigma", shape=shape)) == (
        "sigma: not an array of numbers (they are texts)"
    )
