"""Options of a retrieval stand in one place: `RetrievalOptions`."""

from __future__ import annotations

import inspect
import re
from dataclasses import fields

from cadalign import Library
from cadalign.retrieval.options import RetrievalOptions

NOT_OPTIONS = {"mask", "image", "exclude", "workers"}


def test_keywords_of_retrieve_are_the_fields_of_the_options() -> None:
    keywords = {
        name: parameter.default
        for name, parameter in inspect.signature(Library.retrieve).parameters.items()
        if parameter.kind is inspect.Parameter.KEYWORD_ONLY and name not in NOT_OPTIONS
    }
    assert keywords == {field.name: field.default for field in fields(RetrievalOptions)}


def test_every_option_has_its_help_below_it() -> None:
    lines = inspect.getsource(RetrievalOptions).splitlines()
    for field in fields(RetrievalOptions):
        (place,) = (i for i, line in enumerate(lines) if re.match(rf"    {field.name}: ", line))
        assert lines[place + 1].startswith('    """'), field.name
