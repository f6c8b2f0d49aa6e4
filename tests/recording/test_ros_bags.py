"""Import of ROS bags: all formats give the drive that was written, by two independent libraries."""

import contextlib

import foreign_drive as foreign
import numpy as np
import pytest
import ros_bags

import carlab
from carlab.core.errors import ConfigError, DataError
from carlab.recording.column_mapping import load_mapping

TIMES_S = np.arange(900) / 100.0
FORMATS = ("drive.bag", "drive_sqlite3", "drive_mcap", "drive.mcap")
FLOAT32 = 3e-7


@pytest.fixture(scope="module")
def drive():
    return foreign.drive(TIMES_S)


@pytest.fixture
def mapping(tmp_path):
    path = tmp_path / "columns.toml"
    path.write_text(ros_bags.MAPPING)
    return path


@pytest.mark.parametrize("name", FORMATS)
def test_bag_gives_the_poses_and_the_newest_commands_before_them(name, drive, mapping, tmp_path):
    recording = carlab.load(ros_bags.write_bag(tmp_path / name, drive), mapping=mapping)
    episode = recording.episode
    last = 5 * ((len(TIMES_S) - 1) // 5)  # no command follows later poses
    np.testing.assert_allclose(episode.times_s, TIMES_S[:last], rtol=0, atol=1e-6)
    np.testing.assert_allclose(episode.states[:, :2], np.column_stack([drive["x"], drive["y"]])[:last], atol=1e-12)
    np.testing.assert_allclose(np.unwrap(episode.states[:, 2]), np.unwrap(drive["yaw"])[:last], atol=1e-9)
    newest = 5 * (np.arange(last - 1) // 5)
    expected = np.column_stack([drive["steering"][newest], drive["throttle"][newest]])
    np.testing.assert_allclose(episode.sent, expected, atol=FLOAT32)
    assert float(episode.metadata["time_origin_s"]) == pytest.approx(ros_bags.EPOCH_NS * 1e-9, abs=1e-6)
    (held,) = [finding for finding in recording.audit.findings if finding.id == "held_values"]
    assert held.evidence["max_age_s"] == pytest.approx(0.041, abs=1e-6)


def test_single_database_file_is_a_bag(drive, mapping, tmp_path):
    folder = ros_bags.write_bag(tmp_path / "drive_sqlite3", drive)
    (database,) = folder.glob("*.db3")
    alone, whole = (carlab.load(path, mapping=mapping).episode for path in (database, folder))
    np.testing.assert_array_equal(alone.states, whole.states)


@pytest.mark.parametrize(
    ("lead_s", "options", "source", "offset_s"),
    [
        (0.0, {}, "its header", 0.0),
        (0.2, {}, "its header", 0.2),
        (-9e8, {}, "the time of reception", ros_bags.NETWORK_NS * 1e-9),
        (-9e8, {"message_times": "header"}, "its header", -9e8),
        (0.0, {"message_times": "received"}, "the time of reception", ros_bags.NETWORK_NS * 1e-9),
    ],
)
def test_times_are_of_the_header_unless_its_clock_differs(lead_s, options, source, offset_s, drive, mapping, tmp_path):
    path = ros_bags.write_bag(tmp_path / "drive_sqlite3", drive, lead_ns=round(lead_s * 1e9))
    recording = carlab.load(path, mapping=mapping, **options)
    assert f"{ros_bags.POSE} by {source}" in recording.announcement
    origin_s = float(recording.episode.metadata["time_origin_s"])
    assert origin_s == pytest.approx(ros_bags.EPOCH_NS * 1e-9 + offset_s, abs=1e-5)


def test_old_commands_give_a_warning(drive, mapping, tmp_path):
    recording = carlab.load(ros_bags.write_bag(tmp_path / "drive_sqlite3", drive, every=80), mapping=mapping)
    (held,) = [finding for finding in recording.audit.findings if finding.id == "held_values"]
    assert held.severity.name == "WARNING"
    assert held.evidence["max_age_s"] == pytest.approx(0.791, abs=1e-6)


@pytest.mark.parametrize(
    ("column", "text"),
    [
        ("/drive/drive/steer", r"/drive/drive has no field 'steer': .*AckermannDrive has the fields steering_angle, "),
        ("/drive/drive", "/drive/drive is not a number: .*AckermannDrive has .*acceleration, jerk.$"),
        ("/drive/drive/speed/x", "/drive/drive/speed has no field 'x': it is a number"),
        ("/driv/drive/speed", r"not a field of a topic .* \(is it '/drive'\?\), which has the topics /car/pose \("),
        ("speed", "not a field of a topic"),
        ("/drive/__class__", "not a field of a topic"),
        ("/drive/drive[0]/speed", r"/drive/drive\[0\] is not an element of a list: .* has the fields"),
        ("/drive/header/frame_id", "/drive/header/frame_id is not a number: it is a text"),
        ("/drive", "'/drive' is a topic of drive_sqlite3; add a field of its messages, which have header, drive."),
    ],
)
def test_wrong_field_is_named_with_the_fields_that_exist(column, text, drive, mapping, tmp_path):
    path = ros_bags.write_bag(tmp_path / "drive_sqlite3", drive)
    columns = load_mapping(mapping).with_options(columns={"throttle": {"name": column}})
    with pytest.raises(DataError, match=text):
        carlab.load(path, mapping=columns)


@pytest.mark.parametrize("name", FORMATS)
def test_bag_without_a_mapping_is_refused_with_its_topics(name, drive, tmp_path):
    path = ros_bags.write_bag(tmp_path / name, drive)
    with pytest.raises(ConfigError, match=r"topics /car/pose \(geometry_msgs/msg/PoseStamped, 900\), /drive \(.*180\)"):
        carlab.diagnose(path, carlab.load_car("rc_car"))


def test_missing_library_has_the_installation_in_the_repository(drive, mapping, tmp_path, monkeypatch):
    path = ros_bags.write_bag(tmp_path / "drive.bag", drive)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"needs the package rosbags; in the repository of carlab, run: .*\.\[ros\]"):
        carlab.load(path, mapping=mapping)


def test_columns_for_csv_do_not_fit_bags(drive, mapping, tmp_path):
    path = ros_bags.write_bag(tmp_path / "drive_sqlite3", drive)
    with pytest.raises(ConfigError, match="The times of a ROS bag are those of its messages; remove t and the rate"):
        carlab.load(path, mapping=mapping, t_unit="ms")
    csv = foreign.write(tmp_path / "drive.csv", drive)
    with pytest.raises(ConfigError, match="message_times is an option for ROS bags"):
        carlab.load(csv, message_times="received")


def test_diagnosis_takes_an_imported_bag(drive, mapping, tmp_path):
    recording = carlab.load(ros_bags.write_bag(tmp_path / "drive_sqlite3", drive), mapping=mapping)
    report = carlab.diagnose(recording, carlab.load_car("rc_car"), effects=["command_delay"], budget_s=20)
    assert report.diagnosis.recordings[0].path == str(tmp_path / "drive_sqlite3")


class TestCustomTypes:
    """Messages of types that the bag defines."""

    POSES = "/poses/poses[car]/pose"
    COLUMNS = f"""
[columns]
x = "{POSES}/position/x"
y = "{POSES}/position/y"
yaw = "{POSES}/orientation/yaw"
steering = "/commands/data[0]"
[columns.throttle]
name = "/commands/data[1]"
neutral = 1500
scale = 0.002
"""
    NAMED_POSE = "string name\ngeometry_msgs/Pose pose\n"

    def bag(self, path, drive, definition=None):
        """Poses of two bodies, the car not in each message, and pulse widths in an array."""
        text = self.NAMED_POSE if definition is None else definition
        store = ros_bags.get_typestore(ros_bags.Stores.ROS2_HUMBLE)
        array = "std_msgs/Header header\nlab_msgs/NamedPose[] poses\n"
        for name, body in {"lab_msgs/msg/NamedPose": self.NAMED_POSE, "lab_msgs/msg/Poses": array}.items():
            store.register(ros_bags.get_types_from_msg(body, name))
        types = store.types
        pose_types = {key: types[f"geometry_msgs/msg/{key}"] for key in ("Pose", "Point", "Quaternion")}
        writer = ros_bags.Rosbag2Writer(path, version=9, storage_plugin=ros_bags.StoragePlugin.MCAP)
        schema = f"{array}{ros_bags.SEPARATOR}MSG: lab_msgs/NamedPose\n{text}"
        schema += ros_bags.SCHEMAS["geometry_msgs/msg/PoseStamped"].partition("pose\n")[2]
        with writer:
            poses = writer.add_connection("/poses", "lab_msgs/msg/Poses", msgdef=schema, rihs01="RIHS01_")
            commands = writer.add_connection("/commands", "std_msgs/msg/Float64MultiArray", typestore=store)
            layout = types["std_msgs/msg/MultiArrayLayout"]([], 0)
            for topic, stamp_ns, numbers in ros_bags.messages(drive):
                if topic == ros_bags.COMMAND:
                    pulses = np.array([numbers[0] * 2.5, 1500.0 + numbers[1] * 0.25 * 500.0])
                    message = types["std_msgs/msg/Float64MultiArray"](layout, pulses)
                    writer.write(commands, stamp_ns, store.serialize_cdr(message, "std_msgs/msg/Float64MultiArray"))
                    continue
                x, y, yaw = numbers
                rotation = pose_types["Quaternion"](0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2))
                pose = pose_types["Pose"](pose_types["Point"](x, y, 0.0), rotation)
                other = pose_types["Pose"](pose_types["Point"](9.0, 9.0, 0.0), rotation)
                named = [types["lab_msgs/msg/NamedPose"]("drone", other), types["lab_msgs/msg/NamedPose"]("car", pose)]
                stamp = types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 1_000_000_000))
                header = types["std_msgs/msg/Header"](stamp, "map")
                seen = named[: 1 if stamp_ns % 70_000_000 == 0 else 2]
                message = types["lab_msgs/msg/Poses"](header, seen)
                writer.write(poses, stamp_ns, store.serialize_cdr(message, "lab_msgs/msg/Poses"))
        return path

    def test_elements_are_chosen_by_name_and_position(self, drive, tmp_path):
        mapping = tmp_path / "columns.toml"
        mapping.write_text(self.COLUMNS)
        episode = carlab.load(self.bag(tmp_path / "lab_mcap", drive), mapping=mapping).episode
        rows = np.flatnonzero((ros_bags.EPOCH_NS + np.round(TIMES_S[:895] * 1e9).astype(int)) % 70_000_000)
        np.testing.assert_allclose(episode.states[:, :2], np.column_stack([drive["x"], drive["y"]])[rows], atol=1e-9)
        expected = np.column_stack([drive["steering"], drive["throttle"]])[5 * (rows // 5)]
        np.testing.assert_allclose(episode.sent, expected[:-1], atol=1e-9)

    @pytest.mark.parametrize(
        ("definition", "refused"),
        [
            ("string name\ngeometry_msgs/Pose pose\nint32 A=__import__('os').system('touch RAN')\n", False),
            (
                "string name\ngeometry_msgs/Pose pose\nstring B=\"'''+__import__('os').system('touch RAN')+'''\"\n",
                False,
            ),
            ("string name __import__('os').system('touch RAN')\ngeometry_msgs/Pose pose\n", False),
            ("string name\ngeometry_msgs/Pose pose\nint8 x;__import__('os').system('touch RAN')\n", True),
            ("string name\ngeometry_msgs/Pose pose\nlab_msgs/NamedPose self\n", True),
        ],
    )
    def test_definitions_of_a_bag_run_no_code(self, definition, refused, drive, tmp_path, monkeypatch):
        """Constants and default values are not used, so those with code are no obstacle."""
        monkeypatch.chdir(tmp_path)
        mapping = tmp_path / "columns.toml"
        mapping.write_text(self.COLUMNS)
        path = self.bag(tmp_path / "lab_mcap", drive, definition)
        with pytest.raises(DataError) if refused else contextlib.nullcontext():
            assert carlab.load(path, mapping=mapping).episode.ticks > 700
        assert not (tmp_path / "RAN").exists()
