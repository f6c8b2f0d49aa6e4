"""ROS bags of a drive with known poses and commands, in all formats of ROS 1 and ROS 2."""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from mcap_ros2.writer import Writer as McapWriter
from rosbags.interfaces import Nodetype
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

EPOCH_NS = 1_764_500_000_000_000_000
POSE, COMMAND = "/car/pose", "/drive"
NETWORK_NS = 3_000_000
"""Time from the stamp of a header to the reception of its message."""
TYPES = {POSE: "geometry_msgs/msg/PoseStamped", COMMAND: "ackermann_msgs/msg/AckermannDriveStamped"}
HEADER = "builtin_interfaces/Time stamp\nstring frame_id\n"
ACKERMANN = {
    TYPES[COMMAND]: "std_msgs/Header header\nackermann_msgs/AckermannDrive drive\n",
    "ackermann_msgs/msg/AckermannDrive": (
        "float32 steering_angle\nfloat32 steering_angle_velocity\nfloat32 speed\nfloat32 acceleration\nfloat32 jerk\n"
    ),
}
SEPARATOR = "=" * 80 + "\n"
SCHEMAS = {
    TYPES[POSE]: "std_msgs/Header header\ngeometry_msgs/Pose pose\n"
    f"{SEPARATOR}MSG: std_msgs/Header\n{HEADER}"
    f"{SEPARATOR}MSG: geometry_msgs/Pose\ngeometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n"
    f"{SEPARATOR}MSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n"
    f"{SEPARATOR}MSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
    TYPES[COMMAND]: ACKERMANN[TYPES[COMMAND]]
    + f"{SEPARATOR}MSG: std_msgs/Header\n{HEADER}"
    + f"{SEPARATOR}MSG: ackermann_msgs/AckermannDrive\n{ACKERMANN['ackermann_msgs/msg/AckermannDrive']}",
}
MAPPING = """
[columns]
x = "/car/pose/pose/position/x"
y = "/car/pose/pose/position/y"
yaw = "/car/pose/pose/orientation/yaw"
[columns.steering]
name = "/drive/drive/steering_angle"
scale = 2.5
[columns.throttle]
name = "/drive/drive/speed"
scale = 0.25
"""


def messages(drive: dict[str, np.ndarray], every: int = 5) -> Iterator[tuple[str, int, tuple[float, ...]]]:
    """Topic, stamp [ns] and numbers of each message: all poses of a drive, and each ``every``-th command before it."""
    for k, time_s in enumerate(drive["t"]):
        stamp_ns = EPOCH_NS + round(time_s * 1e9)
        if k % every == 0:
            yield COMMAND, stamp_ns - 1_000_000, (drive["steering"][k] / 2.5, drive["throttle"][k] / 0.25)
        yield POSE, stamp_ns, (drive["x"][k], drive["y"][k], drive["yaw"][k])


def write_bag(path: Path, drive: dict[str, np.ndarray], every: int = 5, lead_ns: int = 0) -> Path:
    """Write a bag: ``.bag`` of ROS 1, ``.mcap`` by the library of Foxglove, or the folder of a ROS 2 bag.

    The name of a folder ends in its format, ``sqlite3`` or ``mcap``. ``lead_ns`` is added to the stamps of the headers.
    """
    if path.suffix == ".mcap":
        return _write_foxglove(path, drive, every, lead_ns)
    store = get_typestore(Stores.ROS1_NOETIC if path.suffix == ".bag" else Stores.ROS2_HUMBLE)
    for name, text in ACKERMANN.items():
        store.register(get_types_from_msg(text, name))
    is_ros1 = path.suffix == ".bag"
    if is_ros1:
        writer = Rosbag1Writer(path)
    else:
        plugin = StoragePlugin.MCAP if path.name.endswith("mcap") else StoragePlugin.SQLITE3
        writer = Rosbag2Writer(path, version=8, storage_plugin=plugin)
    with writer:
        connections = {topic: writer.add_connection(topic, kind, typestore=store) for topic, kind in TYPES.items()}
        for topic, stamp_ns, numbers in messages(drive, every):
            message = _message(store.types, topic, stamp_ns + lead_ns, numbers, is_ros1)
            encode = store.serialize_ros1 if is_ros1 else store.serialize_cdr
            writer.write(connections[topic], stamp_ns + NETWORK_NS, encode(message, TYPES[topic]))
    return path


def _message(types, topic, stamp_ns, numbers, is_ros1):
    stamp = types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 1_000_000_000))
    sequence = {"seq": 0} if is_ros1 else {}
    header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="map", **sequence)
    if topic == COMMAND:
        drive = types["ackermann_msgs/msg/AckermannDrive"](numbers[0], 0.0, numbers[1], 0.0, 0.0)
        return types[TYPES[COMMAND]](header=header, drive=drive)
    x, y, yaw = numbers
    position = types["geometry_msgs/msg/Point"](x, y, 0.05)
    orientation = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
    return types[TYPES[POSE]](header=header, pose=types["geometry_msgs/msg/Pose"](position, orientation))


def _write_foxglove(path: Path, drive: dict[str, np.ndarray], every: int, lead_ns: int) -> Path:
    with path.open("wb") as file:
        writer = McapWriter(file)
        schemas = {topic: writer.register_msgdef(kind, SCHEMAS[kind]) for topic, kind in TYPES.items()}
        for topic, stamp_ns, numbers in messages(drive, every):
            sec, nanosec = divmod(stamp_ns + lead_ns, 1_000_000_000)
            content = {"header": {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": "map"}}
            if topic == COMMAND:
                content["drive"] = {"steering_angle": numbers[0], "speed": numbers[1]}
            else:
                x, y, yaw = numbers
                rotation = {"x": 0.0, "y": 0.0, "z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}
                content["pose"] = {"position": {"x": x, "y": y, "z": 0.05}, "orientation": rotation}
            writer.write_message(topic, schemas[topic], content, stamp_ns + NETWORK_NS)
        writer.finish()
    return path


def write_messages(path: Path, messages, definitions: dict[str, str] | None = None) -> Path:
    """Write the folder of a ROS 2 bag from topic, type, time of reception [ns] and content of each message.

    A content names some fields; the others are zero or empty. ``definitions`` are those of further or changed types.
    """
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in {**ACKERMANN, **(definitions or {})}.items():
        store.fielddefs.pop(name, None)
        store.register(get_types_from_msg(text, name))
    plugin = StoragePlugin.MCAP if path.name.endswith("mcap") else StoragePlugin.SQLITE3
    connections = {}
    with Rosbag2Writer(path, version=8, storage_plugin=plugin) as writer:
        for topic, kind, received_ns, content in messages:
            if (topic, kind) not in connections:
                connections[topic, kind] = writer.add_connection(topic, kind, typestore=store)
            message = store.serialize_cdr(_built(store, kind, content), kind)
            writer.write(connections[topic, kind], received_ns, message)
    return path


def _built(store, kind, content):
    fields = {name: _value(store, description, content.get(name)) for name, description in store.fielddefs[kind][1]}
    return store.types[kind](**fields)


def _value(store, description, content):
    node, detail = description
    if node == Nodetype.NAME:
        return _built(store, detail, content or {})
    if node == Nodetype.BASE:
        return content if content is not None else "" if detail[0] == "string" else 0
    element, size = detail
    if element[0] == Nodetype.NAME:
        return [_built(store, element[1], one) for one in content or []]
    is_text = element[1][0] == "string"
    return content or [] if is_text else np.array(content if content is not None else np.zeros(size), element[1][0])


def header(stamp_ns: int) -> dict[str, dict[str, int]]:
    """Content of a header."""
    return {"stamp": dict(zip(("sec", "nanosec"), divmod(stamp_ns, 1_000_000_000), strict=True))}


def pose(x: float, y: float, yaw: float) -> dict[str, dict[str, float]]:
    """Content of geometry_msgs/Pose."""
    return {"position": {"x": x, "y": y}, "orientation": {"z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}}
