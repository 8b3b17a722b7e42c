"""The edges of one box, cut off at the faces of another."""

from __future__ import annotations

import numpy as np

from cadalign.arrays import FloatArray
from cadalign.compile import kernel

_PARALLEL = 1e-14  # share of an edge's length that its direction must have across a face


@kernel
def clipped_edges(
    extents: FloatArray, clip: FloatArray, axes: FloatArray, center: FloatArray, ends: FloatArray
) -> int:
    """Write the ends of those parts of a box's edges that lie inside another box; their number.

    The boxes have the side lengths ``extents`` and ``clip``; ``axes`` (columns), ``center`` and
    ``ends`` (24, 3) of the first are in the frame of the second.
    """
    count = 0
    start = np.empty(3)
    step = np.empty(3)
    for along in range(3):
        one, other = (along + 1) % 3, (along + 2) % 3
        for corner in range(4):
            a = extents[one] * (0.5 if corner % 2 else -0.5)
            b = extents[other] * (0.5 if corner // 2 else -0.5)
            enter, leave = 0.0, 1.0
            for c in range(3):
                step[c] = axes[c, along] * extents[along]
                start[c] = center[c] + axes[c, one] * a + axes[c, other] * b - 0.5 * step[c]
                half = 0.5 * clip[c]
                if abs(step[c]) <= _PARALLEL * extents[along]:
                    if abs(start[c]) > half * (1.0 + 1e-12):
                        leave = -1.0
                    continue
                first, last = (-half - start[c]) / step[c], (half - start[c]) / step[c]
                enter = max(enter, min(first, last))
                leave = min(leave, max(first, last))
            if enter <= leave:
                for c in range(3):
                    ends[count, c] = start[c] + enter * step[c]
                    ends[count + 1, c] = start[c] + leave * step[c]
                count += 2
    return count
