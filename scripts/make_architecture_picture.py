"""Draw docs/architecture.svg: the README's layers, and two journeys through them.

Run it again whenever the README's list of layers changes.
"""

from __future__ import annotations

import re
from html import escape
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
WIDTH, ROW, LEFT, JOURNEYS = 1080, 34, 20, 760
# Layers by kind, and the kind's colour.
KINDS = {
    "#e8e8ec": {"errors", "arrays", "seeding", "compile"},
    "#d9e8f7": {"geometry", "metrics", "io", "solvers", "fitting"},
    "#dcf0dc": {"datasets", "render", "web"},
    "#fbe9d0": {"retrieval", "evaluation", "report", "annotate", "health", "cli", "scripts"},
}
# What a journey does in each layer it passes, in the order in which it passes them.
FIT = {
    "cli": "options",
    "io": "observation",
    "fitting": "checks, units",
    "solvers": "search",
    "render": "overlay",
}
INSTANCE = {
    "cli": "options",
    "evaluation": "task, then row",
    "datasets": "model",
    "render": "visible keypoints",
    "fitting": "fit",
    "solvers": "search",
    "geometry": "errors",
    "report": "page",
}


def layers() -> list[tuple[str, str]]:
    """Names and descriptions of the README's list, the lowest layer first."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    found = re.search(r"## How it is built\n\n```\n(.*?)```", text, re.DOTALL)
    assert found is not None
    rows = re.findall(r"^ *([a-z]+)(?:\.py|/) +(.+)$", found[1], re.MULTILINE)
    return [(name, about) for name, about in rows if name != "cadalign"]


def text(x: float, y: float, content: str, style: str = "") -> str:
    """One line of text."""
    return f'<text x="{x}" y="{y}" {style}>{escape(content)}</text>'


def journey(title: str, x: float, color: str, stops: dict[str, str], rows: dict[str, float]) -> str:
    """A vertical line with a labelled dot in every layer that a journey passes."""
    heights = [rows[name] for name in stops]
    line = f'<path d="M{x} {min(heights)}V{max(heights)}" stroke="{color}" stroke-width="3"/>'
    dots = [f'<circle cx="{x}" cy="{rows[name]}" r="6" fill="{color}"/>' for name in stops]
    notes = [
        text(x + 12, rows[name] + 4, f"{number} {note}")
        for number, (name, note) in enumerate(stops.items(), start=1)
    ]
    heading = text(x - 6, 26, title, f'font-weight="bold" fill="{color}"')
    return "\n".join([heading, line, *dots, *notes])


def main() -> None:
    """Write the picture."""
    found = layers()[::-1]
    rows = {name: 56.0 + ROW * k for k, (name, _) in enumerate(found)}
    height = 56 + ROW * len(found) + 14
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" '
        'font-family="Helvetica, Arial, sans-serif" font-size="13" fill="#222">',
        f'<rect width="{WIDTH}" height="{height}" fill="#fff"/>',
        text(LEFT, 26, "A layer imports only what stands below it", 'font-weight="bold"'),
    ]
    for name, about in found:
        color = next(color for color, names in KINDS.items() if name in names)
        y = rows[name]
        parts += [
            f'<rect x="{LEFT}" y="{y - 14}" width="{WIDTH - 2 * LEFT}" height="28" rx="5" '
            f'fill="{color}"/>',
            text(LEFT + 12, y + 4, name, 'font-weight="bold" font-family="monospace"'),
            text(LEFT + 112, y + 4, about),
        ]
    parts.append(journey("one fit", JOURNEYS, "#0b63b5", FIT, rows))
    parts.append(journey("one evaluated instance", JOURNEYS + 150, "#b54708", INSTANCE, rows))
    picture = "\n".join([*parts, "</svg>\n"])
    (ROOT / "docs" / "architecture.svg").write_text(picture, encoding="utf-8")


if __name__ == "__main__":
    main()
