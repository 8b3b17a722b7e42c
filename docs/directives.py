"""Directives of the pages: help of commands, JSON schemas of formats, public names of rooms."""

from __future__ import annotations

import contextlib
import io
import os
import re
from importlib import import_module
from pathlib import Path
from typing import Any

import msgspec
from docutils import nodes
from docutils.parsers.rst import Directive
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.nodes import nested_parse_with_titles

from cadalign.cli import main
from cadalign.datasets import model_keypoints
from cadalign.estimation import document
from cadalign.io.observation import ObservationFields

COLUMNS = "96"
FORMATS: dict[str, tuple[Any, ...]] = {
    "observation": (ObservationFields,),
    "model_keypoints": (model_keypoints._File,),
    "fit": (document._Result,),
}
PAGES = Path(__file__).parent / "api"
_SHOWN = re.compile(r"^\.\. auto\w+:: ([\w.]+)", re.MULTILINE)
_ROOM = re.compile(r"^\.\. public-names:: ([\w.]+)", re.MULTILINE)


class CommandHelp(Directive):
    """The help text of the command named in the argument: `command-help:: shape learn`."""

    required_arguments = 1
    final_argument_whitespace = True

    def run(self) -> list[nodes.Node]:
        text = help_text(self.arguments[0].split())
        return [nodes.literal_block(text, text, language="text")]


def help_text(command: list[str]) -> str:
    """Capture what the command line prints for `cadalign <command> --help`."""
    printed = io.StringIO()
    width, os.environ["COLUMNS"] = os.environ.get("COLUMNS"), COLUMNS
    try:
        with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
            main([*command, "--help"])
    finally:
        if width is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = width
    return printed.getvalue().strip("\n")


def schema(name: str) -> bytes:
    """The JSON schema of a format, indented."""
    forms, definitions = msgspec.json.schema_components(
        FORMATS[name],
        schema_hook=lambda _: {"type": "string"},  # a path
        ref_template="#/$defs/{name}",
    )
    form = forms[0] if len(forms) == 1 else {"anyOf": list(forms)}
    return msgspec.json.format(msgspec.json.encode({**form, "$defs": definitions}), indent=1)


class JsonSchema(Directive):
    """The schema of the format named in the argument."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        text = schema(self.arguments[0]).decode()
        return [nodes.literal_block(text, text, language="json")]


def write_schemas(app: Sphinx, _: Exception | None) -> None:
    """Write each schema as a file of the site, for editors and validators."""
    folder = Path(app.outdir) / "schemas"
    folder.mkdir(parents=True, exist_ok=True)
    for name in FORMATS:
        (folder / f"{name}.schema.json").write_bytes(schema(name))


def named(path: str) -> Any:
    """The object of a dotted path."""
    module, _, name = path.rpartition(".")
    return getattr(import_module(module), name)


def shown_by_itself() -> list[str]:
    """Paths of what the pages show by themselves."""
    return _found(_SHOWN)


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


def _keep_colon(*event: Any) -> None:
    """Put a comment before an attribute's text, or napoleon takes it up to a colon for a type."""
    if event[1] in ("attribute", "property"):
        event[-1][:0] = ["..", ""]


def setup(app: Sphinx) -> dict[str, Any]:
    app.add_directive("command-help", CommandHelp)
    app.add_directive("json-schema", JsonSchema)
    app.add_directive("public-names", PublicNames)
    app.connect("build-finished", write_schemas)
    app.connect("autodoc-process-docstring", _keep_colon, priority=400)  # before napoleon
    return {"parallel_read_safe": True, "parallel_write_safe": True}
