"""Exceptions: common base class, message format and pickling."""

from __future__ import annotations

import copy
import pickle

import pytest

from cadalign.errors import (
    CadalignError,
    DataError,
    DegenerateError,
    InputError,
    RenderError,
)

KINDS = [CadalignError, InputError, DegenerateError, DataError, RenderError]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("where", "fix", "text"),
    [
        (None, None, "it broke"),
        ("chair.obj", None, "chair.obj: it broke"),
        (None, "mend it", "it broke; mend it"),
        ("chair.obj", "mend it", "chair.obj: it broke; mend it"),
    ],
)
def test_text_is_where_what_and_fix(
    kind: type[CadalignError], where: str | None, fix: str | None, text: str
) -> None:
    error = kind("it broke", where=where, fix=fix)
    assert str(error) == text
    assert (error.what, error.where, error.fix) == ("it broke", where, fix)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "duplicate", [copy.copy, copy.deepcopy, lambda error: pickle.loads(pickle.dumps(error))]
)
def test_pickles_and_copies_keep_kind_and_text(kind: type[CadalignError], duplicate) -> None:
    error = kind("it broke", where="chair.obj", fix="mend it")
    again = duplicate(error)
    assert type(again) is kind
    assert str(again) == str(error)
    assert (again.what, again.where, again.fix) == (error.what, error.where, error.fix)


def test_all_errors_share_a_base_and_input_errors_are_value_errors() -> None:
    assert all(issubclass(kind, CadalignError) for kind in KINDS)
    assert issubclass(InputError, ValueError)
    assert not issubclass(DegenerateError, ValueError)
