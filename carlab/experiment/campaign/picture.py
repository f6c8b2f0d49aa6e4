"""Picture of a run of learning: the learning curve, and the last episode with its prediction."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from carlab.core.angles import align_unwrapped
from carlab.core.episode_data import EpisodeData
from carlab.core.observation import episode_features
from carlab.core.quantities import STATE_NAMES
from carlab.core.task import Task
from carlab.experiment.campaign.figures import EpisodeFigures, WindowPredictions

CAR_M = (0.3, 0.16)
UNITS = ("m", "m", "rad", "m/s", "m/s", "rad/s")


def draw(
    rows: Sequence[EpisodeFigures],
    number: int,
    episode: EpisodeData,
    predictions: WindowPredictions,
    task: Task,
    path: Path,
) -> None:
    """Write a PNG.

    Args:
        rows: one for each episode.
        number: number of the shown episode.
        episode: data of that episode.
        predictions: of that episode, by the model fitted before it.
        task: goal and arena.
        path: file to write.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.ticker import MaxNLocator

    figure = pyplot.figure(figsize=(15, 7.6), layout="constrained")
    grid = figure.add_gridspec(2, 6, height_ratios=(3, 2))
    curve, likelihood, plan = (figure.add_subplot(grid[0, k : k + 2]) for k in (0, 2, 4))
    numbers = [r.episode for r in rows]
    curve.plot(numbers, [r.total_reward for r in rows], marker="o", label="on the car")
    curve.plot(numbers, [r.predicted_return for r in rows], marker=".", linestyle="--", label="in the learned car")
    successes = [r for r in rows if r.success]
    curve.plot([r.episode for r in successes], [r.total_reward for r in successes], "*", markersize=14, label="success")
    curve.set(xlabel="episode", ylabel="return")
    curve.legend(fontsize=8)
    if task.has_constraint:
        cost = curve.twinx()
        cost.plot(numbers, [r.cost for r in rows], marker="x", color="tab:red")
        cost.set_ylabel("constraint cost", color="tab:red")
    likelihood.plot(numbers, [r.last_episode_nll for r in rows], marker="o", color="tab:purple")
    likelihood.set(xlabel="episode", ylabel="negative log-likelihood of the previous episode [nat per step]")
    if task.goal is not None:
        distance = likelihood.twinx()
        distance.plot(numbers, [r.distance_m for r in rows], marker=".", linestyle=":", color="tab:gray")
        distance.set_ylabel("final distance from the goal [m]", color="tab:gray")
    for axis in (curve, likelihood):
        axis.grid(alpha=0.3)
        axis.xaxis.set_major_locator(MaxNLocator(integer=True))
    if rows[-1].verdict:
        figure.suptitle(textwrap.fill(textwrap.shorten(rows[-1].diagnosis, 400, placeholder=" …"), 200), fontsize=8)
    _plan(plan, episode, predictions, task)
    plan.set_title(f"episode {number}: driven, and predicted one second ahead", fontsize=9)
    for k in range(len(STATE_NAMES)):
        _state(figure.add_subplot(grid[1, k]), k, episode, predictions)
    figure.savefig(path, dpi=120)
    pyplot.close(figure)


def _plan(axis: Any, episode: EpisodeData, predictions: WindowPredictions, task: Task) -> None:
    from matplotlib.patches import Ellipse, Polygon

    axis.plot(*episode.states[:, :2].T, color="black", linewidth=1.5, label="driven")
    for k, (mean, std) in enumerate(zip(predictions.mean, predictions.std, strict=True)):
        axis.plot(mean[:, 0], mean[:, 1], color="tab:orange", linewidth=1.2, label="predicted" if k == 0 else None)
        width, height = 4.0 * std[-1, :2]
        axis.add_patch(Ellipse((mean[-1, 0], mean[-1, 1]), width, height, alpha=0.25, color="tab:orange", linewidth=0))
    for name, pose, colour in (("goal", task.goal, "tab:green"), ("end", tuple(episode.states[-1, :3]), "tab:blue")):
        if pose is not None:
            axis.add_patch(Polygon(_outline(pose), fill=False, edgecolor=colour, linewidth=2))
            axis.plot([], [], color=colour, label=name)
    for outline in (*([task.arena_m] if task.arena_m else []), *task.outlines_m):
        axis.plot(*np.array([*outline, outline[0]]).T, color="tab:red", linewidth=0.8, alpha=0.5)
    if task.has_constraint:
        features = episode_features(episode.states, episode.sent, task.history_length)[1:]
        violating = episode.states[1:][np.asarray(task.cost(features)) > 0.0]
        axis.plot(*violating[:, :2].T, "x", color="tab:red", label="violation")
    axis.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axis.legend(fontsize=8)


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
    axis.set_title(f"{STATE_NAMES[which].replace('_', ' ')} [{UNITS[which]}]", fontsize=9)
    axis.set_xlabel("t [s]", fontsize=8)
    axis.tick_params(labelsize=7)
    axis.grid(alpha=0.3)


def _outline(pose: Sequence[float]) -> np.ndarray:
    half = 0.5 * np.array(CAR_M)
    corners = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * half
    sin, cos = np.sin(pose[2]), np.cos(pose[2])
    outline: np.ndarray = corners @ np.array([[cos, sin], [-sin, cos]]) + np.array(pose[:2])
    return outline


__all__ = ["draw"]
