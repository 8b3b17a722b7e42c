"""Options of the library's functions as options of the command line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from cadalign.errors import CadalignError, InputError


class OptionError(CadalignError):
    """A command line option has an invalid value.

    It is no ValueError, which the parser would report without the option's name.
    """


@contextmanager
def named_as_flags() -> Iterator[None]:
    """Let errors of a dataclass of options name the command line's options."""
    try:
        yield
    except InputError as error:
        name = None if error.where is None else "--" + error.where.replace("_", "-")
        raise OptionError(error.what, where=name, fix=error.fix) from None
