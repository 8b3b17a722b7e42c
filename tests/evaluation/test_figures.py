"""Figures of runs: PNG and PDF of one layout, with letters that publishers take."""

from __future__ import annotations

from pathlib import Path

import pytest

from cadalign.evaluation.plots import STYLE, new_figure, save_figure


def test_a_pdf_has_truetype_letters_and_the_layout_of_the_png(
    tmp_path: Path, font_type: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(STYLE, "pdf.fonttype", font_type)
    places = []
    with new_figure(figsize=(3, 2)) as figure:
        axes = figure.add_subplot()
        axes.set_ylabel("error [deg]")
        savefig = figure.savefig

        def noting(*args: object, **options: object) -> None:
            savefig(*args, **options)  # type: ignore[arg-type]
            places.append(axes.get_position().bounds)

        monkeypatch.setattr(figure, "savefig", noting)
        png, pdf = save_figure(figure, tmp_path / "errors")
    assert png.read_bytes().startswith(b"\x89PNG")
    assert b"/FontFile2" in pdf.read_bytes()
    assert places[0] == places[1]
    assert places[0][0] > 0.15  # room for the label
