"""Conversion between documents and MCAP messages. Pure; carlab's own messages keep every number exactly."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame

from carlab.core.documents import EpisodeEnded, EpisodeStarted, HealthReading, SafetyEvent, Tick, Transition
from carlab.core.outcome import EndReason
from carlab.core.quantities import Action, CarState, Health, Observation, PoseSample
from carlab.recording.episode_builder import facts_of, is_number, json_value, started_from_texts
from carlab.recording.mcap import schemas as schemas
from carlab.recording.sink import Item, LogLine

MAX_UNIX_NS = 253_402_300_799 * 10**9
_LEVELS = ((logging.CRITICAL, 5), (logging.ERROR, 4), (logging.WARNING, 3), (logging.INFO, 2), (logging.DEBUG, 1))
_NUMBERS = {number: level for level, number in _LEVELS}


@dataclass(frozen=True, slots=True)
class Stamped:
    """One message for the file; the times are on the car's clock [s]."""

    topic: str
    message: Any
    t_s: float
    publish_s: float
    sequence: int = 0


class UnixMapping:
    """Conversion of the car's clock [s] to Unix time [ns] by the two origins in the EpisodeStarted."""

    def __init__(self, t_s: float, wall_ns: int) -> None:
        self._t_s = t_s
        self._wall_ns = wall_ns

    def to_ns(self, t_s: float) -> int:
        """Unix time [ns] of a time on the car's clock; the origin for NaN."""
        offset_s = t_s - self._t_s
        if not math.isfinite(offset_s):
            offset_s = 0.0
        return min(max(self._wall_ns + round(offset_s * 1e9), 0), MAX_UNIX_NS)


def text(value: str) -> str:
    """Replace lone surrogates (file names in another encoding) by question marks, so that UTF-8 can encode the text."""
    return value.encode("utf-8", "replace").decode("utf-8")


def encode(item: Item, unix: UnixMapping, now_s: float) -> Iterator[Stamped]:
    """Yield the messages of a document in file order.

    ``now_s`` is the time of the newest document; log lines, which have wall-clock time only, get this time.
    EpisodeStarted yields no message and EpisodeEnded its last observation; the rest is metadata.
    """
    match item:
        case Tick():
            yield from _tick(item, unix)
        case Transition():
            features, next_features = (np.asarray(each).tolist() for each in (item.features, item.next_features))
            action = {"steering": item.action.steering, "throttle": item.action.throttle}
            transition = _message("Transition", item, features=features, next_features=next_features, **action)
            yield Stamped(schemas.TRANSITION_TOPIC, transition, item.t_s, item.t_s, item.step)
        case SafetyEvent():
            event = schemas.CLASSES["SafetyEvent"](t_s=item.t_s, kind=text(item.kind), text=text(item.text))
            yield Stamped(schemas.EVENT_TOPIC, event, item.t_s, item.t_s)
            line = LogLine(unix.to_ns(item.t_s), logging.WARNING, "safety", f"{item.kind}: {item.text}")
            yield _log(line, item.t_s)
        case HealthReading():
            health = schemas.CLASSES["Health"](
                t_s=item.t_s,
                ready=item.health.ready,
                problems=[text(problem) for problem in item.health.problems],
                reading_names=list(item.health.readings),
                reading_values=list(item.health.readings.values()),
                warnings=[text(warning) for warning in item.health.warnings],
            )
            yield Stamped(schemas.HEALTH_TOPIC, health, item.t_s, item.t_s)
        case EpisodeEnded():
            if item.last is not None:
                yield from _observation(item.last, item.steps, item.t_s, unix)
            level = logging.WARNING if item.reason.is_safety_stop else logging.INFO
            sentence = f"{item.reason.name}: {item.reason.sentences(item.detail)}"
            yield _log(LogLine(unix.to_ns(item.t_s), level, "episode", sentence), item.t_s)
        case LogLine():
            yield _log(item, now_s)
        case EpisodeStarted():
            return


def _message(name: str, source: object, **others: Any) -> Any:
    """A message whose fields are ``others``, or the attributes of ``source`` that have the names of its fields."""
    own = {field.name: getattr(source, field.name) for field in schemas.MESSAGES[name] if field.name not in others}
    return schemas.CLASSES[name](**own, **others)


def _tick(item: Tick, unix: UnixMapping) -> Iterator[Stamped]:
    yield from _observation(item.observation, item.step, item.t_s, unix)
    for topic, action in ((schemas.REQUESTED_TOPIC, item.requested), (schemas.SENT_TOPIC, item.sent)):
        message = _message("Action", action, t_s=item.t_s, step=item.step)
        yield Stamped(topic, message, item.t_s, item.t_s, item.step)
    features = np.asarray(item.features).tolist()
    tick = _message("Tick", item, safety_state=text(item.safety_state), features=features)
    yield Stamped(schemas.TICK_TOPIC, tick, item.t_s, item.observation.t_capture_s, item.step)


def _observation(seen: Observation, step: int, t_s: float, unix: UnixMapping) -> Iterator[Stamped]:
    for pose in seen.poses:
        yield Stamped(schemas.SAMPLE_TOPIC, _message("PoseSample", pose), t_s, pose.t_capture_s, step)
        if pose.tracked:
            in_frame = PoseInFrame(frame_id="map")
            in_frame.timestamp.FromNanoseconds(unix.to_ns(pose.t_capture_s))
            position = in_frame.pose.position
            position.x, position.y, position.z = pose.x_m, pose.y_m, pose.z_m
            _turn(in_frame.pose.orientation, pose.yaw_rad)
            yield Stamped(schemas.POSE_TOPIC, in_frame, t_s, pose.t_capture_s, step)
    state = seen.state
    message = _message("CarState", seen, t_s=t_s, step=step, age_s=t_s - seen.t_capture_s, **asdict(state))
    yield Stamped(schemas.STATE_TOPIC, message, t_s, seen.t_capture_s, step)
    transform = FrameTransform(parent_frame_id="map", child_frame_id="base_link")
    transform.timestamp.FromNanoseconds(unix.to_ns(seen.t_capture_s))
    transform.translation.x, transform.translation.y = state.x_m, state.y_m
    _turn(transform.rotation, state.yaw_rad)
    yield Stamped(schemas.TRANSFORM_TOPIC, transform, t_s, seen.t_capture_s, step)


def _turn(quaternion: Any, yaw_rad: float) -> None:
    half_rad = 0.5 * yaw_rad if math.isfinite(yaw_rad) else 0.0
    quaternion.z, quaternion.w = math.sin(half_rad), math.cos(half_rad)


def _log(line: LogLine, t_s: float) -> Stamped:
    number = next((number for level, number in _LEVELS if line.level >= level), 0)
    message = Log(level=Log.Level.ValueType(number), message=text(line.message), name=text(line.name))
    message.timestamp.FromNanoseconds(min(max(line.wall_ns, 0), MAX_UNIX_NS))
    return Stamped(schemas.LOG_TOPIC, message, t_s, t_s)


def started_to_metadata(started: EpisodeStarted) -> dict[str, str]:
    """Everything of an EpisodeStarted except the configuration, which is an attachment; numbers are exact."""
    facts = {**facts_of(started), **{f"metadata.{key}": value for key, value in started.metadata.items()}}
    return {text(key): text(value) for key, value in facts.items()}


def ended_to_metadata(ended: EpisodeEnded) -> dict[str, str]:
    """Everything of an EpisodeEnded except its last observation, which is a message."""
    return {
        "end_t_s": repr(ended.t_s),
        **ended.reason.texts(text(ended.detail)),
        "steps": str(ended.steps),
        "total_reward": repr(ended.total_reward),
        "statistics": json.dumps(dict(ended.statistics)),
    }


def started_from_metadata(record: Mapping[str, str], config_toml: str) -> EpisodeStarted:
    """The EpisodeStarted written by ``started_to_metadata``. Raises KeyError or ValueError for another record."""
    prefix = "metadata."
    metadata = {key.removeprefix(prefix): value for key, value in record.items() if key.startswith(prefix)}
    return started_from_texts(record, config_toml, metadata)


def ended_from_metadata(record: Mapping[str, str], last: Observation | None) -> EpisodeEnded:
    """The EpisodeEnded written by ``ended_to_metadata``. Raises KeyError or ValueError for another record."""
    statistics = json_value(record, "statistics")
    if not isinstance(statistics, dict) or not all(is_number(value) for value in statistics.values()):
        raise ValueError("statistics are not a mapping of names to numbers")
    return EpisodeEnded(
        t_s=float(record["end_t_s"]),
        reason=EndReason[record["end_reason"]],
        detail=record["end_detail"],
        steps=int(record["steps"]),
        total_reward=float(record["total_reward"]),
        last=last,
        statistics=statistics,
    )


def decode_pose(m: Any) -> PoseSample:
    """Decode a PoseSample message."""
    return PoseSample(m.sequence, m.t_capture_s, m.t_receive_s, m.x_m, m.y_m, m.yaw_rad, m.z_m, m.tracked)


def decode_observation(m: Any, poses: tuple[PoseSample, ...]) -> Observation:
    """Decode a CarState message and the preceding poses to an observation."""
    state = CarState(m.x_m, m.y_m, m.yaw_rad, m.vx_mps, m.vy_mps, m.yaw_rate_radps)
    return Observation(state, m.t_capture_s, m.t_receive_s, m.sequence, m.tracked, m.velocity_delay_s, poses)


def decode_action(m: Any) -> Action:
    """Decode the action of an Action or Transition message."""
    return Action(m.steering, m.throttle)


def decode_transition(m: Any) -> Transition:
    """Decode a Transition message."""
    return Transition(
        step=m.step,
        t_s=m.t_s,
        features=np.array(m.features, dtype=np.float64),
        action=decode_action(m),
        reward=m.reward,
        next_features=np.array(m.next_features, dtype=np.float64),
        terminated=m.terminated,
        truncated=m.truncated,
    )


def decode_health(m: Any) -> HealthReading:
    """Decode a Health message."""
    readings = dict(zip(m.reading_names, m.reading_values, strict=False))
    return HealthReading(m.t_s, Health(m.ready, tuple(m.problems), readings, tuple(m.warnings)))


def decode_log(m: Any) -> LogLine:
    """Decode a Log message; the level is that of the standard library's logging."""
    return LogLine(m.timestamp.ToNanoseconds(), _NUMBERS.get(m.level, logging.NOTSET), m.name, m.message)
