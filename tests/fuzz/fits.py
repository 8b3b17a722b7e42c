"""Fuzz `cadalign.fit` and `fit_batch`: call them with drawn cases, and check what they return."""

from __future__ import annotations

import json
import time
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from fuzz.fit_cases import Case
from fuzz.hostile import Call, made

from cadalign import Alignment, CadalignError, Camera, Result, fit, fit_batch
from cadalign.estimation.results import Results
from cadalign.metrics import rotation_error

ROTATION_TOLERANCE = 1e-9
LONGEST_MESSAGE = 2000
_SAME_DEG = 1e-3
_SAME = 1e-4


def run_case(case: Case) -> float:
    """Fit a case and check what comes out; gives the seconds of processor time of the call.

    Anything but a `CadalignError` passes through, warnings too.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        begin = time.process_time()
        try:
            result = _fit(case)
        except CadalignError as error:
            seconds = time.process_time() - begin
            check_message(error)
            assert case.truth is None, f"a well-posed problem is refused: {error}"
            return seconds
        seconds = time.process_time() - begin
        check_result(result)
        text = json.dumps(result.to_dict())
        again = Result.from_dict(json.loads(text)).to_dict()
        assert json.dumps(again) == text, "JSON does not give the result back"
        assert all(line.isprintable() for line in str(result).splitlines())
    if case.truth is not None:
        cameras = [result.camera, *(other.camera for other in result.alternatives)]
        found = [result.alignment, *(other.alignment for other in result.alternatives)]
        assert any(
            _is_same(alignment, camera, case)
            for alignment, camera in zip(found, cameras, strict=True)
        ), "the truth is missed"
    return seconds


def run_batch(cases: Sequence[Case]) -> None:
    """Fit some cases in one call, with the first one's options.

    The batch is refused where single calls are, and does not differ from them by a bit.
    """
    options = {name: made(value) for name, value in cases[0].options.items()}
    given = [case for case in cases if not isinstance(case.camera, Call)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fits: list[Result | CadalignError] = []
        for case in given:
            try:
                fits.append(fit(case.points_3d, case.points_2d, case.camera, **options))
            except CadalignError as error:
                fits.append(error)
        try:
            batch = fit_batch(
                [case.points_3d for case in given],
                [case.points_2d for case in given],
                [case.camera for case in given],
                workers=1 + len(given) % 2,
                **options,
            )
        except CadalignError as error:
            check_message(error)
            refused = [one for one in fits if isinstance(one, CadalignError)]
            assert any(one.what == error.what for one in refused), f"batch refused: {error}"
            return
    for problem, one in enumerate(fits):
        _compare(batch, problem, one)


def check_result(result: Result) -> None:
    """Check that all alignments of a result are rotations and that all its numbers are finite."""
    for alignment in (result.alignment, *(other.alignment for other in result.alternatives)):
        _check_alignment(alignment)
    for other in result.alternatives:
        assert 0 <= other.relative_likelihood <= 1, f"likelihood {other.relative_likelihood}"
        assert np.isfinite([other.camera.fx, other.camera.fy]).all()
    assert len(result.residuals) == len(result.points_3d) == len(result.inliers)
    assert np.isfinite(result.residuals[result.inliers]).all()
    assert np.isfinite(result.rms)
    if result.covariance is not None:
        assert np.isfinite(result.covariance).all()
        assert (result.covariance.diagonal() >= 0).all()


def check_message(error: CadalignError) -> None:
    """Check that a message is of some lines and does not quote its input at length."""
    assert len(str(error)) < LONGEST_MESSAGE, "the message quotes its input at length"


def _fit(case: Case) -> Result:
    options = {name: made(value) for name, value in case.options.items()}
    return fit(case.points_3d, case.points_2d, made(case.camera), **options)


def _check_alignment(alignment: Alignment) -> None:
    gap = np.abs(alignment.rotation @ alignment.rotation.T - np.eye(3)).max()
    assert gap < ROTATION_TOLERANCE, "no rotation"
    assert abs(np.linalg.det(alignment.rotation) - 1) < ROTATION_TOLERANCE, "a reflection"
    assert np.isfinite(alignment.translation).all()
    assert np.isfinite(alignment.scale).all()
    assert (alignment.scale > 0).all()


def _compare(batch: Results, problem: int, one: Result | CadalignError) -> None:
    if isinstance(one, CadalignError):
        assert type(batch.errors.get(problem)) is type(one), "only a single call refuses"
        return
    assert problem not in batch.errors, "only the batch refuses"
    assert batch.alignment(problem) == one.alignment, "the batch differs from single calls"
    single = batch[problem]
    assert _without_times(single) == _without_times(one), "the batch's result differs"


def _without_times(result: Result) -> dict[str, Any]:
    return result.to_dict() | {"stats": None}


def _is_same(est: Alignment, camera: Camera, case: Case) -> bool:
    gt = case.truth
    return bool(
        rotation_error(est=est, gt=gt) < _SAME_DEG
        and np.allclose(est.scale, gt.scale, rtol=_SAME)
        and np.allclose(est.translation, gt.translation, rtol=_SAME, atol=_SAME)
        and np.isclose(camera.fx, case.true_focal, rtol=_SAME)
    )
