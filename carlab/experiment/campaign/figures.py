"""Figures of an episode of learning, and the model's predictions of a recorded episode."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from carlab.core.episode_data import EpisodeData
from carlab.core.errors import ConfigError
from carlab.core.json_files import plain
from carlab.core.observation import decode_state
from carlab.core.outcome import EndReason
from carlab.core.quantities import FloatArray
from carlab.core.task import Task
from carlab.experiment.campaign.quick_check import EpisodeCheck
from carlab.experiment.episodes.result import EpisodeResult
from carlab.prediction.learned import sample_paths
from learning.rollouts import RolloutModel
from learning.world.model_env import policy_inputs

HORIZON_S = 1.0
STRICT_POSITION_M, STRICT_YAW_RAD = 0.05, 0.2
"""Maximum errors of the final pose in a successful episode, by the criterion of the authors of Sim-FSVGD."""
_RENAMED_KEYS = {"foretold": "predicted_return", "reality": "verdict", "parked": "success"}
"""Keys of learn.json, versions 1 and 2, that version 3 renames."""
_SUMMARY_FIELDS = ("distance_m", "yaw_error_rad", "speed_mps", "cost", "violations")
"""Figures of a summary that are fields of a row."""
_REGULAR_ENDS = {each.name for each in EndReason if not each.is_safety_stop and each is not EndReason.STOP_REQUESTED}
_TYPES: dict[str, Callable[[Any], Any]] = {"int": int, "float": float, "bool": bool, "str": str}


@dataclass(frozen=True, slots=True)
class EpisodeFigures:
    """One row of the learning curve.

    Attributes:
        episode: from 1.
        total_reward: return on the car.
        predicted_return: median return of the same policy in plausible cars (``predicted_return.py``).
        success: whether the task was fulfilled; parking: within 0.2 m and 0.35 rad of the goal, slower than 0.3 m/s.
        distance_m, yaw_error_rad, speed_mps: errors of the final pose, and the final speed; NaN if the task has none.
        rows: number of recorded transitions that the model was fitted to.
        last_episode_nll: negative log-likelihood of the previous episode under the model fitted before it [nat per
            step]; NaN for the first.
        last_episode_calibration_error: calibration error of the same predictions.
        model_seconds, policy_seconds: durations of the fit and of the training [s].
        updates: gradient steps of SAC.
        end: name of the episode's end reason.
        verdict: verdict of the quick check of all episodes so far (explains, left, undecided, failed); empty without
            a quick check.
        excess: errors of the simulator beyond the noise floor, in noise floors; NaN if unknown.
        excess_std: its standard error.
        diagnosis: messages of the quick check.
        predicted_low, predicted_high: interval that contains the return with a probability of 90 %; NaN if unknown.
        prior_change: what changed in the simulator prior before the episode, and why; empty without correction.
        outcome: result of the episode in the words of the task.
        cost: sum of the constraint cost; NaN for a task without a constraint.
        violations: ticks with a constraint cost; NaN for a task without a constraint.
        predicted_cost: mean cost of the same policy in the learned car.
        task_figures: other figures of the task, by name with unit.
    """

    episode: int
    total_reward: float
    predicted_return: float
    success: bool
    distance_m: float
    yaw_error_rad: float
    speed_mps: float
    rows: int
    last_episode_nll: float
    last_episode_calibration_error: float
    model_seconds: float
    policy_seconds: float
    updates: int
    end: str
    verdict: str = ""
    excess: float = float("nan")
    excess_std: float = float("nan")
    diagnosis: str = ""
    predicted_low: float = float("nan")
    predicted_high: float = float("nan")
    prior_change: str = ""
    outcome: str = ""
    cost: float = float("nan")
    violations: float = float("nan")
    predicted_cost: float = float("nan")
    task_figures: Mapping[str, float] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Values for a JSON file; NaN becomes null."""
        row: dict[str, Any] = plain(asdict(self))
        return row

    def with_check(self, check: EpisodeCheck) -> EpisodeFigures:
        """Copy with the result of a quick check."""
        text = " ".join(check.sentences)
        return replace(self, verdict=check.verdict, excess=check.excess, excess_std=check.excess_std, diagnosis=text)

    @classmethod
    def from_dict(cls, row: Mapping[str, Any]) -> EpisodeFigures:
        """Read the output of ``to_dict`` of any version. Raises TypeError or ValueError for other content."""
        values = {_RENAMED_KEYS.get(k, k): v for k, v in _with_nan(row).items()}
        values["task_figures"] = {k: float(v) for k, v in _with_nan(values.get("task_figures", {})).items()}
        types = {f.name: _TYPES[str(f.type)] for f in fields(cls) if str(f.type) in _TYPES}
        return cls(**{k: types[k](v) if k in types else v for k, v in values.items()})

    @property
    def is_strictly_parked(self) -> bool:
        """Whether the final pose meets the criterion of the authors: within 0.05 m and 0.2 rad of the goal.

        False for an episode that a fault or a person ended; only such an episode can be without a tick.
        """
        is_near = self.distance_m < STRICT_POSITION_M and self.yaw_error_rad < STRICT_YAW_RAD
        return is_near and self.end in _REGULAR_ENDS


def _with_nan(row: Mapping[str, Any]) -> dict[str, Any]:
    if not isinstance(row, Mapping):
        raise TypeError(f"{row!r} is not an object")
    return {k: float("nan") if v is None else v for k, v in row.items()}


def figures_of(result: EpisodeResult, training: Mapping[str, Any], task: Task) -> EpisodeFigures:
    """Combine the result of an episode with the figures of the training before it.

    Raises:
        ConfigError: the task cannot state the outcome.
    """
    summary = {**dict.fromkeys(_SUMMARY_FIELDS, float("nan")), **result.summary}

    def optional(name: str) -> float:
        return float(training.get(name, "nan"))

    return EpisodeFigures(
        episode=int(training["episode"]),
        total_reward=result.total_reward,
        predicted_return=float(training.get("predicted_return", training["return_in_model"])),
        success=bool(summary["success"]),
        distance_m=summary["distance_m"],
        yaw_error_rad=summary["yaw_error_rad"],
        speed_mps=summary["speed_mps"],
        rows=int(training["rows"]),
        last_episode_nll=optional("last_episode_nll"),
        last_episode_calibration_error=optional("last_episode_calibration_error"),
        model_seconds=float(training["model_seconds"]),
        policy_seconds=float(training["policy_seconds"]),
        updates=int(training["updates"]),
        end=result.reason.name,
        predicted_low=optional("predicted_low"),
        predicted_high=optional("predicted_high"),
        prior_change=str(training.get("prior_change", "")),
        outcome=_outcome(task, summary, result.path),
        cost=summary["cost"],
        violations=summary["violations"],
        predicted_cost=optional("cost_in_model"),
        task_figures={k: float(v) for k, v in summary.items() if k not in (*_SUMMARY_FIELDS, "success")},
    )


def _outcome(task: Task, summary: Mapping[str, float], recording: Path) -> str:
    """The outcome of an episode in the words of the task. Raises ConfigError if it gives none."""
    try:
        return str(task.outcome(summary))
    except (Exception, SystemExit) as error:
        raise ConfigError(
            f"The task {task.name} cannot state the outcome of {recording} ({type(error).__name__}: {error}); correct "
            "its outcome; the recording is complete."
        ) from error


@dataclass(frozen=True, slots=True)
class WindowPredictions:
    """Predicted states of prediction windows, from recorded initial states and by recorded commands.

    Attributes:
        ticks: ticks of the recording (S, T); the first of each window is its initial state.
        mean, std: mean and standard deviation of x, y [m], yaw [rad], vx, vy [m/s] and yaw rate [rad/s] (S, T, 6).
    """

    ticks: np.ndarray
    mean: FloatArray
    std: FloatArray


def predict_windows(dynamics: RolloutModel, episode: EpisodeData) -> WindowPredictions:
    """Predict consecutive windows of one second by draws of particles and noise; a shorter episode has no window."""
    history = dynamics.history
    length = max(round(HORIZON_S / episode.period_s), 1)
    starts = np.arange(history, episode.ticks - length + 1, length)
    if not len(starts):
        empty = np.zeros((0, length + 1, 6))
        return WindowPredictions(np.zeros((0, length + 1), dtype=np.int64), empty, empty)
    past = episode.sent[starts[:, None] - np.arange(history, 0, -1)]
    commands = episode.sent[starts[:, None] + np.arange(length)]
    paths = sample_paths(dynamics, episode.states[starts], past, commands, seed=0)
    return WindowPredictions(starts[:, None] + np.arange(length + 1), paths.mean(axis=2), paths.std(axis=2))


def predict_ahead(
    dynamics: RolloutModel,
    act: Callable[[NDArray[np.float32]], NDArray[np.float32]],
    features: FloatArray,
    period_s: float,
    *,
    n_samples: int = 16,
) -> tuple[FloatArray, FloatArray]:
    """Predict the paths of the next second by a policy in a learned car, without the slew limits of the safety gate.

    Args:
        dynamics: the learned car with a history of H commands.
        act: commands (N, 2) of the policy for its inputs (N, 7 + 2 H).
        features: encoded states and past commands at the starts (S, 7 + 2 H).
        period_s: control period [s].
        n_samples: sampled paths from each start.

    Returns:
        Mean states (S, K + 1, 6), yaw continuous along a path, and standard deviations of the position across the mean
        heading (S, K + 1) [m].
    """
    generator = torch.Generator().manual_seed(0)
    rows = torch.from_numpy(features).float().repeat_interleave(n_samples, dim=0)
    rollouts = dynamics.rollouts(len(rows), generator)
    states = [decode_state(rows)]
    for _ in range(max(round(HORIZON_S / period_s), 1)):
        action = torch.from_numpy(np.clip(act(policy_inputs(rows.numpy())), -1.0, 1.0))
        rows = rollouts.step(rows, action, generator)
        states.append(decode_state(rows))
    paths = torch.stack(states, dim=1).double().numpy().reshape(len(features), n_samples, len(states), 6)
    paths[..., 2] = np.unwrap(paths[..., 2], axis=2)
    mean = paths.mean(axis=1)
    left = np.stack([-np.sin(mean[..., 2]), np.cos(mean[..., 2])], axis=-1)
    across = ((paths[..., :2] - mean[:, None, :, :2]) * left[:, None]).sum(axis=-1)
    return mean, across.std(axis=1)
