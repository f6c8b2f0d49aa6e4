"""Summary picture of one or several episodes (matplotlib without a window), for reports and ``carlab view``.

Colours are those of the Okabe-Ito palette and the viridis map, which colour-blind readers can distinguish.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from carlab.core.episode_data import EpisodeData
from carlab.core.errors import DataError
from carlab.core.quantities import FloatArray
from carlab.recording.episode_builder import LATE, POLICY_TIME, POSE_AGE, goal_of, outlines_of, polygon_of
from carlab.recording.sink import describe_os_error, make_folder

CAR_LENGTH_M = 0.42
CAR_WIDTH_M = 0.19
_OUTLINE_COUNT = 9
_PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#8c6d1f")
_TEXT_COLOUR, _LIGHT_GREY = "#333333", "#b8b8b8"
_MAX_PATH_LABELS = 8


def save_summary(episodes: Sequence[EpisodeData], path: Path | str, title: str = "") -> None:
    """Draw episodes into one picture: plan view, commands, speeds, yaw rate and latencies or reward.

    In the plan view, one episode is coloured by time with the car's outline at even intervals. Several episodes have
    one colour each and the outlines of their start and end. Arena, goal and path are those of the first episode with
    them.

    Args:
        episodes: at least one episode.
        path: the picture; its suffix (.png, .svg, .pdf) selects the format. Overwritten; its folder is created.
        title: title of the picture; by default policy, car and reality of the first episode.

    Raises:
        DataError: there is no episode, or the picture cannot be written.
    """
    from matplotlib.figure import Figure

    if not episodes:
        raise DataError("There is no episode to draw; record one with carlab drive.")
    figure = Figure(figsize=(13.0, 7.6), layout="constrained", facecolor="white")
    grid = figure.add_gridspec(4, 2, width_ratios=[1.15, 1.0])
    plan = figure.add_subplot(grid[:, 0])
    axes = [figure.add_subplot(grid[0, 1])]
    axes += [figure.add_subplot(grid[row, 1], sharex=axes[0]) for row in (1, 2, 3)]
    if len(episodes) == 1 and (end := _end_reason(episodes[0])):
        title = f"{title or _title(episodes[0])} ({end})"
    figure.suptitle(title or _title(episodes[0]), fontsize=14, color=_TEXT_COLOUR, fontweight="bold", x=0.01, ha="left")
    _draw_arena_path_and_goal(plan, episodes)
    if len(episodes) == 1:
        _draw_path_by_time(figure, plan, episodes[0])
    else:
        _draw_paths(plan, episodes)
    _draw_commands(axes[0], episodes)
    _draw_velocities(axes[1], axes[2], episodes)
    _draw_latencies_or_rewards(axes[3], episodes)
    _finish_axes(plan, axes)
    try:
        make_folder(Path(path).parent)
        figure.savefig(Path(path), dpi=130)
    except OSError as error:
        raise DataError(describe_os_error(error, path)) from error
    except ValueError as error:
        raise DataError(f"The suffix of {path} is no picture format ({error}); use .png, .svg or .pdf.") from error


def _title(episode: EpisodeData) -> str:
    metadata = episode.metadata
    reality = metadata.get("reality", "").upper()
    parts = (metadata.get("policy", ""), metadata.get("car", ""), reality)
    return " - ".join(part for part in parts if part not in ("", "unknown")) or "Episode"


def _end_reason(episode: EpisodeData) -> str:
    """End reason of an episode as text, for example ``goal reached``."""
    return episode.metadata.get("end_reason", "").replace("_", " ").lower()


def outline(x_m: float, y_m: float, yaw_rad: float) -> FloatArray:
    """Closed outline of the car with a pointed front, shape (6, 2) [m]."""
    half_m, side_m = 0.5 * CAR_LENGTH_M, 0.5 * CAR_WIDTH_M
    nose_m = 0.7 * half_m
    corners = np.array(
        [(-half_m, -side_m), (nose_m, -side_m), (half_m, 0.0), (nose_m, side_m), (-half_m, side_m), (-half_m, -side_m)]
    )
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.asarray(corners @ np.array([[cos, sin], [-sin, cos]]) + np.array([x_m, y_m]))


def _draw_arena_path_and_goal(plan: Any, episodes: Sequence[EpisodeData]) -> None:
    arena = next((a for e in episodes if len(a := polygon_of(e.metadata, "arena_m"))), np.zeros((0, 2)))
    path = next((p for e in episodes if len(p := polygon_of(e.metadata, "path_m"))), np.zeros((0, 2)))
    goal = next((g for e in episodes if (g := goal_of(e.metadata)) is not None), None)
    if len(arena):
        closed = np.vstack([arena, arena[:1]])
        plan.fill(*arena.T, facecolor="#f6f6f4", zorder=0)
        plan.plot(*closed.T, color=_TEXT_COLOUR, linewidth=1.6, label="arena", zorder=1)
    if len(path):
        plan.plot(*path.T, color=_LIGHT_GREY, linewidth=4, solid_capstyle="round", label="path", zorder=1)
    for k, line in enumerate(next((found for e in episodes if (found := outlines_of(e.metadata))), [])):
        label = "limit" if k == 0 else None
        plan.plot(*np.vstack([line, line[:1]]).T, color="#D55E00", linewidth=1.4, label=label, zorder=1)
    if goal is not None:
        shape = outline(*goal)
        plan.fill(*shape.T, facecolor="#009E73", alpha=0.25, zorder=2)
        plan.plot(*shape.T, color="#009E73", linewidth=2.2, linestyle=(0, (3, 1.5)), label="goal", zorder=6)


def _draw_path_by_time(figure: Any, plan: Any, episode: EpisodeData) -> None:
    from matplotlib.collections import LineCollection
    from matplotlib.colors import Normalize

    t_s = episode.times_s - episode.times_s[0]
    positions = episode.states[:, :2]
    segments = LineCollection(
        list(np.stack([positions[:-1], positions[1:]], axis=1)),
        array=t_s[:-1],
        cmap="viridis",
        norm=Normalize(0.0, max(float(t_s[-1]), 1e-9)),
        linewidths=2.6,
        capstyle="round",
        zorder=4,
    )
    plan.add_collection(segments)
    for k in _outline_rows(t_s):
        color = segments.to_rgba(t_s[k])
        shape = outline(*episode.states[k, :3])
        plan.fill(*shape.T, facecolor=color, alpha=0.18, zorder=3)
        plan.plot(*shape.T, color=color, linewidth=1.3, zorder=5)
    _draw_start_and_end(plan, episode, _TEXT_COLOUR, first=True)
    bar = figure.colorbar(segments, ax=plan, orientation="horizontal", shrink=0.6, aspect=40, pad=0.02)
    bar.set_label("time [s]", color=_TEXT_COLOUR)
    bar.outline.set_visible(False)


def _outline_rows(t_s: FloatArray) -> list[int]:
    times_s = np.linspace(0.0, float(t_s[-1]), _OUTLINE_COUNT)
    return sorted({int(k) for k in np.minimum(np.searchsorted(t_s, times_s), len(t_s) - 1)})


def _draw_paths(plan: Any, episodes: Sequence[EpisodeData]) -> None:
    for k, episode in enumerate(episodes):
        color = _color(k)
        number = episode.metadata.get("episode", str(k + 1))
        label = " ".join(filter(None, (number, _end_reason(episode)))) if k < _MAX_PATH_LABELS else None
        plan.plot(*episode.states[:, :2].T, color=color, linewidth=1.9, alpha=0.9, label=label, zorder=4)
        shape = outline(*episode.states[-1, :3])
        plan.fill(*shape.T, facecolor=color, alpha=0.35, zorder=3)
        plan.plot(*shape.T, color=color, linewidth=1.5, zorder=5)
        start = outline(*episode.states[0, :3])
        plan.plot(*start.T, color=color, linewidth=0.8, linestyle=":", zorder=5)
        _draw_start_and_end(plan, episode, color, first=k == 0)


def _draw_start_and_end(plan: Any, episode: EpisodeData, color: str, *, first: bool) -> None:
    start, end = episode.states[0, :2], episode.states[-1, :2]
    marker_style = {
        "linestyle": "none",
        "markersize": 7,
        "markeredgecolor": color,
        "markerfacecolor": "white",
        "zorder": 7,
    }
    plan.plot(*start, marker="o", label="start" if first else None, **marker_style)
    plan.plot(*end, marker="s", label="end" if first else None, **marker_style)


def _draw_commands(axis: Any, episodes: Sequence[EpisodeData]) -> None:
    is_single = len(episodes) == 1
    for k, episode in enumerate(episodes):
        t_s = (episode.times_s - episode.times_s[0])[:-1]
        for channel, (name, style) in enumerate((("steering", "-"), ("throttle", (0, (4, 1.5))))):
            requested, sent = episode.requested[:, channel], episode.sent[:, channel]
            if is_single:
                label = "requested" if channel else None
                axis.step(t_s, requested, where="post", color=_LIGHT_GREY, linewidth=3.0, label=label)
            color = _PALETTE[channel] if is_single else _color(k)
            label = name if k == 0 else None
            axis.step(t_s, sent, where="post", color=color, linestyle=style, linewidth=1.3, label=label)
    commands = np.vstack([np.abs(a) for e in episodes for a in (e.sent, e.requested)])
    max_command = float(np.nanmax(commands, initial=1.0, where=np.isfinite(commands)))
    axis.set_ylim(-1.15 * min(max_command, 2.0), 1.15 * min(max_command, 2.0))
    axis.set_ylabel("command sent")


def _draw_velocities(velocity_axis: Any, yaw_rate_axis: Any, episodes: Sequence[EpisodeData]) -> None:
    is_single = len(episodes) == 1
    for k, episode in enumerate(episodes):
        t_s = episode.times_s - episode.times_s[0]
        vx, vy, yaw_rate = episode.states[:, 3:].T
        color = _PALETTE[0] if is_single else _color(k)
        velocity_axis.plot(t_s, vx, color=color, linewidth=1.5, label="vx" if k == 0 else None)
        vy_color = _PALETTE[1] if is_single else color
        velocity_axis.plot(
            t_s, vy, color=vy_color, linewidth=1.2, linestyle=(0, (4, 1.5)), label="vy" if k == 0 else None
        )
        yaw_rate_axis.plot(t_s, yaw_rate, color=color, linewidth=1.5)
    velocity_axis.set_ylabel("velocity [m/s]")
    yaw_rate_axis.set_ylabel("yaw rate [rad/s]")


def _draw_latencies_or_rewards(axis: Any, episodes: Sequence[EpisodeData]) -> None:
    """Draw the latencies of one episode or the rewards of several; the speed if these were not recorded or all 0."""
    first = episodes[0]
    columns = ((POSE_AGE, "age of the pose"), (LATE, "lateness of the tick"), (POLICY_TIME, "time of the policy"))
    latencies = [(first.extra[name], label) for name, label in columns if name in first.extra]
    if len(episodes) == 1 and latencies:
        t_s = first.times_s - first.times_s[0]
        for (values_s, label), color in zip(latencies, _PALETTE, strict=False):
            axis.plot(t_s, 1e3 * values_s, color=color, linewidth=1.3, label=label)
        axis.set_ylabel("latency [ms]")
        return
    has_rewards = any((np.isfinite(episode.rewards) & (episode.rewards != 0.0)).any() for episode in episodes)
    for k, episode in enumerate(episodes):
        t_s = episode.times_s - episode.times_s[0]
        values = episode.rewards if has_rewards else np.hypot(episode.states[1:, 3], episode.states[1:, 4])
        axis.plot(t_s[1:], values, color=_color(k), linewidth=1.5)
    axis.set_ylabel("reward" if has_rewards else "speed [m/s]")


def _finish_axes(plan: Any, axes: Sequence[Any]) -> None:
    plan.set_aspect("equal", adjustable="datalim")
    plan.set_xlabel("x [m]")
    plan.set_ylabel("y [m]")
    plan.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=5, fontsize=9, frameon=False, columnspacing=1.4)
    for axis in (plan, *axes):
        axis.grid(color="#e6e6e6", linewidth=0.8)
        axis.set_axisbelow(True)
        axis.tick_params(colors=_TEXT_COLOUR, labelsize=9)
        axis.spines[["top", "right"]].set_visible(False)
        axis.spines[["left", "bottom"]].set_color(_LIGHT_GREY)
    for axis in axes:
        axis.margins(x=0.01)
        axis.axhline(0.0, color=_LIGHT_GREY, linewidth=0.8, zorder=0)
        if axis.get_legend_handles_labels()[1]:
            axis.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=9, frameon=False)
    for axis in axes[:-1]:
        axis.tick_params(labelbottom=False)
    axes[-1].set_xlabel("time [s]")


def _color(k: int) -> str:
    return _PALETTE[k % len(_PALETTE)]
