"""Help of options: one paragraph each, and only defaults that say something."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Any

import tyro
from tyro.constructors import (
    ConstructorRegistry,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)


def plain_help() -> ConstructorRegistry:
    """Rules by which tyro adds neither line breaks nor "(default: None)" to an option's text.

    The text of an option that is unset or empty by default says what then holds.
    """
    registry = ConstructorRegistry()
    asked: list[StructTypeInfo] = []

    @registry.struct_rule
    def plain(info: StructTypeInfo) -> StructConstructorSpec | None:
        if asked:  # tyro's own rules, by the call below
            return None
        asked.append(info)
        try:
            spec = ConstructorRegistry.get_struct_spec(info)
        finally:
            asked.pop()
        if not isinstance(spec, StructConstructorSpec):
            return None
        return replace(spec, fields=tuple(map(_plain, spec.fields)))

    return registry


def _plain(field: StructFieldSpec) -> StructFieldSpec:
    kind: Any = field.type
    if field.default in (None, ()):
        kind = Annotated[kind, tyro.conf.arg(help_behavior_hint="")]
    return replace(field, type=kind, helptext=_paragraph(field.helptext))


def _paragraph(text: str | Callable[[], str | None] | None) -> Callable[[], str | None]:
    """The text without its line breaks, once it is asked for."""

    def joined() -> str | None:
        found = text() if callable(text) else text
        return None if found is None else " ".join(found.split())

    return joined
