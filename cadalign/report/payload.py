"""Payload of the page: one JSON object. Its reader is ``cadalign/web/report``.

::

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
                      "noise", "visibility", "symmetry", "exhibit", "thumb"},
        "rows": {"instance", "method", "status", "reason", each metric's key}
      },
      "plots": [{"id", "title", "kind": "lines", "x": {"label", "unit", "log"}, "y",
                 "traces": [{"run", "method", "x", "y", "low", "high"}], "note"}],
      "pictures": {key: URL}, "thumbs": {key: URL},
      "exhibits": {key: exhibit}, "meshes": {key: mesh}
    }

``tables`` holds columns, each a list: ``category``, ``model``, ``visibility``, ``symmetry`` and
``reason`` are places in ``strings`` (``reason`` -1 where there is none), ``method`` and ``run``
places in the lists above, ``status`` is 1 for a failure. ``id`` is the same for the same instance
of several runs; ``true_y`` and ``true_z`` are what the model was stretched by. Numbers of rows are
as results have them: shown is the value times the metric's ``factor``. ``limit``, the cells of the
headline and the values of ``plots`` are as shown. What is unknown or not finite is null.

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

from collections.abc import Sequence
from typing import Any

from cadalign.evaluation.registry import spec_of
from cadalign.evaluation.runs.opened import Run
from cadalign.report.headline import Headline
from cadalign.report.instances import InstanceTable
from cadalign.report.looks import method_dict
from cadalign.report.runs import all_methods, shown_metrics
from cadalign.report.text import settings_of, summary_of

_FORMAT = 1


def payload_of(
    runs: Sequence[Run],
    headline: Headline,
    table: InstanceTable | None,
    media: dict[str, Any],
    *,
    title: str,
) -> dict[str, Any]:
    """Put the payload of a page on runs of one kind together.

    ``table`` is None for runs without instances; ``media`` is from
    `cadalign.report.media.AssetStore`.
    """
    spec = spec_of(runs[0])
    return {
        "format": _FORMAT,
        "title": title,
        "summary": summary_of(runs),
        "runs": [
            {
                "name": run.name,
                "what": run.experiment,
                "state": "finished" if run.is_finished else "unfinished",
                "done": run.done,
                "total": run.total,
                "settings": [list(pair) for pair in settings_of(run)],
            }
            for run in runs
        ],
        "methods": [method_dict(name) for name in all_methods(runs)],
        "metrics": [metric.page() for metric in shown_metrics(runs)],
        "headline": headline.to_dict(),
        "tables": None if table is None else table.to_dict(),
        "plots": [plot.to_dict() for plot in spec.plots(runs)],
        **media,
    }
