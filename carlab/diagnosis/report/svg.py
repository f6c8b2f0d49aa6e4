"""Charts as inline SVG. The page's style sheet sets their colours, so they follow the light and dark schemes."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from markupsafe import Markup, escape
from numpy.typing import ArrayLike

from carlab.core.quantities import FloatArray
from carlab.diagnosis.report.numbers import number

MAX_LINE_POINTS = 600
INTERVAL_BAR_PX = (150, 18)


def nice_ticks(low: float, high: float, max_steps: int = 5) -> list[float]:
    """Ticks in [low, high], a step of 1, 2 or 5 times a power of ten apart, at most ``max_steps`` + 1."""
    if not (math.isfinite(low) and math.isfinite(high)) or high <= low:
        return [low] if math.isfinite(low) else []
    raw = (high - low) / max_steps
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(m * power for m in (1.0, 2.0, 5.0, 10.0) if m * power >= raw * (1 - 1e-9))
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]


def padded(values: ArrayLike, share: float = 0.06, min_margin: float = 1e-9) -> tuple[float, float]:
    """Range of the finite values with a margin; (0, 1) for none."""
    seen = np.asarray(values, dtype=np.float64).ravel()
    seen = seen[np.isfinite(seen)]
    if not len(seen):
        return 0.0, 1.0
    low, high = float(seen.min()), float(seen.max())
    margin = max(share * (high - low), min_margin, 1e-3 * max(abs(low), abs(high)) if high - low < 1e-12 else 0.0)
    return low - margin, high + margin


class Chart:
    """Axes with lines, dots and spans in data coordinates.

    Args:
        title: Text for screen readers; not drawn.
        x: Range of the abscissa.
        y: Range of the ordinate.
        size: Width and height of the drawing [px]; it scales with the page.
        labels: Names of both axes, with units.
        equal: Give both axes the same scale by extending one range.
    """

    def __init__(
        self,
        title: str,
        x: tuple[float, float],
        y: tuple[float, float],
        size: tuple[int, int] = (420, 260),
        labels: tuple[str, str] = ("", ""),
        *,
        equal: bool = False,
    ) -> None:
        self._title = title
        self._size = size
        self._labels = labels
        self._left, self._right, self._top, self._bottom = 46.0, 12.0, 24.0 if labels[1] else 10.0, 38.0
        if equal:
            x, y = self._equalised(x, y)
        self._x, self._y = x, y
        self._back: list[str] = []
        self._front: list[str] = []

    def _equalised(self, x: tuple[float, float], y: tuple[float, float]) -> tuple[tuple[float, float], ...]:
        width = self._size[0] - self._left - self._right
        height = self._size[1] - self._top - self._bottom
        unit = max((x[1] - x[0]) / width, (y[1] - y[0]) / height)
        middle = (0.5 * (x[0] + x[1]), 0.5 * (y[0] + y[1]))
        return tuple((m - 0.5 * unit * px, m + 0.5 * unit * px) for m, px in zip(middle, (width, height), strict=True))

    def px(self, x: float) -> float:
        """Pixel of an abscissa."""
        low, high = self._x
        return self._left + (x - low) / (high - low) * (self._size[0] - self._left - self._right)

    def py(self, y: float) -> float:
        """Pixel of an ordinate."""
        low, high = self._y
        return self._size[1] - self._bottom - (y - low) / (high - low) * (self._size[1] - self._top - self._bottom)

    def line(self, x: FloatArray, y: FloatArray, style: str, breaks: Sequence[int] = ()) -> None:
        """Draw a line through n points, ``x`` and ``y`` (n,); long lines are thinned.

        The line is broken at NaN and before each row of ``breaks``.
        """
        every = max(len(x) // MAX_LINE_POINTS, 1)
        broken = set(breaks)
        pieces: list[str] = []
        pen = "M"
        for k in range(len(x)):
            if k in broken or not (math.isfinite(x[k]) and math.isfinite(y[k])):
                pen = "M"
            if math.isfinite(x[k]) and math.isfinite(y[k]) and (pen == "M" or k % every == 0 or k == len(x) - 1):
                pieces.append(f"{pen}{self.px(x[k]):.1f} {self.py(y[k]):.1f}")
                pen = "L"
        if pieces:
            self._front.append(f'<path class="line {style}" d="{"".join(pieces)}"/>')

    def dots(self, x: FloatArray, y: FloatArray, style: str, radius: float = 3.0) -> None:
        """Draw a dot of ``radius`` [px] at each finite point; ``x`` and ``y`` (n,)."""
        for a, b in zip(x, y, strict=True):
            if math.isfinite(a) and math.isfinite(b):
                self._front.append(
                    f'<circle class="dot {style}" cx="{self.px(a):.1f}" cy="{self.py(b):.1f}" r="{radius:g}"/>'
                )

    def stems(self, x: FloatArray, y: FloatArray, style: str) -> None:
        """Draw a line from zero to each finite point; ``x`` and ``y`` (n,)."""
        for a, b in zip(x, y, strict=True):
            if math.isfinite(a) and math.isfinite(b):
                self._front.append(
                    f'<path class="stem {style}" d="M{self.px(a):.1f} {self.py(0.0):.1f}V{self.py(b):.1f}"/>'
                )

    def across(self, y: float, style: str) -> None:
        """A level all the way across."""
        if not self._y[0] <= y <= self._y[1]:
            return
        right = self._size[0] - self._right
        self._back.append(f'<path class="level {style}" d="M{self._left:.1f} {self.py(y):.1f}H{right:.1f}"/>')

    def spans(self, pieces: Sequence[tuple[float, float]], style: str) -> None:
        """Stretches of the abscissa, shaded from top to bottom."""
        for low, high in pieces:
            low, high = max(low, self._x[0]), min(high, self._x[1])
            if high > low:
                left, right = self.px(low), self.px(high)
                top, bottom = self._top, self._size[1] - self._bottom
                self._back.append(
                    f'<rect class="span {style}" x="{left:.1f}" y="{top:.1f}" width="{right - left:.1f}" '
                    f'height="{bottom - top:.1f}"/>'
                )

    def band(self, low: float, high: float, style: str) -> None:
        """A stretch of the ordinate, shaded all the way across."""
        low, high = max(low, self._y[0]), min(high, self._y[1])
        if high > low:
            width = self._size[0] - self._left - self._right
            self._back.append(
                f'<rect class="span {style}" x="{self._left:.1f}" y="{self.py(high):.1f}" width="{width:.1f}" '
                f'height="{self.py(low) - self.py(high):.1f}"/>'
            )

    def circle(self, x: float, y: float, radius: float, style: str) -> None:
        """A circle in data coordinates, for charts with equal axes."""
        size = abs(self.px(x + radius) - self.px(x))
        self._back.append(f'<circle class="{style}" cx="{self.px(x):.1f}" cy="{self.py(y):.1f}" r="{size:.1f}"/>')

    def render(self) -> Markup:
        """The SVG element."""
        width, height = self._size
        bottom, right = height - self._bottom, width - self._right
        parts = [f'<svg viewBox="0 0 {width} {height}" role="img"><title>{escape(self._title)}</title>']
        for tick in nice_ticks(*self._y, max_steps=4):
            at = self.py(tick)
            parts.append(f'<path class="grid" d="M{self._left:.1f} {at:.1f}H{right:.1f}"/>')
            place = f'x="{self._left - 6:.1f}" y="{at + 3.5:.1f}" text-anchor="end"'
            parts.append(f'<text class="tick" {place}>{number(tick)}</text>')
        for tick in nice_ticks(*self._x, max_steps=5):
            at = self.px(tick)
            parts.append(f'<path class="grid" d="M{at:.1f} {self._top:.1f}V{bottom:.1f}"/>')
            parts.append(
                f'<text class="tick" x="{at:.1f}" y="{bottom + 15:.1f}" text-anchor="middle">{number(tick)}</text>'
            )
        parts += self._back
        parts.append(f'<path class="frame" d="M{self._left:.1f} {bottom:.1f}H{right:.1f}"/>')
        parts += self._front
        x_label, y_label = (escape(label) for label in self._labels)
        if x_label:
            parts.append(f'<text class="label" x="{right:.1f}" y="{height - 6}" text-anchor="end">{x_label}</text>')
        if y_label:
            parts.append(f'<text class="label" x="4" y="13">{y_label}</text>')
        parts.append("</svg>")
        return Markup("".join(parts))


def interval_bar(value: float, low: float, high: float) -> Markup:
    """A number as a dot within its interval, on an axis that starts or ends at zero (drawn as a tick)."""
    if not all(math.isfinite(v) for v in (value, low, high)):
        return Markup("")
    left, right = min(low, 0.0), max(high, 0.0)
    if right - left <= 0.0:
        return Markup("")
    width, height = INTERVAL_BAR_PX
    middle = height / 2

    def at(v: float) -> float:
        return 8.0 + (v - left) / (right - left) * (width - 16.0)

    return Markup(
        f'<svg class="mini" viewBox="0 0 {width} {height}" width="{width}" height="{height}" aria-hidden="true">'
        f'<path class="grid" d="M{at(left):.1f} {middle}H{at(right):.1f}"/>'
        f'<path class="zero" d="M{at(0.0):.1f} 3V{height - 3}"/>'
        f'<path class="interval" d="M{at(low):.1f} {middle}H{at(high):.1f}"/>'
        f'<circle class="dot with_effects" cx="{at(value):.1f}" cy="{middle}" r="4.5"/></svg>'
    )


def bar_rows(
    title: str,
    rows: Sequence[tuple[str, float, str, str]],
    *,
    reference: float | None = None,
    label_px: int = 150,
    size: tuple[int, int] = (560, 26),
) -> Markup:
    """Horizontal bars from zero: label, value, text at the end, style; with a dashed line at ``reference``."""
    width, row_px = size
    finite = [v for _, v, _, _ in rows if math.isfinite(v)]
    top = max([*finite, reference or 0.0, 1e-12])
    low = min([*finite, 0.0])
    room = width - label_px - 62.0
    height = row_px * len(rows) + 8

    def at(v: float) -> float:
        return label_px + (v - low) / (top - low) * room

    parts = [f'<svg viewBox="0 0 {width} {height}" role="img"><title>{escape(title)}</title>']
    for k, (label, value, end_text, style) in enumerate(rows):
        middle = 4 + row_px * (k + 0.5)
        parts.append(
            f'<text class="row" x="{label_px - 8}" y="{middle + 4:.1f}" text-anchor="end">{escape(label)}</text>'
        )
        if math.isfinite(value):
            start, end = sorted((at(0.0), at(value)))
            parts.append(
                f'<rect class="bar {style}" x="{start:.1f}" y="{middle - row_px * 0.33:.1f}" rx="2.5" '
                f'width="{max(end - start, 1.5):.1f}" height="{row_px * 0.66:.1f}"/>'
            )
        end = at(max(value, 0.0)) if math.isfinite(value) else at(0.0)
        parts.append(f'<text class="value" x="{end + 7:.1f}" y="{middle + 4:.1f}">{escape(end_text)}</text>')
    if reference is not None:
        parts.append(f'<path class="level floor" d="M{at(reference):.1f} 0V{height}"/>')
    parts.append("</svg>")
    return Markup("".join(parts))
