"""The messages of a recording: a table of fields with units, and the protobuf classes created from it at run time.

Poses, transforms and log lines are also written in Foxglove's schemas, which Foxglove and rerun display. These schemas
round (angles become quaternions, times nanoseconds); carlab's own messages keep every number exactly. Field numbers
are permanent: new fields get new numbers, and no number is reused.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

_PACKAGE = "carlab"
_TYPES = {
    "double": descriptor_pb2.FieldDescriptorProto.TYPE_DOUBLE,
    "int64": descriptor_pb2.FieldDescriptorProto.TYPE_INT64,
    "bool": descriptor_pb2.FieldDescriptorProto.TYPE_BOOL,
    "string": descriptor_pb2.FieldDescriptorProto.TYPE_STRING,
}


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a message; ``unit`` is written into the channel's metadata (``1`` for a pure number)."""

    name: str
    type: str
    number: int
    unit: str = ""
    repeated: bool = False


_STAMP = (Field("t_s", "double", 1, "s"), Field("step", "int64", 2, "1"))

MESSAGES: dict[str, tuple[Field, ...]] = {
    "PoseSample": (
        Field("t_capture_s", "double", 1, "s"),
        Field("t_receive_s", "double", 2, "s"),
        Field("sequence", "int64", 3, "1"),
        Field("x_m", "double", 4, "m"),
        Field("y_m", "double", 5, "m"),
        Field("z_m", "double", 6, "m"),
        Field("yaw_rad", "double", 7, "rad"),
        Field("tracked", "bool", 8),
    ),
    "CarState": (
        *_STAMP,
        Field("x_m", "double", 3, "m"),
        Field("y_m", "double", 4, "m"),
        Field("yaw_rad", "double", 5, "rad"),
        Field("vx_mps", "double", 6, "m/s"),
        Field("vy_mps", "double", 7, "m/s"),
        Field("yaw_rate_radps", "double", 8, "rad/s"),
        Field("age_s", "double", 9, "s"),
        Field("t_capture_s", "double", 10, "s"),
        Field("t_receive_s", "double", 11, "s"),
        Field("sequence", "int64", 12, "1"),
        Field("tracked", "bool", 13),
        Field("velocity_delay_s", "double", 14, "s"),
    ),
    "Action": (*_STAMP, Field("steering", "double", 3, "1"), Field("throttle", "double", 4, "1")),
    "Tick": (
        *_STAMP,
        Field("late_s", "double", 3, "s"),
        Field("policy_s", "double", 4, "s"),
        Field("safety_state", "string", 5),
        Field("features", "double", 6, "mixed: the observation of the task", repeated=True),
    ),
    "Transition": (
        *_STAMP,
        Field("features", "double", 3, "mixed: the observation of the task", repeated=True),
        Field("steering", "double", 4, "1"),
        Field("throttle", "double", 5, "1"),
        Field("reward", "double", 6, "1"),
        Field("next_features", "double", 7, "mixed: the observation of the task", repeated=True),
        Field("terminated", "bool", 8),
        Field("truncated", "bool", 9),
    ),
    "SafetyEvent": (Field("t_s", "double", 1, "s"), Field("kind", "string", 2), Field("text", "string", 3)),
    "Health": (
        Field("t_s", "double", 1, "s"),
        Field("ready", "bool", 2),
        Field("problems", "string", 3, repeated=True),
        Field("reading_names", "string", 4, repeated=True),
        Field("reading_values", "double", 5, "at the end of each reading's name", repeated=True),
        Field("warnings", "string", 6, repeated=True),
    ),
    "Extra": (
        *_STAMP,
        Field("names", "string", 3, repeated=True),
        Field("values", "double", 4, "as in the file they were imported from", repeated=True),
    ),
}


def _build_classes() -> dict[str, type[Any]]:
    file = descriptor_pb2.FileDescriptorProto(name="carlab/recording.proto", package=_PACKAGE, syntax="proto3")
    for name, fields in MESSAGES.items():
        message = file.message_type.add(name=name)
        for field in fields:
            proto = message.field.add(name=field.name, number=field.number, type=_TYPES[field.type])
            repeated = descriptor_pb2.FieldDescriptorProto.LABEL_REPEATED
            proto.label = repeated if field.repeated else descriptor_pb2.FieldDescriptorProto.LABEL_OPTIONAL
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return {
        name: message_factory.GetMessageClass(pool.FindMessageTypeByName(f"{_PACKAGE}.{name}")) for name in MESSAGES
    }


CLASSES: dict[str, type[Any]] = _build_classes()

POSE_TOPIC = "/mocap/pose"
SAMPLE_TOPIC = "/mocap/sample"
TRANSFORM_TOPIC = "/tf"
STATE_TOPIC = "/car/state"
REQUESTED_TOPIC = "/car/action_requested"
SENT_TOPIC = "/car/action_sent"
HEALTH_TOPIC = "/car/health"
EXTRA_TOPIC = "/car/extra"
EVENT_TOPIC = "/safety/event"
TICK_TOPIC = "/episode/tick"
TRANSITION_TOPIC = "/episode/transition"
LOG_TOPIC = "/log"

_OWN_TOPICS = {
    SAMPLE_TOPIC: "PoseSample",
    STATE_TOPIC: "CarState",
    REQUESTED_TOPIC: "Action",
    SENT_TOPIC: "Action",
    HEALTH_TOPIC: "Health",
    EXTRA_TOPIC: "Extra",
    EVENT_TOPIC: "SafetyEvent",
    TICK_TOPIC: "Tick",
    TRANSITION_TOPIC: "Transition",
}
TOPIC_CLASSES: dict[str, type[Any]] = {
    POSE_TOPIC: PoseInFrame,
    TRANSFORM_TOPIC: FrameTransform,
    **{topic: CLASSES[name] for topic, name in _OWN_TOPICS.items()},
    LOG_TOPIC: Log,
}
_FOXGLOVE_UNITS = {
    POSE_TOPIC: {"pose.position": "m", "pose.orientation": "1", "timestamp": "s"},
    TRANSFORM_TOPIC: {"translation": "m", "rotation": "1", "timestamp": "s"},
    LOG_TOPIC: {"timestamp": "s"},
}

RUN_RECORD = "carlab.run"
EPISODE_RECORD = "carlab.episode"
CONFIG_ATTACHMENT = "config.toml"


def channel_metadata(topic: str) -> dict[str, str]:
    """Units of the fields of a topic, ``{"unit.x_m": "m", ...}``, for the metadata of its MCAP channel."""
    if topic in _OWN_TOPICS:
        units = {field.name: field.unit for field in MESSAGES[_OWN_TOPICS[topic]] if field.unit}
    else:
        units = _FOXGLOVE_UNITS[topic]
    return {f"unit.{name}": unit for name, unit in units.items()}
