"""A short, fixed part of the fuzzing; ``make fuzz`` runs more of it."""

from __future__ import annotations

from pathlib import Path

import pytest
from fuzz import fits, readers


@pytest.mark.parametrize("start", range(0, 600, 100))
def test_fits_are_rotations_or_refused(start: int) -> None:
    for seed in range(start, start + 100):
        try:
            fits.run_case(fits.draw_case(seed))
        except Exception as error:
            error.add_note(f"seed {seed}")
            raise


@pytest.mark.parametrize("name", readers.FORMATS)
def test_valid_files_are_read(name: str, tmp_path: Path) -> None:
    kind = readers.FORMATS[name]
    kind.read(kind.write(tmp_path))


@pytest.mark.parametrize("name", readers.FORMATS)
def test_mutated_files_are_read_or_refused(name: str, tmp_path: Path) -> None:
    for seed in range(40):
        try:
            readers.run_mutation(readers.FORMATS[name], seed, tmp_path / "data")
        except Exception as error:
            error.add_note(f"seed {seed}")
            raise
