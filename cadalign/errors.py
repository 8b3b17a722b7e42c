"""Exceptions of cadalign; messages say what is wrong, where, and what to do."""

from __future__ import annotations

import reprlib
from collections.abc import Iterable
from dataclasses import MISSING, fields
from functools import partial
from typing import Any

_QUOTED_LENGTH = 200
_NEAR = 0.7  # similarity of names above which one is suggested for the other


class CadalignError(Exception):
    """Base class of cadalign's exceptions.

    Parameters
    ----------
    what : str
        Description of the problem, in the user's terms.
    where : str, optional
        The argument, file, model id or field concerned.
    fix : str, optional
        Remedy.

    Examples
    --------
    >>> print(CadalignError("4 points", where="points_3d", fix="give at least 6"))
    points_3d: 4 points; give at least 6
    """

    def __init__(self, what: str, *, where: str | None = None, fix: str | None = None) -> None:
        super().__init__(what)
        self.what = what
        self.where = where
        self.fix = fix

    def __str__(self) -> str:
        text = self.what if self.where is None else f"{self.where}: {self.what}"
        return text if self.fix is None else f"{text}; {self.fix}"

    def __reduce__(self) -> tuple[object, ...]:
        # Worker processes pickle errors; by default that loses keyword-only arguments.
        return partial(type(self), where=self.where, fix=self.fix), (self.what,)


class InputError(CadalignError, ValueError):
    """An argument has the wrong shape, type or value."""


class DegenerateError(CadalignError):
    """The keypoints do not determine the alignment: too few, coplanar or coincident."""


class NoConsensusError(CadalignError):
    """No alignment has more supporting keypoints than expected by chance."""


class DataError(CadalignError):
    """A file is missing, malformed or inconsistent."""


class RenderError(CadalignError):
    """Rendering failed: an empty mesh, an image size out of range, or no suitable view."""


class TooFewVisibleError(DegenerateError, RenderError):
    """No view of an object shows the required number of keypoints."""


def require_kind(value: object, kind: type, where: str, *, fix: str | None = None) -> None:
    """Raise an InputError if a value is not an instance of a class of cadalign."""
    if not isinstance(value, kind):
        what = f"expected a cadalign.{kind.__name__}, got {type(value).__name__}"
        raise InputError(what, where=where, fix=fix)


def unknown_name(
    kind: str, value: object, known: Iterable[str], *, where: str | None = None
) -> InputError:
    """Make the error for an unknown value; it suggests the most similar known value.

    Examples
    --------
    >>> print(unknown_name("style", "lnes", ["shaded", "lines"]))
    style: unknown style 'lnes', did you mean 'lines'?; known are shaded, lines
    """
    from difflib import get_close_matches

    names = list(known)
    nearest = get_close_matches(value, names, n=1, cutoff=_NEAR) if isinstance(value, str) else []
    hint = f", did you mean {nearest[0]!r}?" if nearest else ""
    fix = f"known are {', '.join(names)}" if names else "there are none here"
    return InputError(f"unknown {kind} {quote(value)}{hint}", where=where or kind, fix=fix)


def quote(value: Any) -> str:
    """Quote a value for a message, in at most 200 characters.

    Examples
    --------
    >>> len(quote("a" * 300))
    200
    >>> quote([1, None])
    '[1, None]'
    """
    short = reprlib.Repr()
    short.maxstring = short.maxother = short.maxlong = _QUOTED_LENGTH
    short.maxlist = short.maxtuple = short.maxdict = 12
    try:
        text = short.repr(value)
    except ValueError:  # an int with too many digits to print
        text = f"a {type(value).__name__} of thousands of digits"
    return _cut(text)


def brief(text: object) -> str:
    """Cut text from a file or another library to at most 200 printable characters.

    Examples
    --------
    >>> brief("wood\\x1b[2J.png")
    'wood?[2J.png'
    """
    return _cut("".join(c if c.isprintable() else "?" for c in str(text)[: 2 * _QUOTED_LENGTH]))


def _cut(text: str) -> str:
    return text if len(text) <= _QUOTED_LENGTH else f"{text[: _QUOTED_LENGTH - 3]}..."


def refuse_unused(
    options: Any, names: Iterable[str], why: str, *, fix: str = "leave it out"
) -> None:
    """Raise an InputError if a field in ``names`` is set though it has no effect."""
    for each in fields(options):
        default = each.default if each.default_factory is MISSING else each.default_factory()
        if each.name in names and getattr(options, each.name) != default:
            raise InputError(f"has no effect {why}", where=each.name, fix=fix)
