"""`cadalign fit` of many observation files: a folder each, one table and one page."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

from rich.progress import track

from cadalign.cli.fit import FittedFile
from cadalign.cli.options import make_folder, new_console
from cadalign.cli.runs import NOTHING_WORKED, SOME_FAILED, SUCCESS, print_json, print_table
from cadalign.errors import CadalignError, DataError
from cadalign.io.documents import read_json
from cadalign.io.files import write_text
from cadalign.web import asset, fill

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


def fit_many(
    observations: Sequence[Path],
    fit_one: Callable[[Path, Any], FittedFile],
    *,
    out: Path | None,
    picture: bool,
    overlay: Path | None,
    json: bool,
) -> int:
    """Fit every file, or every one of a folder; returns the exit code, 3 where some have failed.

    Parameters
    ----------
    observations : sequence of Path
    fit_one : callable
        Fits a file, of which the parsed content is given where it is known.
    out : Path, optional
        Folder to write to; by default beside the first file or folder.
    picture : bool
        Write the page of all pictures.
    overlay : Path, optional
        Name of the overlays in the files' folders.
    json : bool
        Print the table as JSON.
    """
    found = [file for given in observations for file in _files(given)]
    files, first = [path for path, _ in found], observations[0]
    out = out or first.with_name(f"{first.resolve().name}_fit" if first.is_dir() else "fit")
    make_folder(out)
    console = new_console()
    shown = track(
        list(zip(found, _names(files), strict=True)),
        "fitting",
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )
    rows = []
    for (path, data), name in shown:
        try:
            fitted = fit_one(path, data)
        except CadalignError as error:
            failure = {"file": str(path), "error": str(error)}
            rows.append(_Row(dict.fromkeys(_COLUMNS, None) | failure))
            continue
        own = None if overlay is None else out / name / overlay.name
        paths = fitted.write(out / name, overlay=own)
        rows.append(_Row(_values(str(path), fitted), f"{name}/{paths[0].name}" if paths else None))
    write_text(out / "results.csv", _csv(rows))
    if picture:
        write_text(out / "index.html", _page(rows, title=f"Alignments of {first.name}"))
    failed = sum(bool(row.error) for row in rows)
    if json:
        print_json([row.values for row in rows])
    else:
        print_table(_table(rows))
    written = f"Page: {out / 'index.html'}" if picture else f"Table: {out / 'results.csv'}"
    console.print(f"{written} ({failed} of {len(rows)} failed)", markup=False)
    if failed == len(rows):
        return NOTHING_WORKED
    return SOME_FAILED if failed else SUCCESS


def _files(given: Path) -> list[tuple[Path, Any]]:
    """The observation files of a folder with their content, or the file itself.

    The content is None where it is still to be read, or cannot be.
    """
    if not given.is_dir():
        return [(given, None)]
    parsed = [(path, _parsed(path)) for path in sorted(given.glob("*.json"))]
    found = [(path, data) for path, data in parsed if data is None or _is_observation(data)]
    if not found:
        raise DataError(
            "the folder holds no observation",
            where=str(given),
            fix="`cadalign annotate` and `cadalign observe --every` write them",
        )
    return found


def _parsed(path: Path) -> Any:
    """A file's content; None for a damaged one, of which the fit tells."""
    try:
        return read_json(path) or {}
    except DataError:
        return None


def _is_observation(data: Any) -> bool:
    """True for what is meant as one."""
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
