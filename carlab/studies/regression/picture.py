"""The regression study as a picture: likelihood, error, calibration and seconds against the number of rows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from carlab.studies.regression.methods import METHODS
from carlab.studies.regression.scores import FIGURES, Row

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_SHOWN_NAT = 12.0
"""Largest difference from the best method at the same number of rows that is on the axis."""
MAX_SHOWN_CALIBRATION = 0.25
MAX_LINEAR_NAT = 10.0
"""Larger likelihoods are on a logarithmic scale."""
LABELS = {
    "nll": "negative log-likelihood [nat]",
    "rmse": "root mean square error",
    "calibration": "calibration error",
    "seconds": "seconds a fit",
}
MAX_RATIO_FINE_TICKS = 100.0
"""A logarithmic axis with a larger ratio has ticks at powers of ten alone."""
SIZE_INCHES = (11.0, 8.0)
_SAME_COLOUR = {"sim-posterior": "gp-sim-posterior", "sim-fsvgd-corrected": "sim-fsvgd", "fsvgd-corrected": "fsvgd"}
"""A method without one of its parts has the same colour, dashed."""


def draw(rows: Sequence[Row], path: Path) -> None:
    """Write a PNG.

    Args:
        rows: of one case, with a fit that did not fail.
        path: to write to.
    """
    picture(rows).savefig(path, dpi=130)


def picture(rows: Sequence[Row]) -> Figure:
    """One panel per figure, one line per method, with a band of one standard error.

    Fits that failed are left out; at least one must have succeeded. A method has the same colour in every picture.
    Values far above the others are arrows at the upper edge with their number.
    """
    from matplotlib.figure import Figure

    rows = [row for row in rows if row.seeds]
    methods = list(dict.fromkeys(row.method for row in rows))
    counts = sorted({row.rows for row in rows})
    figure = Figure(figsize=SIZE_INCHES, layout="constrained")
    axes = figure.subplots(2, 2)
    for axis, name in zip(axes.flat, FIGURES, strict=True):
        highest = _highest(rows, name)
        for method in methods:
            own = sorted((r for r in rows if r.method == method), key=lambda r: r.rows)
            values, errors = (np.array([getattr(r, n) for r in own]) for n in (name, f"{name}_standard_error"))
            style = _style(method, methods)
            axis.plot([r.rows for r in own], values, marker="o", markersize=4, label=method, **style)
            if np.isfinite(errors).any():
                axis.fill_between(
                    [r.rows for r in own], values - errors, values + errors, alpha=0.15, color=style["color"],
                    linewidth=0,
                )  # fmt: skip
        axis.set(xscale="log", xlabel="rows", ylabel=LABELS[name])
        axis.set_xticks(counts, [str(c) for c in counts])
        axis.minorticks_off()
        axis.margins(x=0.08)
        _scale(axis, rows, name, highest)
        axis.grid(alpha=0.3)
    figure.legend(*axes.flat[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(methods), fontsize=9)
    return figure


def _style(method: str, methods: Sequence[str]) -> dict[str, object]:
    """Colour and line of a method; those of other studies come in the order in which they are drawn, the last bold."""
    names = [name for name in METHODS if name not in _SAME_COLOUR]
    others = [name for name in methods if name not in METHODS]
    parent = _SAME_COLOUR.get(method, method)
    known = parent in names
    number = names.index(parent) if known else others.index(method) + (len(names) if len(others) < len(methods) else 0)
    bold = number == 0 if known else method == others[-1]
    return {
        "color": f"C{number}",
        "linestyle": "--" if method in _SAME_COLOUR else "-",
        "markerfacecolor": "white" if method in _SAME_COLOUR else f"C{number}",
        "linewidth": 2.2 if bold else 1.3,
        "zorder": 3.0 if bold else 2.0,
    }


def _highest(rows: Sequence[Row], name: str) -> float | None:
    """Where an axis ends; None where all values are on it."""
    values = [float(getattr(row, name)) for row in rows]
    best = max(min(row.nll for row in rows if row.rows == count) for count in {row.rows for row in rows})
    end = {"nll": best + MAX_SHOWN_NAT, "calibration": MAX_SHOWN_CALIBRATION}.get(name)
    if end is None or max(values) <= end or sum(v <= end for v in values) < len(values) / 2:
        return None
    return end


def _scale(axis: Axes, rows: Sequence[Row], name: str, highest: float | None) -> None:
    """Limits and scale of the values; arrows for values outside."""
    from matplotlib.ticker import FuncFormatter, LogLocator

    values = [float(getattr(row, name)) for row in rows]
    low, high = min(values), max(values)
    methods = list(dict.fromkeys(row.method for row in rows))
    if highest is not None:
        room = 0.06 * (highest - low)
        axis.set_ylim(low - room, highest + room)
        arrows: dict[int, int] = {}
        for row in rows:
            value = float(getattr(row, name))
            if value > highest:
                place = arrows.setdefault(row.rows, 0)
                arrows[row.rows] += 1
                colour = _style(row.method, methods)["color"]
                number = f"{value:.3g}" if value < 1000.0 else f"{value:.0f}"
                axis.annotate(
                    f"↑ {number}", (row.rows, highest + room), (0, -3 - 11 * place), textcoords="offset points",
                    ha="center", va="top", fontsize=8, color=str(colour), zorder=4.0,
                    bbox={"boxstyle": "square,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.8},
                )  # fmt: skip
    elif name == "nll" and high - low > MAX_SHOWN_NAT and high > MAX_LINEAR_NAT:
        axis.set_yscale("symlog", linthresh=MAX_LINEAR_NAT)
    elif name in ("rmse", "seconds") and high > 3.0 * low > 0.0:
        axis.set_yscale("log")
        axis.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < MAX_RATIO_FINE_TICKS * low else (1.0,)))
        axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.minorticks_off()
