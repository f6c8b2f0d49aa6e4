"""Conversion between documents and arrays; defines which state belongs to which command. Pure."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from carlab.core.documents import Document, EpisodeEnded, EpisodeStarted, Tick, Transition
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import DataError
from carlab.core.outcome import EndReason
from carlab.core.quantities import Action, CarState, FloatArray, Observation, PoseSample, Reality

POSE_AGE = "pose_age_s"
VELOCITY_DELAY = "velocity_delay_s"
LATE = "late_s"
POLICY_TIME = "policy_s"
TRACKED = "tracked"
STATISTICS = "statistics."
"""Prefix of the names of statistics in the metadata."""
RECOVERED, RECOVERY = "recovered", "recovery"
"""Metadata of an episode from an unfinished or damaged file: "true", and a sentence."""
Row = tuple[float, int, Observation]
"""Time [s] of an observation, the step that starts with it, and the observation."""
OWN_COLUMNS = (POSE_AGE, VELOCITY_DELAY, LATE, POLICY_TIME, TRACKED)


def episode_from_documents(
    documents: Sequence[Document],
    extra: Mapping[int, Mapping[str, float]] | None = None,
    run_metadata: Mapping[str, str] | None = None,
) -> EpisodeData:
    """Convert the documents of one episode, complete or not, to arrays.

    ``times_s`` are the times of the ticks on the car's clock; the last one is that of the last transition. The last
    command is omitted if no observation follows it (the program was killed, or the car failed during the tick).
    ``extra`` has the columns ``pose_age_s``, ``velocity_delay_s``, ``late_s`` and ``policy_s`` (NaN in the last row,
    which has no tick; columns of NaN are omitted), ``tracked`` (0 or 1) if tracking was ever lost, and the further
    columns of the argument ``extra`` (by step).

    Raises:
        DataError: No tick is followed by an observation.
    """
    started = next((d for d in documents if isinstance(d, EpisodeStarted)), None)
    ended = next((d for d in documents if isinstance(d, EpisodeEnded)), None)
    transitions = {d.step: d for d in documents if isinstance(d, Transition)}
    ticks, rows = _observed(documents, transitions, ended)
    if not ticks:
        how = f"it ended as {ended.reason.name}. {ended.detail}".rstrip() if ended else "its writer was stopped"
        raise DataError(f"The recording holds no complete tick ({how}); record it again.")
    seen = [observation for _, _, observation in rows]
    missing = ticks[-1].step + 1 - ticks[0].step - len(ticks)
    return EpisodeData(
        times_s=np.array([t_s for t_s, _, _ in rows], dtype=np.float64),
        states=np.array([observation.state.to_array() for observation in seen]),
        requested=np.array([tick.requested.to_array() for tick in ticks]),
        sent=np.array([tick.sent.to_array() for tick in ticks]),
        rewards=np.array([getattr(transitions.get(tick.step), "reward", math.nan) for tick in ticks], dtype=np.float64),
        poses=_tracked_poses(seen),
        metadata={
            **(run_metadata or {}),
            **({**started.metadata, **facts_of(started), "config_toml": started.config_toml} if started else {}),
            **_ended_texts(ended),
            **({"missing_ticks": str(missing)} if missing else {}),
        },
        extra=_extra_columns(ticks, rows, extra or {}),
    )


def _observed(
    documents: Sequence[Document], transitions: Mapping[int, Transition], ended: EpisodeEnded | None
) -> tuple[list[Tick], list[Row]]:
    """Ticks whose command is followed by an observation, and the rows of all observations (one more than ticks)."""
    ticks = [d for d in documents if isinstance(d, Tick)]
    rows = [(tick.t_s, tick.step, tick.observation) for tick in ticks]
    if ended is None or ended.last is None or not ticks or ended.steps <= ticks[-1].step:
        return ticks[:-1], rows
    arrival = transitions.get(ended.steps - 1)
    return ticks, [*rows, (ended.t_s if arrival is None else arrival.t_s, ended.steps, ended.last)]


def _tracked_poses(seen: Sequence[Observation]) -> FloatArray:
    """Tracked raw poses (P, 4) of all observations."""
    poses = [pose for observation in seen for pose in observation.poses if pose.tracked]
    columns = [(pose.t_capture_s, pose.x_m, pose.y_m, pose.yaw_rad) for pose in poses]
    return np.array(columns, dtype=np.float64).reshape(-1, 4)


def _extra_columns(
    ticks: Sequence[Tick], rows: Sequence[Row], extra: Mapping[int, Mapping[str, float]]
) -> dict[str, FloatArray]:
    """Further columns (T + 1,) of the rows; columns of NaN are omitted."""
    seen = [observation for _, _, observation in rows]
    names = dict.fromkeys(name for values in extra.values() for name in values)
    columns = {
        POSE_AGE: [t_s - observation.t_capture_s for t_s, _, observation in rows],
        VELOCITY_DELAY: [observation.velocity_delay_s for observation in seen],
        LATE: [*(tick.late_s for tick in ticks), math.nan],
        POLICY_TIME: [*(tick.policy_s for tick in ticks), math.nan],
        **{name: [extra.get(step, {}).get(name, math.nan) for _, step, _ in rows] for name in names},
    }
    arrays = {name: np.array(values, dtype=np.float64) for name, values in columns.items()}
    kept = {name: values for name, values in arrays.items() if not np.isnan(values).all()}
    if not all(observation.tracked for observation in seen):
        kept[TRACKED] = np.array([observation.tracked for observation in seen], dtype=np.float64)
    return kept


def facts_of(started: EpisodeStarted) -> dict[str, str]:
    """Texts of an EpisodeStarted by name, without its configuration and metadata; numbers are exact."""
    return {
        "episode": str(started.episode),
        "start_t_s": repr(started.t_s),
        "start_wall_ns": str(started.wall_ns),
        "car": started.car,
        "reality": started.reality.value,
        "policy": started.policy,
        "task": started.task,
        "seed": str(started.seed),
        "period_s": repr(started.period_s),
        "history_length": str(started.history_length),
        "goal": json.dumps(started.goal),
        "arena_m": json.dumps(started.arena_m),
        "path_m": json.dumps(started.path_m),
    }


def started_from_texts(texts: Mapping[str, str], config_toml: str, metadata: Mapping[str, str]) -> EpisodeStarted:
    """The EpisodeStarted of the texts of ``facts_of``. Raises KeyError or ValueError for other texts."""
    goal = json_value(texts, "goal")
    return EpisodeStarted(
        episode=int(texts["episode"]),
        t_s=float(texts["start_t_s"]),
        wall_ns=int(texts["start_wall_ns"]),
        car=texts["car"],
        reality=Reality(texts["reality"]),
        policy=texts["policy"],
        task=texts["task"],
        seed=int(texts["seed"]),
        period_s=float(texts["period_s"]),
        history_length=int(texts["history_length"]),
        goal=None if goal is None else _numbers(goal, 3),
        arena_m=_points(texts, "arena_m"),
        path_m=_points(texts, "path_m"),
        config_toml=config_toml,
        metadata=metadata,
    )


def json_value(texts: Mapping[str, str], key: str) -> Any:
    """The JSON value under ``key``. Raises KeyError if it is missing, ValueError if it is invalid."""
    try:
        return json.loads(texts[key])
    except RecursionError as error:
        raise ValueError(f"{key} is nested too deeply") from error


def is_number(value: Any) -> bool:
    """Whether a JSON value is a number."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def _points(texts: Mapping[str, str], key: str) -> tuple[Any, ...]:
    points = json_value(texts, key)
    if not isinstance(points, list):
        raise ValueError(f"{key} is not a list")
    return tuple(_numbers(point, 2) for point in points)


def _numbers(value: Any, count: int) -> tuple[Any, ...]:
    """``value`` as a tuple of ``count`` numbers; integers stay integers. Raises ValueError for other values."""
    if not isinstance(value, list) or len(value) != count or not all(map(is_number, value)):
        raise ValueError(f"{count} numbers are expected")
    return tuple(value)


def _ended_texts(ended: EpisodeEnded | None) -> dict[str, str]:
    if ended is None:
        return EndReason.CRASHED.texts()
    return {
        **ended.reason.texts(ended.detail),
        "steps": str(ended.steps),
        "total_reward": repr(ended.total_reward),
        **{f"{STATISTICS}{name}": repr(value) for name, value in ended.statistics.items()},
    }


def goal_of(metadata: Mapping[str, str]) -> tuple[float, float, float] | None:
    """The goal (x [m], y [m], yaw [rad]) in an episode's metadata; None without a goal."""
    goal = json.loads(metadata.get("goal", "null"))
    return None if goal is None else (float(goal[0]), float(goal[1]), float(goal[2]))


def polygon_of(metadata: Mapping[str, str], key: str) -> FloatArray:
    """The points under ``arena_m`` or ``path_m`` in an episode's metadata, shape (n, 2) [m]; n may be 0."""
    return np.array(json.loads(metadata.get(key, "[]")), dtype=np.float64).reshape(-1, 2)


def outlines_of(metadata: Mapping[str, str]) -> list[FloatArray]:
    """Borders of keep-out areas or of a track in an episode's metadata, each (n, 2) [m]; none if malformed."""
    try:
        outlines = [np.array(o, dtype=np.float64).reshape(-1, 2) for o in json.loads(metadata.get("outlines_m", "[]"))]
    except (ValueError, TypeError):
        return []
    return [o for o in outlines if len(o) and np.isfinite(o).all()]


def documents_from_episode(episode: EpisodeData) -> Iterator[Document]:
    """Convert an episode of arrays to documents, so that every sink can write it.

    Values that the arrays lack (times of capture, lateness) are NaN. ``features`` are empty.
    """
    texts = episode.metadata
    yield _started_from_arrays(episode)
    late_s, policy_s = (episode.extra.get(name, np.full(episode.ticks + 1, np.nan)) for name in (LATE, POLICY_TIME))
    seen = list(_observations(episode))
    nothing = np.zeros(0)
    total_reward = 0.0
    for k in range(episode.ticks):
        t_s = float(episode.times_s[k])
        requested, sent = Action.from_array(episode.requested[k]), Action.from_array(episode.sent[k])
        yield Tick(k, t_s, float(late_s[k]), seen[k], nothing, requested, sent, float(policy_s[k]), "")
        if not math.isnan(reward := float(episode.rewards[k])):
            total_reward += reward
            arrival_s = float(episode.times_s[k + 1])
            yield Transition(k, arrival_s, nothing, sent, reward, nothing, terminated=False, truncated=False)
    yield EpisodeEnded(
        t_s=float(episode.times_s[-1]),
        reason=EndReason[texts.get("end_reason", EndReason.COMPLETED.name)],
        detail=texts.get("end_detail", ""),
        steps=episode.ticks,
        total_reward=float(texts.get("total_reward", total_reward)),
        last=seen[-1],
        statistics={k.removeprefix(STATISTICS): float(v) for k, v in texts.items() if k.startswith(STATISTICS)},
    )


def _started_from_arrays(episode: EpisodeData) -> EpisodeStarted:
    """The EpisodeStarted of an episode of arrays; without metadata the car counts as real."""
    texts = episode.metadata
    unknown = EpisodeStarted(
        episode=1,
        t_s=float(episode.times_s[0]),
        wall_ns=0,
        car="unknown",
        reality=Reality.REAL,
        policy="unknown",
        task="unknown",
        seed=0,
        period_s=episode.period_s,
        history_length=0,
    )
    defaults = facts_of(unknown)
    ended = _ended_texts(EpisodeEnded(0.0, EndReason.COMPLETED, "", 0, 0.0))
    written = {*defaults, "config_toml", *ended, RECOVERED, RECOVERY}  # a copy of a damaged recording is not damaged
    metadata = {k: v for k, v in texts.items() if k not in written and not k.startswith(STATISTICS)}
    return started_from_texts({**defaults, **texts}, texts.get("config_toml", ""), metadata)


def _observations(episode: EpisodeData) -> Iterator[Observation]:
    unknown = np.full(episode.ticks + 1, np.nan)
    age_s, delay_s = (episode.extra.get(name, unknown) for name in (POSE_AGE, VELOCITY_DELAY))
    tracked = episode.extra.get(TRACKED, np.ones(episode.ticks + 1))
    # Each raw pose belongs to the first observation that is not older; poses of equal time keep their order.
    owner = np.minimum(np.searchsorted(episode.times_s, episode.poses[:, 0], side="left"), episode.ticks)
    by_owner = np.argsort(owner, kind="stable")
    first = np.searchsorted(owner[by_owner], np.arange(episode.ticks + 2))
    for k, (t_s, state) in enumerate(zip(episode.times_s, episode.states, strict=True)):
        capture_s = float(t_s - age_s[k])
        rows = by_owner[first[k] : first[k + 1]]
        poses = tuple(
            PoseSample(n, t, t, x, y, yaw)
            for n, (t, x, y, yaw) in zip(rows.tolist(), episode.poses[rows].tolist(), strict=True)
        )
        yield Observation(
            CarState.from_array(state), capture_s, capture_s, k, bool(tracked[k]), float(delay_s[k]), poses
        )
