"""A plain page that shows the overlays of a run with their numbers."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

from cadalign.evaluation.keypointnet import overlay_name
from cadalign.evaluation.outcome import OK, Outcome
from cadalign.evaluation.summary import CategorySummary, summarize

_PAGE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
:root {{ color-scheme: light dark; font: 16px/1.5 system-ui, sans-serif; }}
body {{ max-width: 76rem; margin: 2rem auto; padding: 0 1rem; }}
table {{ border-collapse: collapse; margin: 1.5rem 0; }}
th, td {{ padding: .3rem .8rem; text-align: right; border-bottom: 1px solid #8886; }}
th:first-child, td:first-child {{ text-align: left; }}
.grid {{ display: grid; grid-template-columns: repeat(auto-fill, minmax(18rem, 1fr)); gap: 1rem; }}
figure {{ margin: 0; border: 1px solid #8886; border-radius: .5rem; overflow: hidden; }}
img {{ display: block; width: 100%; height: auto; }}
figcaption {{ padding: .5rem .75rem; font-size: .85rem; overflow-wrap: anywhere; }}
.failed {{ color: #b00020; }}
@media (prefers-color-scheme: dark) {{ .failed {{ color: #ff8a9a; }} }}
</style>
<h1>{title}</h1>
<p>{text}</p>
{table}
<div class="grid">
{figures}
</div>
</html>
"""


def write_gallery(path: Path, outcomes: Sequence[Outcome], *, title: str, text: str) -> None:
    """Write the page; pictures are looked for in ``overlays`` beside it."""
    path.write_text(
        _PAGE.format(
            title=escape(title),
            text=escape(text),
            table=_table(summarize(outcomes)),
            figures="\n".join(_figure(outcome) for outcome in outcomes),
        ),
        encoding="utf-8",
    )


def _table(summaries: Sequence[CategorySummary]) -> str:
    head = (
        "<tr><th>category<th>instances<th>failed<th>keypoints<th>R error, deg<th>t error"
        "<th>s<sub>y</sub> error, %<th>s<sub>z</sub> error, %<th>box IoU</tr>"
    )
    rows = "".join(
        f"<tr><td>{escape(s.category)}<td>{s.instances}<td>{s.failed}<td>"
        f"{'<td>'.join(s.cells())}</tr>"
        for s in summaries
    )
    return f"<table><caption>Medians over the instances</caption>{head}{rows}</table>"


def _figure(outcome: Outcome) -> str:
    name = f"<b>{escape(outcome.category)}</b> {escape(outcome.model_id)}<br>"
    if outcome.status != OK:
        caption = f'{name}<span class="failed">{escape(outcome.reason)}</span>'
        return f"<figure><figcaption>{caption}</figcaption></figure>"
    source = escape(f"overlays/{overlay_name(outcome.category, outcome.model_id)}", quote=True)
    label = escape(f"{outcome.category} {outcome.model_id} with its boxes", quote=True)
    numbers = (
        f"{outcome.keypoints} keypoints, R {outcome.rotation_error_deg:.2f} deg, "
        f"t {outcome.translation_error:.4f}, s_y {100 * (outcome.scale_y_error or 0):.1f} %, "
        f"s_z {100 * (outcome.scale_z_error or 0):.1f} %, IoU {outcome.box_iou:.3f}"
    )
    return (
        f'<figure><a href="{source}"><img src="{source}" alt="{label}" loading="lazy"></a>'
        f"<figcaption>{name}{numbers}</figcaption></figure>"
    )
