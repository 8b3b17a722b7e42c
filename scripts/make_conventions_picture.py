"""Draw docs/concepts/conventions.svg: camera axes, the model's axes, and pixel centres."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
from matplotlib.axes import Axes

PICTURE = Path(__file__).resolve().parents[1] / "docs" / "concepts" / "conventions.svg"
COLORS = {"x": "#c62828", "y": "#2e7d32", "z": "#1565c0"}


def axes_cross(ax: Axes, origin: tuple[float, float], ends: dict[str, tuple[float, float]]) -> None:
    """Three named arrows."""
    for name, (dx, dy) in ends.items():
        end = (origin[0] + dx, origin[1] + dy)
        ax.annotate(
            "", end, origin, arrowprops={"arrowstyle": "-|>", "color": COLORS[name], "lw": 2}
        )
        ax.text(origin[0] + 1.15 * dx, origin[1] + 1.15 * dy, name, color=COLORS[name],
                ha="center", va="center", fontsize=13, fontweight="bold")  # fmt: skip


def draw_scene(ax: Axes) -> None:
    """A camera that looks at a box, each with its axes."""
    axes_cross(ax, (0, 0), {"x": (0.55, -0.4), "y": (0, -0.9), "z": (1.5, 0.2)})
    ax.text(-0.1, 0.25, "camera", ha="right", fontsize=11)
    axes_cross(ax, (4.2, -1.1), {"x": (0.75, -0.2), "y": (0, 1.1), "z": (-0.6, -0.3)})
    ax.text(4.35, 0.25, "model", fontsize=11)
    ax.set(xlim=(-1, 5.5), ylim=(-1.9, 0.9), aspect="equal")


def draw_pixels(ax: Axes) -> None:
    """The corner of an image, with the coordinates of pixel centres."""
    for line in range(5):
        ax.plot([0, 4], [line, line], color="#9e9e9e", lw=1)
        ax.plot([line, line], [0, 4], color="#9e9e9e", lw=1)
    for column in range(4):
        ax.plot(column + 0.5, 0.5, "o", color="#424242", ms=4)
        ax.text(column + 0.5, 0.28, f"({column}, 0)", ha="center", va="center", fontsize=9)
    ax.plot(0, 0, "s", color="#c62828", ms=6, clip_on=False)
    ax.text(
        0, -0.25, "corner: (-0.5, -0.5);\n(0, 0) in COLMAP and in JSON", color="#c62828", fontsize=9
    )
    ax.set(xlim=(-0.2, 4.4), ylim=(4.2, -0.9), aspect="equal")


def main() -> None:
    """Draw both and write the picture; the same bytes every time."""
    matplotlib.rcParams["svg.hashsalt"] = "cadalign"
    figure, axes = plt.subplots(1, 2, figsize=(9.5, 3.4), width_ratios=(6, 4), layout="constrained")
    draw_scene(axes[0])
    draw_pixels(axes[1])
    for ax in axes:
        ax.set_axis_off()
    figure.patch.set_facecolor("white")
    figure.savefig(PICTURE, metadata={"Date": None})


if __name__ == "__main__":
    main()
