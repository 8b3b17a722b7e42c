"""A short, fixed part of the fuzzing; ``make fuzz`` runs more of it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from fuzz import fits, mutations, readers
from fuzz.failures import LONGEST_SEARCH, fit_outcome
from fuzz.fit_cases import draw_case, draw_cases

pytestmark = pytest.mark.long


def over_seeds(run: Callable[[int], object], seeds: range) -> None:
    for seed in seeds:
        try:
            run(seed)
        except Exception as error:
            error.add_note(f"seed {seed}")
            raise


def test_fits_are_rotations_or_refused() -> None:
    over_seeds(lambda seed: fits.run_case(draw_case(seed)), range(120))


def test_batches_are_as_single_fits() -> None:
    over_seeds(lambda seed: fits.run_batch(draw_cases(seed, 3)), range(10))


@pytest.mark.parametrize("name", readers.FORMATS)
def test_files_are_read_and_mutated_ones_read_or_refused(name: str, tmp_path: Path) -> None:
    files = mutations.MutatedFiles(readers.FORMATS[name], tmp_path)
    readers.FORMATS[name].read(files.path)
    over_seeds(files.run, range(15))


def test_seeds_that_once_failed() -> None:
    # Equally good minima; numbers whose squares overflow; likelihoods beyond 1e16; no solution of
    # LAPACK's; tiny and huge sigmas; keypoints whose variance overflows; variances that underflow.
    seeds = (29687, 32890, 38825, 46483, 859002, 931296)
    seeds += (5020788, 5040797, 5053209, 5099758, 5117344)
    for seed in seeds:
        fits.run_case(draw_case(seed))


def test_failures_name_their_seed(monkeypatch: pytest.MonkeyPatch) -> None:
    def wrong(case: fits.Case) -> float:
        if case.kind == "exact":
            raise ArithmeticError("broken on purpose")
        return 2 * LONGEST_SEARCH

    monkeypatch.setattr(fits, "run_case", wrong)
    outcome = fit_outcome("fits", 0, 20)
    kinds = {seed: draw_case(seed).kind for seed in range(20)}
    assert [seed for _, seed in outcome.failures] == list(range(20))
    for what, seed in outcome.failures:
        assert ("broken on purpose" if kinds[seed] == "exact" else "took more than") in what


def test_a_prior_beside_keypoints_that_determine_nothing_leaves_a_covariance() -> None:
    """Of one stretch in a photo whose keypoints lie anywhere; its variances were negative."""
    fits.run_case(draw_case(1182))


@pytest.mark.parametrize(
    ("name", "seed"),
    [
        ("fit", 1001377),  # a word where words or a record may stand
        ("photo", 33876),  # EXIF with numbers that Pillow cannot write
        ("image tiff", 41229),  # a fraction in the place of a size
        ("keypointnet", 51149),  # a class whose name is too long for a folder
    ],
)
def test_files_that_once_failed(name: str, seed: int, tmp_path: Path) -> None:
    mutations.MutatedFiles(readers.FORMATS[name], tmp_path).run(seed)
