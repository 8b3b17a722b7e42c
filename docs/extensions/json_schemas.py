"""JSON schemas of the file formats, made from the types that the readers check with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
from docutils import nodes
from docutils.parsers.rst import Directive
from sphinx.application import Sphinx

from cadalign.datasets.models import model_keypoints
from cadalign.estimation import document
from cadalign.io.observation_file import OneView, SeveralViews, with_evidence

FORMATS: dict[str, tuple[Any, ...]] = {
    "observation": (with_evidence(OneView), with_evidence(SeveralViews)),
    "model_keypoints": (model_keypoints._File,),
    "fit": (document._Result,),
}


def schema(name: str) -> bytes:
    """The JSON schema of a format, indented."""
    forms, definitions = msgspec.json.schema_components(
        FORMATS[name], ref_template="#/$defs/{name}"
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


def setup(app: Sphinx) -> dict[str, Any]:
    app.add_directive("json-schema", JsonSchema)
    app.connect("build-finished", write_schemas)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
