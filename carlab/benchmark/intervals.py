"""Confidence intervals of shares, and shares for tables."""

from __future__ import annotations

import math


def wilson(hits: int, count: int) -> tuple[float, float]:
    """95 % interval of a share (Wilson, 1927). (0, 1) without cases."""
    if count == 0:
        return 0.0, 1.0
    z = 1.96
    share, squared = hits / count, z * z
    middle = (share + squared / (2 * count)) / (1 + squared / count)
    half = z / (1 + squared / count) * math.sqrt(share * (1 - share) / count + squared / (4 * count * count))
    return max(middle - half, 0.0), min(middle + half, 1.0)


def share_text(hits: int, count: int) -> str:
    """A share with its 95 % interval for a table; ``-`` without cases."""
    if count == 0:
        return "-"
    low, high = wilson(hits, count)
    return f"{hits / count:.2f} ({low:.2f} to {high:.2f})"
