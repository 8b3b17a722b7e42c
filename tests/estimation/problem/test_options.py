"""Options of `fit`: `FitOptions` and `RansacOptions`."""

from __future__ import annotations

import inspect
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields
from typing import Any

import numpy as np
import pytest

from cadalign import Camera, fit, fit_batch
from cadalign.errors import CadalignError
from cadalign.estimation import options
from cadalign.estimation.options import FitOptions, RansacOptions
from cadalign.retrieval.options import RetrievalOptions

NOT_OPTIONS = {"ransac", "scores", "workers", "symmetry"}


@pytest.mark.parametrize("function", [fit, fit_batch])
def test_keywords_of_the_functions_are_the_fields_of_the_options(
    function: Callable[..., object],
) -> None:
    keywords = {
        name: parameter.default
        for name, parameter in inspect.signature(function).parameters.items()
        if parameter.kind is inspect.Parameter.KEYWORD_ONLY and name not in NOT_OPTIONS
    }
    assert keywords == {field.name: field.default for field in fields(FitOptions)}


@pytest.mark.parametrize("kind", [FitOptions, RansacOptions, RetrievalOptions])
def test_every_option_has_its_help_below_it(kind: type) -> None:
    lines = "".join(map(inspect.getsource, kind.__mro__[:-1])).splitlines()
    for field in fields(kind):
        (place,) = (i for i, line in enumerate(lines) if re.match(rf"    {field.name}: ", line))
        assert lines[place + 1].startswith('    """'), field.name


@pytest.mark.long
def test_importing_the_options_compiles_nothing() -> None:
    code = f"import sys, {options.__name__}; assert 'numba' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(
    ("given", "fewest"),
    [
        ({}, 4),
        ({"stretch": "none"}, 3),
        ({"stretch_sigma": 0.2}, 3),
        ({"focal": "estimate"}, 4),
        ({"stretch": "none", "focal": "estimate"}, 3),
        ({"method": "aepnp"}, 6),
        ({"method": "epnp"}, 4),
    ],
)
def test_fits_take_as_many_keypoints_as_determine_their_unknowns(
    given: dict[str, Any], fewest: int
) -> None:
    """A keypoint has two equations, a prior has one; fewer than the unknowns are refused."""
    camera = Camera(640, 480, 600.0, 600.0, 319.5, 239.5)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (fewest, 3))
    pixels = camera.project(points + [0.0, 0.0, 4.0])
    assert np.isfinite(fit(points, pixels, camera, **given).alignment.translation).all()
    with pytest.raises(CadalignError) as refused:
        fit(points[1:], pixels[1:], camera, **given)
    assert fewest == 3 or f"give at least {fewest}" in str(refused.value)
