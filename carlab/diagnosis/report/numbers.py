"""Numbers, shares, units and lists in the sentences of a report."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence


def number(value: float) -> str:
    """Format three significant digits with a minus sign (U+2212); an exponent only outside [1e-6, 1e6)."""
    if not math.isfinite(value):
        return "no limit" if value == math.inf else "minus no limit" if value == -math.inf else "unknown"
    if value == 0.0:
        return "0"
    size = abs(value)
    if size >= 1e6 or size < 1e-6:
        text = f"{value:.3g}"
    else:
        text = f"{value:.{max(2 - math.floor(math.log10(size)), 0)}f}"
        text = text.rstrip("0").rstrip(".") if "." in text else text
    return text.replace("-", "−")


def percent(share: float) -> str:
    """Format a share in per cent. A share below 1 is never rounded to 100 %, a share above 0 never to 0 %."""
    value = 100.0 * share
    if not math.isfinite(value):
        return "an unknown share"
    text = f"{value:.0f}" if abs(value) >= 9.5 or value == 0.0 else f"{value:.1f}"
    if text in ("100", "0.0", "-0.0") and value not in (100.0, 0.0):
        text = f"{value:.2g}" if abs(value) < 1 else "more than 99" if value < 100 else "100"
    return text.replace("-", "−") + " %"


def unit_text(unit: str) -> str:
    """Format a unit with superscripts: ``N s2/m2`` -> ``N s²/m²``; empty for 1."""
    if unit in ("", "1"):
        return ""
    return re.sub(r"(?<=[a-z])([23])", lambda m: "²³"[int(m[1]) - 2], unit)


def with_unit(value: float, unit: str) -> str:
    """A number and its unit."""
    return f"{number(value)} {unit_text(unit)}".strip() if math.isfinite(value) else number(value)


def listed(parts: Sequence[str], last: str = "and") -> str:
    """``a, b and c``."""
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} {last} {parts[-1]}" if parts else ""
