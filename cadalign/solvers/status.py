"""What a compiled kernel reports, since it cannot raise errors with words."""

from typing import Final

OK: Final = 0
TOO_FEW: Final = 1
"""Fewer points than the method needs."""
DEGENERATE: Final = 2
"""The points do not span a volume."""
NOT_FOUND: Final = 3
"""No alignment with all points in front of the camera."""
