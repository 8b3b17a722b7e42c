"""The reference documents what the rooms name publicly, and nothing else."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest

import cadalign

sys.path.insert(0, str(Path(__file__).parents[2] / "docs"))

from directives import further_names, named, rooms, shown_by_itself

SOURCE = Path(cadalign.__file__).parent
PUBLIC = sorted(
    f"cadalign.{(path.parent if path.stem == '__init__' else path).stem}"
    for path in [*SOURCE.glob("*/__init__.py"), *SOURCE.glob("[!_]*.py")]
    if "\n__all__" in path.read_text(encoding="utf-8")
)
INTERNAL = {"cadalign.compile"}


def test_every_room_with_public_names_has_its_place() -> None:
    assert sorted(rooms()) == sorted(set(PUBLIC) - INTERNAL)


def test_what_pages_show_by_themselves_is_public() -> None:
    names = [f"{room}.{name}" for room in rooms() for name in import_module(room).__all__]
    public = {id(named(path)) for path in names}
    public |= {id(getattr(cadalign, name)) for name in cadalign.__all__}
    public |= {id(value) for value in vars(cadalign.errors).values()}
    assert [path for path in shown_by_itself() if id(named(path)) not in public] == []


def test_every_name_of_the_package_is_shown() -> None:
    listed = [named(f"{room}.{name}") for room in rooms() for name in further_names(room)]
    shown = {id(each) for each in [*listed, *map(named, shown_by_itself())]}
    missing = [name for name in cadalign.__all__ if id(getattr(cadalign, name)) not in shown]
    assert [name for name in missing if not isinstance(getattr(cadalign, name), ModuleType)] == []


@pytest.mark.parametrize("room", rooms())
def test_public_names_exist_and_are_described(room: str) -> None:
    module = import_module(room)
    for name in module.__all__:
        value = getattr(module, name)
        assert not callable(value) or value.__doc__, name
