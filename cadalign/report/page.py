"""The page: one HTML file with everything inside, and perhaps a folder of pictures beside it.

Its payload is one JSON object, which ``cadalign/web/report`` reads ::

    {
      "format": 1,
      "title": "...", "summary": "one paragraph of plain text",
      "runs": [{"name", "what": the experiment's name,
                "state": "finished" | "unfinished", "done", "total", "settings": [[name, value]]}],
      "methods": [{"key", "label", "color", "color_dark", "dash": "solid" | "dash", "is_limit"}],
      "metrics": [{"key", "label", "unit", "factor", "digits", "better": "low" | "high", "log",
                   "limit"}],
      "headline": {"group", "columns": [{"key", "label", "unit", "digits", "better"}],
                   "rows": [{"run", "category", "method", "cells": {key: number}, "best": [key]}],
                   "failures": [{"run", "category", "method", "reason", "count"}],
                   "skipped": likewise,
                   "paper": [{"category", "method", "cells"}], "note"},
      "tables": {
        "strings": [...],
        "instances": {"id", "run", "category", "model", "view", "keypoints", "true_y", "true_z",
                      "noise", "exhibit", "thumb"},
        "rows": {"instance", "method", "status", "reason", each metric's key}
      },
      "plots": [{"id", "title", "kind": "lines", "x": {"label", "unit", "log"}, "y",
                 "traces": [{"run", "method", "x", "y", "low", "high"}], "note"}],
      "pictures": {key: URL}, "thumbs": {key: URL},
      "exhibits": {key: exhibit}, "meshes": {key: mesh}
    }

``tables`` holds columns, each a list: ``category``, ``model`` and ``reason`` are places in
``strings`` (``reason`` -1 where there is none), ``method`` and ``run`` places in the lists above,
``status`` is 1 for a failure. ``id`` is the same for the same instance of several runs; ``true_y``
and ``true_z`` are what the model was stretched by. Numbers of rows are as results have them: shown
is the value times the metric's ``factor``. ``limit``, the cells of the headline and the values of
``plots`` are as shown. What is unknown or not finite is null.

``exhibit`` and ``thumb`` are keys, -1 for none. An exhibit is an instance record
(`cadalign.evaluation.instances.record`) with the keys of its ``picture``, which has no boxes drawn
in as thumbs have, and of its ``mesh``, both null where there is none. A mesh is a preview
(`cadalign.evaluation.instances.pictures`) of the dataset's model: that, times the exhibit's
``stretch``, is the model that methods were given.

Where pictures are in a folder beside the page, instead of ``exhibits`` and ``meshes`` there are
``exhibit_files``, scripts that call ``cadalignExhibit(key, exhibit)`` for ``exhibits_per_file``
keys each (key k is in file k / exhibits_per_file), and ``mesh_files``, by key, that call
``cadalignMesh(key, mesh)``. A page opened from a file may load scripts, but not fetch.
"""

from __future__ import annotations

import colorsys
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import Any

from cadalign.evaluation.methods import LIMIT
from cadalign.evaluation.plots import Plot, look_of
from cadalign.evaluation.runs.tables import Run
from cadalign.io.files import (
    as_path,
    dense_json,
    keeping,
    made_folder,
    refuse_folder,
    refuse_input,
    write_text,
)
from cadalign.report.headline import headline_of
from cadalign.report.instances import (
    INLINE_LIMIT,
    AssetStore,
    inline_bytes,
    instance_table,
)
from cadalign.report.runs import (
    all_methods,
    by_spec,
    read_runs,
    settings_of,
    shown_metrics,
    summary_of,
    title_of,
)
from cadalign.web import asset, fill

_FORMAT = 1
_INK, _INK_ON_DARK = "#1b1d21", "#e8e9ec"
_LEAST_LIGHTNESS_ON_DARK = 0.62
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
        Folders of runs, finished or not; several of the same kind are compared, and runs over many
        observations stand beside each other and beside one with truth.
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
    page = as_path(path)
    refuse_folder(page)
    found = read_runs(runs)
    with keeping(path for run in found for path in run.folder.sources):
        refuse_input(page)
    made_folder(page.parent)
    table, media, folder = None, {}, None
    metrics = shown_metrics(found)
    if metrics:
        table = instance_table(found, all_methods(found), metrics)
        if assets or inline_bytes(found) > INLINE_LIMIT:
            folder = page.with_name(f"{page.stem}_assets")
        store = AssetStore(page, folder)
        store.fill(found, table)
        media = store.to_dict()
    payload = {
        "format": _FORMAT,
        "title": title or title_of(found),
        "summary": summary_of(found),
        "runs": [_run_dict(run) for run in found],
        "methods": [method_dict(name) for name in all_methods(found)],
        "metrics": [metric.page() for metric in metrics],
        "headline": headline_of(found).to_dict(),
        "tables": None if table is None else table.to_dict(),
        "plots": [plot.to_dict() for plot in _plots(found)],
        **media,
    }
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


def _run_dict(run: Run) -> dict[str, Any]:
    return {
        "name": run.name,
        "what": run.experiment,
        "state": "finished" if run.is_finished else "unfinished",
        "done": run.done,
        "total": run.total,
        "settings": [list(pair) for pair in settings_of(run)],
    }


def _plots(runs: Sequence[Run]) -> list[Plot]:
    """The plots of all runs; those of several kinds share the plot of the same metric."""
    found: dict[str, Plot] = {}
    for spec, places in by_spec(runs):
        for plot in spec.plots([runs[k] for k in places]):
            traces = [replace(trace, run=places[trace.run]) for trace in plot.traces]
            known = found.get(plot.id)
            before = [] if known is None else known.traces
            found[plot.id] = replace(known or plot, traces=[*before, *traces])
    return list(found.values())


def method_dict(name: str) -> dict[str, Any]:
    """A method for the page."""
    look = look_of(name)
    if name != LIMIT:
        return line_dict(name, look.label, look.color)
    limit = line_dict(name, look.label, _INK)
    return {**limit, "color_dark": _INK_ON_DARK, "dash": "dash", "is_limit": True}


def line_dict(key: str, label: str, color: str) -> dict[str, Any]:
    """Mark of a method on the page, drawn as solid lines of a colour (#rrggbb)."""
    return {
        "key": key,
        "label": label,
        "color": color,
        "color_dark": _on_dark(color),
        "dash": "solid",
        "is_limit": False,
    }


def _on_dark(color: str) -> str:
    """The colour, made lighter if it would hardly be seen on a dark ground."""
    red, green, blue = (int(color[place : place + 2], 16) / 255 for place in (1, 3, 5))
    hue, lightness, saturation = colorsys.rgb_to_hls(red, green, blue)
    lighter = colorsys.hls_to_rgb(hue, max(lightness, _LEAST_LIGHTNESS_ON_DARK), saturation)
    return "#" + "".join(f"{round(255 * part):02x}" for part in lighter)
