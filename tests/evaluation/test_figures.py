"""Figures of runs: PNG and PDF with the same layout, and with TrueType fonts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure

from cadalign.evaluation.metrics import NOISE, ROTATION
from cadalign.evaluation.plots import STYLE, Plot, Trace, draw_plot


def test_a_pdf_has_truetype_letters_and_the_layout_of_the_png(
    tmp_path: Path, font_type: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(STYLE, "pdf.fonttype", font_type)
    places, savefig = [], Figure.savefig

    def noting(figure: Figure, *args: Any, **options: Any) -> None:
        savefig(figure, *args, **options)
        places.append(figure.axes[0].get_position().bounds)

    monkeypatch.setattr(Figure, "savefig", noting)
    trace = Trace.from_values(0, "optimal", [1.0, 2.0], [0.5, 0.7], ROTATION)
    png, pdf = draw_plot(tmp_path / "errors", Plot("errors", NOISE, ROTATION, [trace]))
    assert png.read_bytes().startswith(b"\x89PNG")
    assert b"/FontFile2" in pdf.read_bytes()
    assert places[0] == places[1]
    assert places[0][0] > 0.05  # room for the label
