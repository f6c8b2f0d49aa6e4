"""Summary picture of a diagnosis: held-out scores, and plan views of the largest errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from carlab.diagnosis.findings import Diagnosis, FigureData, Trace
from carlab.diagnosis.settings import REPORT
from carlab.recording.rerun import blueprint

LABELS = {"refit": "refit", "with_effects": "with effects"}


def _escaped(text: str) -> str:
    """Escape text for matplotlib; file names may contain any character."""
    return "".join(c if " " <= c <= "~" else "?" for c in text).replace("$", r"\$")


def _color(rgb: tuple[int, int, int]) -> tuple[float, float, float]:
    return rgb[0] / 255.0, rgb[1] / 255.0, rgb[2] / 255.0


COLORS = {
    "nominal": _color(blueprint.ORANGE),
    "refit": _color(blueprint.VERMILION),
    "with_effects": _color(blueprint.BLUE),
}


def draw_picture(diagnosis: Diagnosis, figure_data: FigureData, path: Path) -> None:
    """Write a PNG; panes without data are omitted.

    Args:
        diagnosis: the result.
        figure_data: scores and traces.
        path: the file; an existing one is replaced.
    """
    figure = Figure(figsize=(13.0, 4.6), layout="constrained", facecolor="white")
    shown = [e for e in figure_data.traces if e.marked]
    panes = figure.subplots(1, 1 + min(len(shown), 2), squeeze=False)[0]
    _draw_scores(panes[0], figure_data)
    for axes, trace in zip(panes[1:], shown, strict=False):
        _worst(axes, trace)
    names = (
        ", ".join(e.id.replace("_", " ") for e in diagnosis.effects[: REPORT.max_picture_names]) or diagnosis.verdict
    )
    if len(diagnosis.effects) > REPORT.max_picture_names:
        names += f" and {len(diagnosis.effects) - REPORT.max_picture_names} more"
    figure.suptitle(_escaped(names), fontsize=11)
    figure.savefig(path, dpi=110)


def _draw_scores(axes: Axes, figure_data: FigureData) -> None:
    labels = [name for name, _ in figure_data.scores_by_step]
    scores = np.array([score for _, score in figure_data.scores_by_step])
    places = np.arange(len(labels))[::-1]
    kinds = [COLORS.get(name, COLORS["with_effects"]) for name in labels]
    axes.barh(places, scores, color=[_color(blueprint.GREY) if n == "noise floor" else c for n, c in zip(labels, kinds,
              strict=True)])  # fmt: skip
    for place, score in zip(places, scores, strict=True):
        axes.text(score, place, f" {score:.2f}", va="center", fontsize=8)
    axes.set_yticks(places, [_escaped(label.replace("_", " ")) for label in labels], fontsize=8)
    axes.set_xlabel("held-out error after one second, in noise floors")
    axes.margins(x=0.15)


def _worst(axes: Axes, trace: Trace) -> None:
    """Plan view of the stretches where the refit is worst."""
    for number, (begin, end) in enumerate(trace.marked):
        rows = (trace.times_s >= begin - 1e-6) & (trace.times_s < end - 1e-6)  # the prediction restarts at the end
        has_label = number == 0
        axes.plot(*trace.recorded[rows, :2].T, color="black", lw=2.2, label="recorded" if has_label else None)
        for name, label in LABELS.items():
            if name in trace.predicted:
                path = trace.predicted[name][rows, :2]
                axes.plot(*path.T, color=COLORS[name], lw=1.6, label=label if has_label else None)
        axes.plot(*trace.recorded[np.argmax(rows), :2], "o", color="black", ms=5)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.set_title(_escaped(f"{trace.name}: largest errors"), fontsize=9)
    axes.legend(fontsize=8, frameon=False)
