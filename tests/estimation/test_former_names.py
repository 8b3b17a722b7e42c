"""Names that were documented under `cadalign.fitting` are those of `cadalign.estimation`."""

from __future__ import annotations

from importlib import import_module

import pytest


@pytest.mark.parametrize(
    ("former", "name", "present"),
    [
        ("exporting", "object_of_align", "exporting"),
        ("exporting", "object_of_fit", "exporting"),
        ("joint.advice", "Advice", "uncertainty.advice"),
        ("joint.advice", "rank_evidence", "uncertainty.advice"),
    ],
)
def test_former_names_are_those_of_estimation(former: str, name: str, present: str) -> None:
    found = getattr(import_module(f"cadalign.fitting.{former}"), name)
    assert found is getattr(import_module(f"cadalign.estimation.{present}"), name)
