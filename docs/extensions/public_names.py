"""The reference of a room: what its ``__all__`` names and no page shows by itself."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.parsers.rst import Directive
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.nodes import nested_parse_with_titles

PAGES = Path(__file__).parents[1] / "api"
_SHOWN = re.compile(r"^\.\. auto\w+:: ([\w.]+)", re.MULTILINE)
_ROOM = re.compile(r"^\.\. public-names:: ([\w.]+)", re.MULTILINE)


def named(path: str) -> Any:
    """The object of a dotted path."""
    module, _, name = path.rpartition(".")
    return getattr(import_module(module), name)


def shown_by_itself() -> list[str]:
    """Paths of what the pages show by themselves."""
    return [
        path for page in sorted(PAGES.glob("*.md")) for path in _SHOWN.findall(page.read_text())
    ]


def rooms() -> list[str]:
    """The rooms whose names the pages list, in the order of the pages."""
    return _found(_ROOM)


def _found(pattern: re.Pattern[str]) -> list[str]:
    return [
        path for page in sorted(PAGES.glob("*.md")) for path in pattern.findall(page.read_text())
    ]


def further_names(room: str) -> list[str]:
    """Names of a room that neither stand by themselves nor belong to a room before it."""
    taken = {id(named(path)) for path in shown_by_itself()}
    for other in rooms():
        if other == room:
            break
        module = import_module(other)
        taken |= {id(getattr(module, name)) for name in module.__all__}
    module = import_module(room)
    return [name for name in module.__all__ if id(getattr(module, name)) not in taken]


class PublicNames(Directive):
    """The public names of the room in the argument."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        room, lines = self.arguments[0], []
        for name in further_names(room):
            value = getattr(import_module(room), name)
            kind = "class" if isinstance(value, type) else "function"
            is_data = not callable(value)
            lines += [f".. {'py:data' if is_data else 'auto' + kind}:: {room}.{name}", ""]
        node = nodes.section()
        node.document = self.state.document
        nested_parse_with_titles(self.state, StringList(lines), node)
        return node.children


def setup(app: Sphinx) -> dict[str, Any]:
    app.add_directive("public-names", PublicNames)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
