"""Definitions of types in a ROS bag: they replace those of the library, may be IDL, and run no code."""

import sqlite3

import foreign_drive as foreign
import numpy as np
import pytest
import ros_bags
from ros_bags import COMMAND, EPOCH_NS, POSE

import carlab
from carlab.core.errors import DataError

TIMES_S = np.arange(60) / 30.0
TARGET = "lab_msgs/msg/Target"
MSG = "std_msgs/Header header\nfloat32[2] drive\n"
PART = f"{ros_bags.SEPARATOR}IDL: "
TARGET_IDL = """// generated from rosidl_adapter/resource/msg.idl.em (of lab_msgs)
#include "std_msgs/msg/Header.idl"

module lab_msgs {
  module msg {
    typedef float float__2[2];
    @verbatim (language="comment", text=
      "Steering (and throttle (both in [-1, 1]))")
    struct Target {
      std_msgs::msg::Header header;
      float__2 drive;
    };
  };
};
"""
OTHER_IDL = "module lab_msgs { module msg { struct Other { double x; }; }; };\n"
MAPPING = f"""
[columns]
x = "{POSE}/pose/position/x"
y = "{POSE}/pose/position/y"
yaw = "{POSE}/pose/orientation/yaw"
steering = "{COMMAND}/drive[0]"
throttle = "{COMMAND}/drive[1]"
"""


@pytest.fixture(scope="module")
def drive():
    return foreign.drive(TIMES_S)


def bag(path, drive, definitions):
    """A bag with poses and commands at the same times, the commands as an array."""
    written = []
    for k, time_s in enumerate(drive["t"]):
        stamp_ns = EPOCH_NS + round(time_s * 1e9)
        pose = ros_bags.pose(*(drive[channel][k] for channel in ("x", "y", "yaw")))
        content = {"header": ros_bags.header(stamp_ns), "pose": pose}
        written.append((POSE, ros_bags.TYPES[POSE], stamp_ns, content))
        content = {"header": ros_bags.header(stamp_ns), "drive": [drive["steering"][k], drive["throttle"][k]]}
        written.append((COMMAND, TARGET, stamp_ns, content))
    return ros_bags.write_messages(path, written, definitions)


def with_definition(path, definition, encoding="ros2idl", kind=TARGET):
    """Replace a definition in a bag."""
    with sqlite3.connect(next(path.glob("*.db3"))) as database:
        change = "UPDATE message_definitions SET encoding = ?, encoded_message_definition = ? WHERE topic_type = ?"
        assert database.execute(change, (encoding, definition, kind)).rowcount == 1
    database.close()
    return path


def loaded(path, tmp_path):
    mapping = tmp_path / "columns.toml"
    mapping.write_text(MAPPING)
    return carlab.load(path, mapping=mapping).episode


def check(episode, drive):
    np.testing.assert_allclose(episode.states[:, 0], drive["x"], atol=1e-12)
    expected = np.column_stack([drive["steering"], drive["throttle"]])[:-1]
    np.testing.assert_allclose(episode.sent, expected, atol=1e-6)


@pytest.mark.parametrize("text", [TARGET_IDL, f"{PART}{TARGET}\n{TARGET_IDL}{PART}lab_msgs/msg/Other\n{OTHER_IDL}"])
def test_definition_may_be_idl(text, drive, tmp_path):
    path = with_definition(bag(tmp_path / "drive", drive, {TARGET: MSG}), text)
    check(loaded(path, tmp_path), drive)


@pytest.mark.parametrize("name", ["drive_sqlite3", "drive_mcap"])
def test_definition_of_the_bag_replaces_that_of_the_library(name, drive, tmp_path):
    stamped = "std_msgs/Header header\nuint64 number\ngeometry_msgs/Pose pose\n"
    path = bag(tmp_path / name, drive, {TARGET: MSG, ros_bags.TYPES[POSE]: stamped})
    check(loaded(path, tmp_path), drive)


@pytest.mark.timeout(120)  # the library alone needs minutes for two of them
@pytest.mark.parametrize(
    ("encoding", "definition"),
    [
        ("ros2msg", MSG + "string[20000000] names\n"),
        ("ros2msg", MSG + "float64[-1] rest\n"),
        ("ros2msg", MSG + "lab_msgs/Other[20000000] rest\n"),
        ("ros2idl", TARGET_IDL.replace("[2]", "[((((((2))))))]")),
        ("ros2idl", TARGET_IDL.replace("[2]", "[-2]")),
        ("ros2idl", TARGET_IDL.replace("[2]", "[\"__import__('os').system('touch RAN')\"]")),
        ("ros2idl", TARGET_IDL.replace("std_msgs::msg::Header", "std_msgs::msg::__import__")),
        ("ros2idl", "module lab_msgs { module msg { "),
    ],
)
def test_malicious_definition_is_refused(encoding, definition, drive, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = with_definition(bag(tmp_path / "drive", drive, {TARGET: MSG}), definition, encoding)
    with pytest.raises(DataError):
        loaded(path, tmp_path)
    assert not (tmp_path / "RAN").exists()


def test_malicious_types_of_headers_and_orientations_end_in_no_traceback(drive, tmp_path):
    """The bag defines a time without seconds and a quaternion of texts."""
    definitions = {
        TARGET: MSG,
        "builtin_interfaces/msg/Time": "string sec\nfloat64[2] nanosec",
        "geometry_msgs/msg/Quaternion": "string x\nstring y\nfloat64[2] z\nstring w",
    }
    written = [(POSE, ros_bags.TYPES[POSE], EPOCH_NS, {}), (COMMAND, TARGET, EPOCH_NS, {})]
    path = ros_bags.write_messages(tmp_path / "drive", written, definitions)
    with pytest.raises(DataError, match=r"orientation has no field 'yaw': geometry_msgs/msg/Quaternion has the fields"):
        loaded(path, tmp_path)


@pytest.mark.parametrize("name", [5, b"/drive", "/dri\nve", "\x1b[31m/drive"])
def test_topic_with_another_name_than_ros_allows_is_refused(name, drive, tmp_path):
    path = bag(tmp_path / "drive", drive, {TARGET: MSG})
    file = next(path.glob("*.db3"))
    with sqlite3.connect(file) as database:
        database.execute("UPDATE topics SET name = ? WHERE name = ?", (name, COMMAND))
    database.close()
    with pytest.raises(DataError) as error:
        loaded(file, tmp_path)
    assert str(error.value).isprintable()


@pytest.mark.parametrize("stamp", ["soon", b"\xff\xfe", "inf", float("inf")])
def test_message_without_a_time_of_reception_is_refused(stamp, drive, tmp_path):
    path = bag(tmp_path / "drive", drive, {TARGET: MSG})
    file = next(path.glob("*.db3"))
    with sqlite3.connect(file) as database:
        database.execute("UPDATE messages SET timestamp = ? WHERE id = 9", (stamp,))
    database.close()
    for one in (file, path):
        with pytest.raises(DataError, match="cannot be read as a ROS bag"):
            loaded(one, tmp_path)


def test_metadata_with_numbers_for_names_are_refused(drive, tmp_path):
    path = bag(tmp_path / "drive", drive, {TARGET: MSG})
    metadata = path / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace(f"name: {POSE}", "name: 1").replace(f"name: {COMMAND}", "name: 2"))
    with pytest.raises(DataError, match="which is no name of ROS"):
        loaded(path, tmp_path)


def test_compressed_messages_of_a_single_file_need_the_folder(drive, tmp_path):
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, Writer

    store = ros_bags.get_typestore(ros_bags.Stores.ROS2_HUMBLE)
    store.register(ros_bags.get_types_from_msg(MSG, TARGET))
    path = tmp_path / "compressed"
    writer = Writer(path, version=8)
    writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    with Reader(bag(tmp_path / "drive", drive, {TARGET: MSG})) as reader, writer:
        connections = {c.id: writer.add_connection(c.topic, c.msgtype, typestore=store) for c in reader.connections}
        for connection, received_ns, content in reader.messages():
            writer.write(connections[connection.id], received_ns, content)
    check(loaded(path, tmp_path), drive)
    with pytest.raises(DataError, match="are compressed; name the folder of the bag"):
        loaded(next(path.glob("*.db3")), tmp_path)


@pytest.mark.parametrize("character", ["#", "?", "%"])
def test_path_that_the_library_would_misread_is_refused(character, drive, tmp_path):
    path = bag(tmp_path / "drive", drive, {TARGET: MSG})
    path = path.rename(tmp_path / f"drive{character}1")
    with pytest.raises(DataError, match=r"one of the characters # \? %; rename the file or its folder"):
        loaded(path, tmp_path)


def test_type_without_a_definition_has_its_remedy(drive, tmp_path):
    path = bag(tmp_path / "drive", drive, {TARGET: MSG})
    with sqlite3.connect(next(path.glob("*.db3"))) as database:
        database.execute("DELETE FROM message_definitions")
    database.close()
    with pytest.raises(DataError, match=r"has no definition of lab_msgs/msg/Target \(/drive\); convert it to"):
        loaded(path, tmp_path)
