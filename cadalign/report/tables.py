"""The headline table as text: Markdown for pull requests, CSV, LaTeX for papers."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass

from cadalign.errors import InputError
from cadalign.evaluation.metrics.table import Metric
from cadalign.evaluation.plots import look_of
from cadalign.evaluation.summary import csv_text
from cadalign.report.headline import Headline, HeadlineRow, headline_of
from cadalign.report.runs import read_runs

FORMATS = ("md", "csv", "latex")
_NOTHING = "-"
_LATEX = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "µ": r"\textmu{}",
    "\n": " ",
    **{character: f"\\{character}" for character in "&%$#_{}"},
}
# A reader of Markdown takes these for marks, or for HTML.
_MARKDOWN = {character: f"\\{character}" for character in "\\`*_{}[]()#+!|~$"} | {
    "<": "&lt;",
    ">": "&gt;",
    "&": "&amp;",
    "\n": " ",
    "\r": " ",
}


@dataclass(frozen=True)
class _Cell:
    text: str
    is_best: bool = False


def headline_text(runs: Sequence[str | os.PathLike[str]], *, format: str) -> str:
    """The headline table of runs as text.

    Parameters
    ----------
    runs : sequence of path-like
        Folders of runs; see `cadalign.report.write_report`.
    format : {"md", "csv", "latex"}
        Best values are bold but in CSV, whose numbers are not rounded. LaTeX needs the packages
        booktabs and textcomp.

    Examples
    --------
    >>> print(headline_text(["runs/keypointnet"], format="latex"))  # doctest: +SKIP
    """
    if format not in FORMATS:
        raise InputError(
            f"unknown format {format!r}", where="format", fix=f"known are {', '.join(FORMATS)}"
        )
    found = read_runs(runs)
    return table_text(headline_of(found), [run.name for run in found], format=format)


def table_text(headline: Headline, names: Sequence[str], *, format: str) -> str:
    """The table as text; ``names`` are those of the runs. See `headline_text`."""
    writers = {"md": _markdown, "csv": _csv, "latex": _latex}
    return writers[format](headline, names)


def _csv(headline: Headline, names: Sequence[str]) -> str:
    runs = ["run"] if len(names) > 1 else []
    head = [*runs, headline.group, "method", *(column.heading for column in headline.columns)]
    lines: list[list[object]] = []
    for row, name in _rows(headline, names):
        labels = [*([name] if runs else []), row.category, row.method]
        # A cell that is None is empty.
        lines.append([*labels, *(row.cells[column.key] for column in headline.columns)])
    return csv_text([head, *lines])


def _markdown(headline: Headline, names: Sequence[str]) -> str:
    head, rows = _table(headline, names)
    marks = ["---"] * (len(head) - len(headline.columns)) + ["---:"] * len(headline.columns)
    lines = [[_in_markdown(text) for text in head], marks]
    for cells in rows:
        texts = [_in_markdown(cell.text) for cell in cells]
        lines.append(
            [f"**{t}**" if cell.is_best else t for t, cell in zip(texts, cells, strict=True)]
        )
    table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    return f"{table}\n\n{_in_markdown(headline.note)}\n"


def _latex(headline: Headline, names: Sequence[str]) -> str:
    head, rows = _table(headline, names)
    labels = len(head) - len(headline.columns)
    lines = [
        "% needs \\usepackage{booktabs,textcomp}",
        f"\\begin{{tabular}}{{{'l' * labels}{'r' * len(headline.columns)}}}",
        "\\toprule",
        _latex_line([_in_latex(text) for text in head]),
        "\\midrule",
    ]
    group = rows[0][: labels - 1] if rows else []
    for cells in rows:
        if cells[: labels - 1] != group:
            group = cells[: labels - 1]
            lines.append("\\addlinespace")
        lines.append(
            _latex_line(
                [
                    f"\\textbf{{{_in_latex(cell.text)}}}" if cell.is_best else _in_latex(cell.text)
                    for cell in cells
                ]
            )
        )
    return "\n".join([*lines, "\\bottomrule", "\\end{tabular}", ""])


def _latex_line(cells: Sequence[str]) -> str:
    return f"{' & '.join(cells)} \\\\"


def _table(headline: Headline, names: Sequence[str]) -> tuple[list[str], list[list[_Cell]]]:
    """The head and the rows as text, numbers rounded."""
    runs = ["run"] if len(names) > 1 else []
    head = [*runs, headline.group, "method", *(c.heading for c in headline.columns)]
    rows = []
    for row, name in _rows(headline, names):
        labels = [_Cell(name)] if runs else []
        labels += [_Cell(row.category), _Cell(look_of(row.method).label)]
        rows.append(labels + [_number(row, column) for column in headline.columns])
    return head, rows


def _rows(headline: Headline, names: Sequence[str]) -> list[tuple[HeadlineRow, str]]:
    """All rows with their run's name, the paper's behind those on the same category."""
    rows = [(row, names[row.run]) for row in headline.rows]
    for stated in headline.paper:
        place = max(k for k, (row, _) in enumerate(rows) if row.category == stated.category)
        rows.insert(place + 1, (stated, ""))
    return rows


def _number(row: HeadlineRow, column: Metric) -> _Cell:
    value = row.cells[column.key]
    if value is None:
        return _Cell(_NOTHING)
    return _Cell(f"{value:.{column.digits}f}", column.key in row.best)


def _in_markdown(text: str) -> str:
    return "".join(_MARKDOWN.get(character, character) for character in text)


def _in_latex(text: str) -> str:
    return "".join(_LATEX.get(character, character) for character in text)
