"""Contributions of the pieces of evidence to an alignment, as text and as JSON."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from cadalign.estimation.uncertainty.summary import Contribution, Uncertainty

if TYPE_CHECKING:
    from cadalign.estimation.result import Result

_HEADS = ("standard deviations", "rotation", "position", "x", "y", "z", "focal length")


def tabulate_contributions(result: Result) -> str:
    """Table of standard deviations with all evidence and without each piece; empty for one piece.

    Rotation [degrees], position [units of the translation], lengths along x, y, z [%] and, where
    it is estimated, the focal length [%].
    """
    pieces = result.contributions()
    if len(pieces) < 2 or result.std is None:
        return ""
    rows: list[tuple[str, ...]] = [_HEADS, ("with all evidence", *_cells(result.std))]
    several = len(result.views) > 1
    rows += [(f"without {_label(piece, several)}", *_cells(piece.without)) for piece in pieces]
    if result.focal == "known":
        rows = [row[:-1] for row in rows]
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = [
        "  ".join(
            [row[0].ljust(widths[0])]
            + [cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)]
        )
        for row in rows
    ]
    return "\n" + "\n".join(f"  {line}" for line in lines)


def list_contributions(result: Result) -> dict[str, Any]:
    """The same for JSON, as ``contributions``; null for what is not determined."""
    pieces = result.contributions()
    if len(pieces) < 2:
        return {}
    return {
        "contributions": [
            {
                "kind": piece.kind,
                "view": piece.view,
                "name": piece.name,
                "std_without": _finite(asdict(piece.without)),
            }
            for piece in pieces
        ]
    }


def _label(piece: Contribution, several: bool) -> str:
    """The kind of a piece and, of several views, the one in the file's ``views``."""
    return (
        f"{piece.kind} of views[{piece.view}]" if several and piece.view is not None else piece.kind
    )


def _cells(std: Uncertainty) -> tuple[str, ...]:
    position = float(np.linalg.norm(std.translation))
    lengths = [_text(100 * each, " %") for each in (*std.scale, std.focal)]
    return _text(std.rotation_deg, " deg"), _text(position, ""), *lengths


def _text(value: float, unit: str) -> str:
    return f"{value:.2g}{unit}" if np.isfinite(value) else "unknown"


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _finite(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(each) for each in value]
    return value if np.isfinite(value) else None
