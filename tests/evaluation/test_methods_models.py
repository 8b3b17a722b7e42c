"""Models and cameras in the input of methods on photos."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.photo_sets import write_pascal3d

import cadalign.datasets
from cadalign import Model
from cadalign.evaluation.experiments import photos as options
from cadalign.evaluation.instances.photos import _model
from cadalign.evaluation.instances.sighting import PhotoTarget

BOUNDS = np.array([[-1.0, -0.5, -1.0], [1.0, 0.5, 1.0]])  # of a diagonal of 3


def model_of(base: str) -> Model:
    sighting: Any = SimpleNamespace(
        bounds=BOUNDS,
        width=2.0,
        model=SimpleNamespace(xyz=0.5 * BOUNDS, names=("first", "second")),
        protocol=SimpleNamespace(up_axis="y"),
    )
    return _model(base, sighting, with_mesh=False)


def test_a_similar_model_alone_deviates_by_a_share_of_its_diagonal() -> None:
    assert model_of(options.SIMILAR).shape_sigma == pytest.approx(0.04 * 3 * 2)
    for base in (options.RIGID, options.STRETCHED, options.PRIOR):
        assert model_of(base).shape_sigma is None


def test_a_rigid_model_is_not_stretched_and_a_prior_holds_the_stretch() -> None:
    stretches = {base: model_of(base).stretch for base in options.BASES[1:5]}
    assert [base for base, each in stretches.items() if each == "none"] == [options.RIGID]
    assert model_of(options.PRIOR).stretch_sigma is not None
    assert model_of(options.STRETCHED).stretch_sigma is None
    assert model_of(options.RIGID).points_3d == pytest.approx(BOUNDS)  # in units of the width


def test_a_photo_of_unknown_focal_length_has_the_annotations_at_the_middle_of_the_object(
    tmp_path: Path,
) -> None:
    (photo,) = cadalign.datasets.open(write_pascal3d(tmp_path))
    (found,) = photo.objects
    assert found.bbox is not None
    assert found.truth.camera is not None
    camera = PhotoTarget(photo, found, str(tmp_path)).camera
    assert camera is not None
    left, top, right, bottom = found.bbox
    assert (camera.cx, camera.cy) == ((left + right) / 2, (top + bottom) / 2)
    assert camera.fx == found.truth.camera.fx
