"""`cadalign fit` of many observation files: a folder each, one table and one page."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.progress import track

from cadalign.cli.output import make_folder, new_console
from cadalign.cli.runs import NOTHING_WORKED, SOME_FAILED, SUCCESS, print_json, print_table
from cadalign.errors import CadalignError, DataError
from cadalign.io.documents import read_json
from cadalign.io.files import write_text
from cadalign.web import asset, fill

if TYPE_CHECKING:
    from cadalign.cli.fit import Fit, FittedFile

_COLUMNS = ("file", "keypoints", "rms_px", "rotation_std_deg", "scale_x", "scale_y", "scale_z",
            "warnings", "error")  # fmt: skip


@dataclass(frozen=True)
class _Row:
    """One file's outcome: values of the table's columns, and the picture relative to the page."""

    values: dict[str, Any]
    picture: str | None = None

    @property
    def error(self) -> str:
        return str(self.values["error"])


def fit_many(command: Fit) -> int:
    """Fit every file of a command; returns the exit code, 3 where some have failed."""
    files = [path for given in command.observations for path in _files(given)]
    first = command.observations[0]
    out = command.out or first.with_name(f"{first.resolve().name}_fit" if first.is_dir() else "fit")
    make_folder(out)
    console = new_console()
    shown = track(
        list(zip(files, _names(files), strict=True)),
        "fitting",
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )
    rows = [_fit_one(replace(command, observations=(path,)), name, out) for path, name in shown]
    write_text(out / "results.csv", _csv(rows))
    if command.picture:
        write_text(out / "index.html", _page(rows, title=f"Alignments of {first.name}"))
    failed = sum(bool(row.error) for row in rows)
    if command.json:
        print_json([row.values for row in rows])
    else:
        print_table(_table(rows))
    written = f"Page: {out / 'index.html'}" if command.picture else f"Table: {out / 'results.csv'}"
    console.print(f"{written} ({failed} of {len(rows)} failed)", markup=False)
    if failed == len(rows):
        return NOTHING_WORKED
    return SOME_FAILED if failed else SUCCESS


def _files(given: Path) -> list[Path]:
    """The observation files of a folder, or the file itself."""
    if not given.is_dir():
        return [given]
    found = [path for path in sorted(given.glob("*.json")) if _is_observation(path)]
    if not found:
        raise DataError(
            "the folder holds no observation",
            where=str(given),
            fix="`cadalign annotate` and `cadalign observe --every` write them",
        )
    return found


def _is_observation(path: Path) -> bool:
    """True for a file that is meant as one, damaged ones too."""
    try:
        data = read_json(path)
    except DataError:
        return True
    return isinstance(data, dict) and ("views" in data or {"camera", "keypoints"} <= set(data))


def _names(files: Sequence[Path]) -> list[str]:
    """A folder's name for each file, numbered where files of several folders share a name."""
    counts, seen = Counter(path.stem for path in files), Counter[str]()
    names = []
    for path in files:
        seen[path.stem] += 1
        again = counts[path.stem] > 1
        names.append(f"{path.stem}_{seen[path.stem]}" if again else path.stem)
    return names


def _fit_one(command: Fit, name: str, out: Path) -> _Row:
    file = str(command.observation)
    try:
        fitted = command.fit_file(nullcontext())
    except CadalignError as error:
        return _Row(dict.fromkeys(_COLUMNS, None) | {"file": file, "error": str(error)})
    overlay = None if command.overlay is None else out / name / command.overlay.name
    paths = fitted.write(out / name, overlay=overlay)
    return _Row(_values(file, fitted), f"{name}/{paths[0].name}" if paths else None)


def _values(file: str, fitted: FittedFile) -> dict[str, Any]:
    """Values of a table's row."""
    result = fitted.result
    std = result.std
    scale = [float(value) for value in result.alignment.scale]
    values = (
        file,
        int(result.inliers.sum()),
        result.rms,
        None if std is None else std.rotation_deg,
        *scale,
        "; ".join(result.warnings),
        "",
    )
    return dict(zip(_COLUMNS, values, strict=True))


def _csv(rows: Sequence[_Row]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, _COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(row.values for row in rows)
    return text.getvalue()


def _table(rows: Sequence[_Row]) -> Any:
    from cadalign.evaluation.summary import ConsoleTable

    cells = []
    for row in rows:
        values = row.values
        numbers = [values[name] for name in _COLUMNS[2:7]]
        shown = ["-" if value is None else f"{value:.3g}" for value in numbers]
        note = row.error or (values["warnings"] and "see the page") or ""
        count = "-" if values["keypoints"] is None else str(values["keypoints"])
        cells.append((Path(values["file"]).name, count, *shown, note))
    heads = ("kpts", "rms px", "R +- deg", "s_x", "s_y", "s_z", "note")
    return ConsoleTable("", ("file",), heads, cells, "", narrow=True, grouped=False, wraps=True)


def _page(rows: Sequence[_Row], *, title: str) -> str:
    """The page of all pictures; files without a result come last."""
    ordered = sorted(rows, key=lambda row: bool(row.error))
    failed = sum(bool(row.error) for row in rows)
    return fill(
        "fits.html",
        title=escape(title),
        style=asset("retrieval.css"),
        lead=f"{len(rows) - failed} aligned, {failed} failed. results.csv has the table.",
        cards="".join(map(_card, ordered)),
    )


def _card(row: _Row) -> str:
    values = row.values
    name = escape(Path(values["file"]).name)
    if row.picture is None:
        return fill("fits_failed.html", file=name, error=escape(row.error))
    shown = {
        "residuals": f"{values['rms_px']:.2f} px",
        "keypoints": str(values["keypoints"]),
        "scale": ", ".join(f"{axis} {values[f'scale_{axis}']:.3g}" for axis in "xyz"),
    }
    if values["rotation_std_deg"] is not None:
        shown["rotation"] = f"± {values['rotation_std_deg']:.2g}°"
    if values["warnings"]:
        shown["warning"] = values["warnings"]
    rows = [
        fill("retrieval_value.html", label=label, value=escape(value))
        for label, value in shown.items()
    ]
    return fill("fits_card.html", file=name, picture=escape(row.picture), values="".join(rows))
