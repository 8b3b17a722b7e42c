"""A photo of a chair for the tests of the annotator."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.annotating import Case, make_case


@pytest.fixture(scope="session")
def original(sample_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Case:
    """One photo for all modules; to be read, not changed."""
    return make_case(sample_root, tmp_path_factory.mktemp("annotate"))


@pytest.fixture
def case(original: Case, tmp_path: Path) -> Case:
    """A copy in a folder of its own."""
    return original.copied_to(tmp_path / "photos")
