"""MATLAB's .mat files as plain values: nothing in them is run."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.datasets.photos.mat_format import read_variables
from cadalign.errors import DataError, InputError, quote
from cadalign.io.files import damaged, read_bytes


class MatStruct:
    """A struct of a .mat file; its fields are read by name.

    Parameters
    ----------
    value : mapping
        Its fields, as `cadalign.datasets.photos.mat_format` reads them.
    where : str
        The file and the place in it, for messages.
    """

    def __init__(self, value: Mapping[str, Any], where: str) -> None:
        self._value = value
        self.where = where

    @property
    def names(self) -> tuple[str, ...]:
        """The names of its fields."""
        return tuple(self._value)

    def struct(self, name: str) -> MatStruct | None:
        """A field that is one struct; None where it is missing or empty."""
        found = self.structs(name)
        return found[0] if len(found) == 1 else None

    def structs(self, name: str) -> tuple[MatStruct, ...]:
        """A field that is an array of structs, or a single one."""
        value = self._value.get(name)
        values = np.atleast_1d(np.asarray(value, dtype=object)).ravel()
        return tuple(
            MatStruct(each, f"{self.where}: {name}[{number}]")
            for number, each in enumerate(values)
            if isinstance(each, dict)
        )

    def number(self, name: str, default: float | None = None) -> float:
        """A field that is a finite number.

        Raises
        ------
        InputError
            If it is not, or it is missing and there is no default.
        """
        value = self._value.get(name)
        array = np.asarray(value)
        if array.size == 0 or value is None:
            if default is None:
                raise InputError("missing", where=name)
            return default
        if array.size != 1 or array.dtype.kind not in "biuf" or not np.isfinite(array).all():
            raise InputError(f"{quote(value)} is not a finite number", where=name)
        return float(array.reshape(()))

    def text(self, name: str) -> str:
        """A field that is a text.

        Raises
        ------
        InputError
            If it is not.
        """
        value = self._value.get(name)
        if not isinstance(value, str) or not value.strip() or "\0" in value:
            raise InputError(f"{quote(value)} is not a text", where=name)
        return value

    def texts(self, name: str) -> tuple[str, ...]:
        """A field that is a list of texts, or a single one."""
        value = np.atleast_1d(np.asarray(self._value.get(name, ()), dtype=object)).ravel()
        return tuple(str(each) for each in value)

    def array(self, name: str, columns: int | None = None) -> FloatArray:
        """A field of finite numbers; as rows of so many columns where this is given.

        Raises
        ------
        InputError
            If it is missing, holds other things, or cannot have so many columns.
        """
        value = np.asarray(self._value.get(name))
        if value.dtype.kind not in "biuf":
            raise InputError("not an array of numbers", where=name)
        array = value.astype(np.float64)
        if not np.isfinite(array).all():
            raise InputError("some of its numbers are not finite", where=name)
        if columns is None:
            return array
        if array.size % columns or (array.ndim > 1 and array.shape[-1] != columns):
            raise InputError(f"shape {array.shape} has not {columns} columns", where=name)
        return array.reshape(-1, columns)


def read_structs(path: Path, name: str | None = None) -> tuple[MatStruct, ...]:
    """Read the array of structs that a .mat file holds under a name.

    Parameters
    ----------
    path : Path
    name : str, optional
        The variable's name; by default the file's only variable.

    Raises
    ------
    DataError
        If the file cannot be read, is none of MATLAB's up to version 7, or holds no such structs.
    """
    data = read_bytes(path)
    try:
        variables = read_variables(data, None if name is None else (name,))
    except InputError as error:
        raise damaged(f"not a .mat file that can be read ({error.what})", path) from None
    if name is None and len(variables) == 1:
        name = next(iter(variables))
    value = np.asarray(variables.get(str(name)), dtype=object)
    found = [each for each in np.atleast_1d(value).ravel() if isinstance(each, dict)]
    if not found:
        what = "no structs" if name is None else f"no structs named {name}"
        raise DataError(f"there are {what} in this file", where=str(path))
    return tuple(MatStruct(each, f"{path}[{number}]") for number, each in enumerate(found))
