"""The regression study as a picture: likelihood, error and calibration against the number of rows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from carlab.experiment.regression_study import Row

FAR_OFF_NAT = 30.0
_FIGURES = (
    ("nll", "negative log-likelihood [nat]"),
    ("rmse", "root mean square error"),
    ("calibration", "calibration error"),
)


def draw(rows: Sequence[Row], path: Path) -> None:
    """Write a PNG: one panel a figure, one line a method, a band of one standard error about the likelihood.

    Args:
        rows: of one case.
        path: to write to.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    methods = list(dict.fromkeys(row.method for row in rows))
    figure, axes = pyplot.subplots(1, len(_FIGURES), figsize=(13, 4), layout="constrained")
    for axis, (name, label) in zip(axes, _FIGURES, strict=True):
        for method in methods:
            own = sorted((r for r in rows if r.method == method), key=lambda r: r.rows)
            counts, values = [r.rows for r in own], [float(getattr(r, name)) for r in own]
            (line,) = axis.plot(counts, values, marker="o", markersize=4, label=method)
            if name == "nll" and own[0].seeds > 1:
                low, high = ([r.nll + sign * r.nll_standard_error for r in own] for sign in (-1, 1))
                axis.fill_between(counts, low, high, alpha=0.2, color=line.get_color())
        axis.set(xscale="log", xlabel="rows", ylabel=label)
        counts = sorted({row.rows for row in rows})
        axis.set_xticks(counts, [str(c) for c in counts])
        axis.minorticks_off()
        if name == "nll" and max(row.nll for row in rows) > FAR_OFF_NAT:
            axis.set_yscale("symlog", linthresh=20.0)
        elif name == "rmse" and max(row.rmse for row in rows) > 3.0 * min(row.rmse for row in rows):
            axis.set_yscale("log")
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=8)
    figure.savefig(path, dpi=130)
    pyplot.close(figure)


__all__ = ["draw"]
