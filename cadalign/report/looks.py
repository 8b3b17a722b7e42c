"""Names and colours of methods in a report."""

from __future__ import annotations

import colorsys
from typing import Any

from cadalign.evaluation.options import LIMIT
from cadalign.evaluation.plots import look_of

_INK, _INK_ON_DARK = "#1b1d21", "#e8e9ec"
_LEAST_LIGHTNESS_ON_DARK = 0.62


def method_dict(name: str) -> dict[str, Any]:
    """A method for the page."""
    look = look_of(name)
    is_limit = name == LIMIT
    return {
        "key": name,
        "label": look.label,
        "color": _INK if is_limit else look.color,
        "color_dark": _INK_ON_DARK if is_limit else _on_dark(look.color),
        "dash": "dash" if is_limit else "solid",
        "is_limit": is_limit,
    }


def _on_dark(color: str) -> str:
    """The colour, made lighter if it would hardly be seen on a dark ground."""
    red, green, blue = (int(color[place : place + 2], 16) / 255 for place in (1, 3, 5))
    hue, lightness, saturation = colorsys.rgb_to_hls(red, green, blue)
    lighter = colorsys.hls_to_rgb(hue, max(lightness, _LEAST_LIGHTNESS_ON_DARK), saturation)
    return "#" + "".join(f"{round(255 * part):02x}" for part in lighter)
