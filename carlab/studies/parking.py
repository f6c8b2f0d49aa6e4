"""Learning to park: runs of ``carlab learn`` by method, with several seeds, as curves with bands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from carlab.core.errors import ConfigError, DataError
from carlab.core.json_files import plain, read_json
from carlab.core.method_names import FORMER_METHODS, current_method
from carlab.experiment.campaign.campaign import CAMPAIGN_FILE
from carlab.experiment.campaign.figures import EpisodeFigures
from carlab.experiment.campaign.report import CURVE_FILE
from carlab.experiment.campaign.training_plan import method_of

FINAL_EPISODES = 5
"""Number of last episodes of a run for the share of parked episodes."""


@dataclass(frozen=True, slots=True)
class Curve:
    """One run.

    Attributes:
        method: of the fit of the car.
        seed: of all random numbers.
        updates: requested gradient steps of SAC before an episode.
        episodes: figures of its episodes, in order.
        reality: name of the simulated car; empty for the car of the car file.
    """

    method: str
    seed: int
    updates: int
    episodes: tuple[EpisodeFigures, ...]
    reality: str = ""

    @property
    def first_parked(self) -> int | None:
        """The first episode that ended parked."""
        return next((e.episode for e in self.episodes if e.success), None)


@dataclass(frozen=True, slots=True)
class MethodFigures:
    """The runs of one method.

    Attributes:
        method: name of the method.
        seeds: number of runs.
        episodes: number of episodes of the shortest run.
        first_parked: first episode of each run that ended parked; None if no episode did.
        median_first_parked: over runs; a run that never parked counts as infinite.
        parked_at_last: share of parked episodes among the last ``FINAL_EPISODES``.
        mean_return: of each episode over the runs (E,).
        return_standard_error: of those means (E,); NaN for a single run.
        seconds_an_episode: mean training duration before an episode [s].
        minutes: mean training duration of a run [min].
    """

    method: str
    seeds: int
    episodes: int
    first_parked: tuple[int | None, ...]
    median_first_parked: float
    parked_at_last: float
    mean_return: tuple[float, ...]
    return_standard_error: tuple[float, ...]
    seconds_an_episode: float
    minutes: float


def run_folder(runs: Path, method: str, seed: int) -> Path | None:
    """The folder of an earlier run. Raises DataError if there are several."""
    names = [name for name in (method, *FORMER_METHODS) if current_method(name) == method]
    found = sorted(p for name in names for p in runs.glob(f"*_{run_name(name, seed)}") if p.is_dir())
    if len(found) > 1:
        raise DataError(f"{runs} has {len(found)} runs named {run_name(method, seed)}; remove all but one.")
    return found[0] if found else None


def run_name(method: str, seed: int) -> str:
    """Last part of the name of a run's folder."""
    return f"{method}-seed{seed}"


def check_run(folder: Path, options: Mapping[str, tuple[str, int | str | None]]) -> None:
    """Check that a run was started with the current options.

    Args:
        folder: of the run.
        options: option and value (None if not given), by the name in the plan.

    Raises:
        ConfigError: an option differs.
        DataError: the folder is not a run of carlab learn.
    """
    plan = _plan(folder)
    plan["method"] = method_of(plan)
    for name, (option, value) in options.items():
        earlier = plan.get(name)
        if earlier != value:
            started = f"without {option}" if earlier is None else f"with {option} {earlier}"
            raise ConfigError(f"{folder} was started {started}; use the same option, or choose another folder --runs.")


def _plan(folder: Path) -> dict[str, Any]:
    try:
        plan: dict[str, Any] = read_json(folder / CAMPAIGN_FILE)["plan"]
        return plan
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"{folder} is not a run of carlab learn ({error}); remove it.") from error


def read_curve(folder: Path, last_episode: int | None = None) -> Curve:
    """Read the figures of a run up to an episode. Raises DataError if the folder is not a run of carlab learn."""
    plan = _plan(folder)
    try:
        rows = read_json(folder / CURVE_FILE)["episodes"]
        found = sorted((EpisodeFigures.from_dict(row) for row in rows), key=lambda e: e.episode)
        episodes = tuple(e for e in found if last_episode is None or e.episode <= last_episode)
        return Curve(method_of(plan), int(plan["seed"]), int(plan["updates"]), episodes)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"{folder} is not a run of carlab learn with figures ({error}); remove it.") from error


def _by_number(curve: Curve, name: str, count: int) -> list[float]:
    """A figure of episodes 1 to ``count``; NaN for an episode without a row."""
    rows = {e.episode: float(getattr(e, name)) for e in curve.episodes}
    return [rows.get(number, float("nan")) for number in range(1, count + 1)]


def summarised(curves: Sequence[Curve]) -> list[MethodFigures]:
    """One row per method, in the order of the curves."""
    found = []
    for method in dict.fromkeys(c.method for c in curves):
        own = [c for c in curves if c.method == method and c.episodes]
        if not own:
            continue
        count = min(c.episodes[-1].episode for c in own)
        returns = np.array([_by_number(c, "total_reward", count) for c in own])
        known = np.isfinite(returns).sum(axis=0)
        several, spread = known > 1, np.full(count, np.nan)
        spread[several] = np.nanstd(returns[:, several], axis=0, ddof=1) / np.sqrt(known[several])
        mean = np.full(count, np.nan)
        mean[known > 0] = np.nanmean(returns[:, known > 0], axis=0)
        first = tuple(c.first_parked for c in own)
        parked = [[e.success for e in c.episodes[-FINAL_EPISODES:]] for c in own]
        seconds = [[e.model_seconds + e.policy_seconds for e in c.episodes] for c in own]
        found.append(
            MethodFigures(
                method, len(own), count, first,
                float(np.median([np.inf if f is None else f for f in first])),
                float(np.mean([np.mean(p) for p in parked])),
                tuple(mean.tolist()), tuple(spread.tolist()),
                float(np.mean([np.mean(s) for s in seconds])), float(np.mean([np.sum(s) for s in seconds])) / 60.0,
            )
        )  # fmt: skip
    return found


def as_json(curves: Sequence[Curve], command: str) -> dict[str, Any]:
    """All figures and the command of the study; numbers that are not finite become null."""
    runs = [
        {
            "method": c.method, "seed": c.seed, "updates": c.updates, "reality": c.reality,
            "episodes": [e.to_dict() for e in c.episodes],
        }
        for c in curves
    ]  # fmt: skip
    return {
        "schema": "carlab.parking/1",
        "command": command,
        "methods": [plain(asdict(row)) for row in summarised(curves)],
        "runs": runs,
    }


def draw(curves: Sequence[Curve], path: Path) -> None:
    """Write a PNG: return and distance from the goal against the episode, and the episodes that ended parked.

    Args:
        curves: of all runs.
        path: file to write.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 4.4), layout="constrained")
    reward, distance, parked = figure.subplots(1, 3)
    rows = summarised(curves)
    ticks: list[int] = []
    labels: list[str] = []
    for row in rows:
        own = [c for c in curves if c.method == row.method and c.episodes]
        numbers = np.arange(1, row.episodes + 1)
        mean, error = np.array(row.mean_return), np.array(row.return_standard_error)
        (line,) = reward.plot(numbers, mean, marker="o", markersize=3, label=f"{row.method}, {row.seeds} seeds")
        colour = line.get_color()
        reward.fill_between(numbers, mean - error, mean + error, alpha=0.25, color=colour, linewidth=0)
        metres = np.array([_by_number(c, "distance_m", row.episodes) for c in own])
        known = np.isfinite(metres).any(axis=0)
        metres, driven = metres[:, known], numbers[known]
        distance.plot(driven, np.nanmedian(metres, axis=0), color=colour, marker="o", markersize=3)
        lowest, highest = np.nanmin(metres, axis=0), np.nanmax(metres, axis=0)
        distance.fill_between(driven, lowest, highest, alpha=0.15, color=colour, linewidth=0)
        for curve in own:
            height = -len(ticks)
            ticks.append(height)
            labels.append(f"{curve.method}, {curve.reality} seed {curve.seed}".replace(",  ", ", "))
            for ended_parked in (True, False):
                at = [e.episode for e in curve.episodes if e.success is ended_parked]
                marker, size = ("s", 5) if ended_parked else ("x", 4)
                parked.plot(at, [height] * len(at), marker, color=colour, markersize=size)
    reward.set(xlabel="episode", ylabel="return on the car (mean, standard error)")
    reward.legend(fontsize=8)
    distance.set(xlabel="episode", ylabel="final distance from the goal [m]\n(median, all seeds)", ylim=(0.0, 3.0))
    parked.set(xlabel="episode", title="squares: parked")
    parked.set_yticks(ticks, labels, fontsize=7)
    for axis in (reward, distance, parked):
        axis.grid(alpha=0.3)
        axis.xaxis.get_major_locator().set_params(integer=True)
    figure.savefig(path, dpi=130)
