"""Report page: one self-contained HTML file.

``cadalign/web/report`` reads its payload, one JSON object ::

    {
      "format": 1,
      "title": "...", "summary": "one paragraph of plain text",
      "runs": [{"name", "what": the experiment's name,
                "state": "finished" | "unfinished", "done", "total", "settings": [[name, value]]}],
      "methods": [{"key", "color", "color_dark", "dash": "solid" | "dash", "is_limit"}],
      "metrics": [{"key", "label", "unit", "factor", "digits", "better": "low" | "high"}],
      "headline": {"group", "columns": [{"key", "label", "unit", "digits", "better"}],
                   "rows": [{"run", "category", "method", "cells": {key: number}, "best": [key]}],
                   "failures": [{"run", "category", "method", "reason", "count"}],
                   "skipped": likewise, "note"},
      "tables": {
        "strings": [...],
        "instances": {"id", "run", "category", "model", "view", "keypoints", "exhibit", "thumb"},
        "rows": {"instance", "method", "status", "reason", each metric's key}
      },
      "plots": [{"id", "title", "x": {"label", "unit", "log"}, "y",
                 "traces": [{"run", "method", "x", "y"}], "note"}],
      "pictures": {key: URL}, "thumbs": {key: URL},
      "exhibits": {key: exhibit}, "meshes": {key: mesh}
    }

The columns of ``tables`` are lists. ``category``, ``model`` and ``reason`` are indices into
``strings`` (``reason`` is -1 for none), ``method`` and ``run`` indices into the lists above,
``status`` is 1 for a failure. An instance has the same ``id`` in all runs. Values of rows are in
the units of the results; the page multiplies them by the metric's ``factor``. Values of
``headline`` and ``plots`` are in displayed units. Unknown and non-finite values are null.

``exhibit`` and ``thumb`` are keys, -1 for none. An exhibit is an instance record
(`cadalign.evaluation.instances.record`) with the keys of its ``picture`` and ``mesh``, null for
none. Thumbs have boxes drawn in, pictures have none. A mesh is a preview
(`cadalign.evaluation.instances.pictures`) of the data set's model. Methods were given this model
times the exhibit's ``stretch``.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

from cadalign.evaluation.methods import LIMIT
from cadalign.evaluation.plots import color_of
from cadalign.evaluation.registry import spec_of
from cadalign.evaluation.runs.tables import Run
from cadalign.io.files import (
    as_path,
    create_folder,
    dense_json,
    protect_inputs,
    refuse_folder,
    refuse_input,
    write_text,
)
from cadalign.report.headline import headline_of
from cadalign.report.instances import Media, instance_table
from cadalign.report.runs import (
    all_methods,
    read_runs,
    settings_of,
    shown_metrics,
    summary_of,
    title_of,
)
from cadalign.web import asset, fill

_FORMAT = 1
_INK, _INK_ON_DARK = "#1b1d21", "#e8e9ec"
# Characters that HTML could interpret; JSON allows the escapes in all strings.
_ESCAPES = {ord(c): f"\\u{ord(c):04x}" for c in "<>&\u2028\u2029"}


def write_report(
    runs: Sequence[str | os.PathLike[str]],
    path: str | os.PathLike[str],
) -> Path:
    """Write a report of runs as a self-contained HTML page.

    Parameters
    ----------
    runs : sequence of path-like
        Folders of runs, finished or not. Several runs are compared; they are of the same kind.
    path : path-like
        The page to write.

    Returns
    -------
    Path
        The page. Its gallery shows pictures and poses of instances up to a total of 60 MB.

    Examples
    --------
    >>> write_report(["runs/keypointnet"], "report.html")  # doctest: +SKIP
    >>> write_report(["runs/before", "runs/after"], "compare.html")  # doctest: +SKIP
    """
    page = as_path(path)
    refuse_folder(page)
    found = read_runs(runs)
    with protect_inputs(path for run in found for path in run.folder.sources):
        refuse_input(page)
    create_folder(page.parent)
    table, media, summary = None, Media(), summary_of(found)
    metrics = shown_metrics(found)
    if metrics:
        table = instance_table(found, all_methods(found), metrics)
        media.fill(found, table)
    if media.left_out:
        summary += f" The last {media.left_out:,} instances are shown without pictures and poses."
    payload = {
        "format": _FORMAT,
        "title": title_of(found),
        "summary": summary,
        "runs": [_run_dict(run) for run in found],
        "methods": [method_dict(name, k) for k, name in enumerate(all_methods(found))],
        "metrics": [metric.page() for metric in metrics],
        "headline": headline_of(found),
        "tables": None if table is None else table.to_dict(),
        "plots": [plot.to_dict() for plot in spec_of(found[0]).plots(found)],
        **media.to_dict(),
    }
    write_text(page, render_page(payload))
    return page


def render_page(payload: dict[str, Any]) -> str:
    """Render a payload as HTML, with all texts escaped."""
    return fill(
        "report.html",
        title=escape(str(payload["title"])),
        style=asset("report.css"),
        payload=dense_json(payload).translate(_ESCAPES),
        script=asset("report.js"),
    )


def _run_dict(run: Run) -> dict[str, Any]:
    return {
        "name": run.name,
        "what": run.experiment,
        "state": "finished" if run.is_finished else "unfinished",
        "done": run.done,
        "total": run.total,
        "settings": [list(pair) for pair in settings_of(run)],
    }


def method_dict(name: str, place: int) -> dict[str, Any]:
    """A method in the page's format; ``place`` is its index among all methods."""
    is_limit, color = name == LIMIT, color_of(name, place)
    return {
        "key": name,
        "color": _INK if is_limit else color,
        "color_dark": _INK_ON_DARK if is_limit else _lighter(color),
        "dash": "dash" if is_limit else "solid",
        "is_limit": is_limit,
    }


def _lighter(color: str) -> str:
    """Lighten a colour (#rrggbb) for a dark background."""
    return "#" + bytes(part + (255 - part) * 2 // 5 for part in bytes.fromhex(color[1:])).hex()
