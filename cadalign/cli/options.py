"""Options of the library's functions as options of the command line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

from cadalign.errors import CadalignError, InputError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    from cadalign.fitting.options import Sigma
    from cadalign.io.observation import Observation


class OptionError(CadalignError):
    """A command line option has an invalid value.

    Other than InputError it is no ValueError, which the parser would report without the name.
    """


@contextmanager
def named_as_flags(
    *options: DataclassInstance, kind: type[CadalignError] = InputError
) -> Iterator[None]:
    """Let errors about fields of dataclasses of options name the command line's options.

    Their kind is `OptionError` while the command line is parsed.
    """
    try:
        yield
    except InputError as error:
        names = {field.name for each in options for field in fields(each)}
        if error.where not in names:
            raise
        flag = "--" + str(error.where).replace("_", "-")
        raise kind(error.what, where=flag, fix=error.fix) from None


@dataclass(frozen=True, kw_only=True)
class JsonOption:
    """The option of the commands that print a table or JSON."""

    json: bool = False
    """Print the result as JSON."""


@dataclass(frozen=True, kw_only=True)
class ObservationCommand(JsonOption):
    """Options of the commands on an observation file."""

    out: Path | None = None
    """Folder to write to; by default, fit writes to <observation>_fit beside the file."""
    sigma: float | None = None
    """Standard deviation of the keypoints [px]; by default the file's, or 1."""

    def sigma_of(self, observation: Observation) -> Sigma:
        """Standard deviation of the keypoints: the given one, the file's, or 1."""
        if self.sigma is not None:
            return self.sigma
        return 1.0 if observation.sigma is None else observation.sigma
