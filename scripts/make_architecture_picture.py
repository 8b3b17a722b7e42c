"""Draw docs/architecture.svg: the README's list of layers, and two journeys through them."""

from __future__ import annotations

import re
from html import escape
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
WIDTH, ROW, TOP = 1080, 34, 56
# Layers by kind, and the kind's colour.
KINDS = {
    "#e8e8ec": "errors names arrays notebook seeding compile",
    "#d9e8f7": "geometry metrics io solvers shapes export estimation torch jax",
    "#dcf0dc": "datasets render web",
    "#fbe9d0": "retrieval evaluation batch report annotate health cli scripts",
}
# The layers that a journey passes, in order, and what happens there.
FIT = "cli options, io observation, estimation checks, solvers search, render overlay"
INSTANCE = (
    "cli options, evaluation task, datasets model, render visible keypoints, estimation fit, "
    "solvers search, geometry errors, report page"
)


def text(x: float, y: float, content: str, style: str = "") -> str:
    """One line of text."""
    return f'<text x="{x}" y="{y}" {style}>{escape(content)}</text>'


def journey(title: str, x: float, color: str, stops: str, rows: dict[str, float]) -> list[str]:
    """A vertical line with a dot in every layer that a journey passes, numbered in order."""
    heights = []
    parts = [text(x - 6, 26, title, f'font-weight="bold" fill="{color}"')]
    for number, stop in enumerate(stops.split(", "), start=1):
        name, note = stop.split(maxsplit=1)
        y = rows[name]
        heights.append(y)
        parts.append(f'<circle cx="{x}" cy="{y}" r="6" fill="{color}"/>')
        parts.append(text(x + 12, y + 4, f"{number} {note}"))
    line = f'<path d="M{x} {min(heights)}V{max(heights)}" stroke="{color}" stroke-width="3"/>'
    return [line, *parts]


def main() -> None:
    """Write the picture, the lowest layer at the bottom."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    listed = readme.split("## How it is built\n\n```\n")[1].split("```")[0]
    layers = re.findall(r"^ *([a-z]+)(?:\.py|/) +(.+)$", listed, re.MULTILINE)[::-1]
    rows = {name: TOP + ROW * k for k, (name, _) in enumerate(layers)}
    height = TOP + ROW * len(layers)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" '
        'font-family="Helvetica, Arial, sans-serif" font-size="13" fill="#222">',
        f'<rect width="{WIDTH}" height="{height}" fill="#fff"/>',
        text(20, 26, "A layer imports only what stands below it", 'font-weight="bold"'),
    ]
    for name, about in layers:
        color = next(color for color, names in KINDS.items() if name in names.split())
        box = f'x="20" y="{rows[name] - 14}" width="{WIDTH - 40}" height="28" rx="5"'
        parts.append(f'<rect {box} fill="{color}"/>')
        parts.append(text(32, rows[name] + 4, name, 'font-weight="bold" font-family="monospace"'))
        parts.append(text(132, rows[name] + 4, about))
    parts += journey("one fit", 760, "#0b63b5", FIT, rows)
    parts += journey("one evaluated instance", 910, "#b54708", INSTANCE, rows)
    picture = "\n".join([*parts, "</svg>\n"])
    (ROOT / "docs" / "architecture.svg").write_text(picture, encoding="utf-8")


if __name__ == "__main__":
    main()
