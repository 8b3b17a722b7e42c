"""Options of a retrieval stand in one place: `RetrievalOptions`."""

from __future__ import annotations

import inspect
import re
from dataclasses import fields

import numpy as np
import pytest

from cadalign import Camera, Library
from cadalign.errors import InputError
from cadalign.retrieval import LibraryModel
from cadalign.retrieval.options import RetrievalOptions


def test_retrieve_names_every_option() -> None:
    text = inspect.getdoc(Library.retrieve) or ""
    assert all(re.search(rf"\b{field.name}\b", text) for field in fields(RetrievalOptions))


def test_unknown_option_is_refused() -> None:
    model = LibraryModel("box", "0", np.eye(4, 3), np.arange(4), np.array([[0, 0, 0], [1, 1, 1]]))
    library = Library.from_models([model])
    with pytest.raises(InputError, match=r"unknown option.*'tops'"):
        library.retrieve(np.zeros((4, 2)), np.arange(4), Camera(64, 48, 60, 60, 32, 24), tops=3)


def test_every_option_has_its_help_below_it() -> None:
    lines = "".join(map(inspect.getsource, RetrievalOptions.__mro__[:-1])).splitlines()
    for field in fields(RetrievalOptions):
        (place,) = (i for i, line in enumerate(lines) if re.match(rf"    {field.name}: ", line))
        assert lines[place + 1].startswith('    """'), field.name
