"""The page: one HTML file with everything inside, and perhaps a folder of pictures beside it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

from cadalign.io.files import dense_json, write_text, writing
from cadalign.report.headline import headline_of
from cadalign.report.instances import instance_table
from cadalign.report.media import INLINE_LIMIT, AssetStore, inline_bytes
from cadalign.report.payload import payload_of
from cadalign.report.runs import all_methods, read_runs, shown_metrics
from cadalign.report.text import title_of
from cadalign.web import asset, fill

# JSON may have these escaped anywhere they can stand; HTML must not see them.
_ESCAPES = {ord(c): f"\\u{ord(c):04x}" for c in "<>&\u2028\u2029"}


@dataclass(frozen=True)
class Report:
    """A page that was written, and the folder of its pictures where they are not inside it."""

    path: Path
    assets: Path | None


def write_report(
    runs: Sequence[str | os.PathLike[str]],
    path: str | os.PathLike[str],
    *,
    assets: bool = False,
    title: str | None = None,
) -> Report:
    """Write the result of runs as a page that needs no network.

    Parameters
    ----------
    runs : sequence of path-like
        Folders of runs, finished or not; several of the same kind are compared.
    path : path-like
        The page to write.
    assets : bool
        Put pictures into a folder beside the page, named after it; they go there in any case if
        the page were larger than 60 MB.
    title : str, optional
        By default it says what was run on what.

    Examples
    --------
    >>> write_report(["runs/keypointnet"], "report.html").assets  # doctest: +SKIP
    >>> write_report(["runs/before", "runs/after"], "compare.html")  # doctest: +SKIP
    """
    page = Path(path)
    found = read_runs(runs)
    with writing(page.parent):
        page.parent.mkdir(parents=True, exist_ok=True)
    table, media = None, {}
    folder = None
    metrics = shown_metrics(found)
    if metrics:
        table = instance_table(found, all_methods(found), metrics)
        if assets or inline_bytes(found) > INLINE_LIMIT:
            folder = page.with_name(f"{page.stem}_assets")
        store = AssetStore(page, folder)
        store.fill(found, table)
        media = store.to_dict()
    payload = payload_of(found, headline_of(found), table, media, title=title or title_of(found))
    write_text(page, render_page(payload))
    return Report(page, folder)


def render_page(payload: dict[str, Any]) -> str:
    """The HTML of a payload; texts in it cannot become part of the page."""
    return fill(
        "report.html",
        title=escape(str(payload["title"])),
        style=asset("report.css"),
        payload=dense_json(payload).translate(_ESCAPES),
        script=asset("report.js"),
    )
