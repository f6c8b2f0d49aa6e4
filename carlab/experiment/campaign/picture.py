"""Picture of a run of learning: the learning curve, and the last episode with its prediction."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from carlab.core.angles import align_unwrapped
from carlab.core.episode_data import EpisodeData
from carlab.core.observation import episode_features
from carlab.core.quantities import STATE_NAMES, STATE_UNITS
from carlab.core.task import Task
from carlab.experiment.campaign.figures import EpisodeFigures, WindowPredictions
from carlab.recording.picture import outline

CHARACTERS_PER_LINE = 210


@dataclass(frozen=True, slots=True)
class Curve:
    """A panel of the learning curve: label and colour of each figure by its name."""

    title: str
    series: Mapping[str, tuple[str, str]]
    marks_success: bool = False


CURVES = (
    Curve(
        "Return",
        {"total_reward": ("on the car", "tab:blue"), "predicted_return": ("predicted", "tab:orange")},
        marks_success=True,
    ),
    Curve("Distance from the goal at the end [m]", {"distance_m": ("distance", "tab:gray")}),
    Curve(
        "Negative log-likelihood of the\nprevious episode [nat per step]",
        {"last_episode_nll": ("nll", "tab:purple")},
    ),
)


def draw(
    rows: Sequence[EpisodeFigures],
    number: int,
    episode: EpisodeData,
    predictions: WindowPredictions,
    task: Task,
    path: Path,
) -> None:
    """Write a PNG with the learning curve, and an episode with its predictions by the model fitted before it."""
    from matplotlib.figure import Figure

    figure: Any = Figure(figsize=(16, 9))
    figure.set_layout_engine("constrained", w_pad=0.1, h_pad=0.06)
    if rows[-1].verdict:
        figure.suptitle(textwrap.fill(rows[-1].diagnosis, CHARACTERS_PER_LINE), fontsize=9, x=0.01, ha="left")
    upper, lower = figure.subfigures(2, 1, height_ratios=(3, 2))
    curves = [c for c in CURVES if any(np.isfinite(getattr(row, name)) for row in rows for name in c.series)]
    axes = upper.subplots(1, len(curves) + 1, width_ratios=[*([2] * len(curves)), 3], squeeze=False)[0]
    for axis, curve in zip(axes, curves, strict=False):
        _curve(axis, rows, curve)
    _plan(axes[-1], episode, predictions, task)
    axes[-1].set_title(f"Episode {number}: driven, and predicted one second ahead", fontsize=10)
    states = [k for k in range(len(STATE_NAMES)) if np.isfinite(episode.states[:, k]).any()]
    for axis, k in zip(lower.subplots(1, len(states), squeeze=False)[0], states, strict=True):
        _state(axis, k, episode, predictions)
    figure.savefig(path, dpi=120)


def _curve(axis: Any, rows: Sequence[EpisodeFigures], curve: Curve) -> None:
    """Plot figures over the episodes; stars mark successful ones."""
    from matplotlib.ticker import MaxNLocator

    numbers = [row.episode for row in rows]
    first = next(iter(curve.series))
    for name, (label, color) in curve.series.items():
        style = {"marker": "o"} if name == first else {"marker": ".", "linestyle": "--"}
        axis.plot(numbers, [getattr(row, name) for row in rows], color=color, label=label, **style)
    successful = [row for row in rows if row.success]
    if successful and curve.marks_success:
        values = [getattr(row, first) for row in successful]
        axis.plot([row.episode for row in successful], values, "*", color="tab:green", markersize=14, label="success")
    axis.set_title(curve.title, fontsize=10)
    axis.set(xlabel="episode", xlim=(numbers[0] - 0.5, numbers[-1] + 0.5))
    axis.grid(alpha=0.3)
    axis.xaxis.set_major_locator(MaxNLocator(integer=True))
    axis.ticklabel_format(axis="y", useOffset=False)
    if len(axis.get_lines()) > 1:
        _legend_below(axis)


def _legend_below(axis: Any) -> None:
    axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=4, fontsize=8, frameon=False)


def _plan(axis: Any, episode: EpisodeData, predictions: WindowPredictions, task: Task) -> None:
    from matplotlib.patches import Ellipse

    axis.plot(*episode.states[:, :2].T, color="black", linewidth=1.5, label="driven")
    for k, (mean, std) in enumerate(zip(predictions.mean, predictions.std, strict=True)):
        axis.plot(mean[:, 0], mean[:, 1], color="tab:orange", linewidth=1.2, label="predicted" if k == 0 else None)
        width, height = 4.0 * std[-1, :2]
        ellipse = Ellipse((mean[-1, 0], mean[-1, 1]), width, height, alpha=0.25, color="tab:orange", linewidth=0)
        ellipse.set_label("2 standard deviations" if k == 0 else "")
        axis.add_patch(ellipse)
    for name, pose, colour in (("goal", task.goal, "tab:green"), ("end", tuple(episode.states[-1, :3]), "tab:blue")):
        if pose is not None:
            axis.plot(*outline(*pose).T, color=colour, linewidth=2, label=name)
    limits = {"arena": [task.arena_m] if task.arena_m else [], "limit": task.outlines_m}
    for (name, lines), colour in zip(limits.items(), ("black", "tab:red"), strict=True):
        for k, line in enumerate(lines):
            label = name if k == 0 else None
            axis.plot(*np.array([*line, line[0]]).T, color=colour, linewidth=0.8, alpha=0.5, label=label)
    if task.has_constraint:
        features = episode_features(episode.states, episode.sent, task.history_length)[1:]
        violating = episode.states[1:][np.asarray(task.cost(features)) > 0.0]
        axis.plot(*violating[:, :2].T, "x", color="tab:red", label="violation")
    axis.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    _legend_below(axis)


def _state(axis: Any, which: int, episode: EpisodeData, predictions: WindowPredictions) -> None:
    """Plot one measured state and its predictions with twice their standard deviation."""
    measured, mean = episode.states[:, which], predictions.mean[..., which]
    if STATE_NAMES[which] == "yaw" and len(mean):
        measured, mean = align_unwrapped(measured, predictions.ticks[:, 0], mean)
    times_s = episode.times_s - episode.times_s[0]
    axis.plot(times_s, measured, color="black", linewidth=1.2)
    for ticks, window_mean, window_std in zip(predictions.ticks, mean, predictions.std[..., which], strict=True):
        at_s = times_s[ticks]
        axis.plot(at_s, window_mean, color="tab:orange", linewidth=1.2)
        low, high = window_mean - 2.0 * window_std, window_mean + 2.0 * window_std
        axis.fill_between(at_s, low, high, color="tab:orange", alpha=0.25, linewidth=0)
    axis.set_title(f"{STATE_NAMES[which].replace('_', ' ')} [{STATE_UNITS[which]}]", fontsize=9)
    axis.set_xlabel("t [s]", fontsize=8)
    axis.tick_params(labelsize=7)
    axis.grid(alpha=0.3)
