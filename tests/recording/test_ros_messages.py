"""Messages of a ROS bag in unusual forms: their times, their fields, and omitted messages."""

import math

import foreign_drive as foreign
import numpy as np
import pytest
import ros_bags
from ros_bags import COMMAND, EPOCH_NS, NETWORK_NS, POSE, TYPES

import carlab
from carlab.core.errors import DataError
from carlab.recording.column_mapping import load_mapping

TIMES_S = np.arange(200) / 100.0
FLOAT64 = "std_msgs/msg/Float64"
LAB = {
    "lab_msgs/msg/Body": "float64[2] size\nstring name\ngeometry_msgs/Pose pose",
    "lab_msgs/msg/Bodies": "std_msgs/Header header\nBody[] bodies",
}


@pytest.fixture(scope="module")
def drive():
    return foreign.drive(TIMES_S)


def mapping_of(tmp_path, pose=f"{POSE}/pose", **columns):
    path = tmp_path / "columns.toml"
    path.write_text(ros_bags.MAPPING.replace("/car/pose/pose", pose))
    return load_mapping(path).with_options(columns={channel: {"name": name} for channel, name in columns.items()})


def messages(drive, every=5, command_ns=-1_000_000):
    """Poses and commands, as the helper writes them; commands ``command_ns`` after their pose."""
    for k, time_s in enumerate(drive["t"]):
        stamp_ns = EPOCH_NS + round(time_s * 1e9)
        content = {
            "header": ros_bags.header(stamp_ns),
            "pose": ros_bags.pose(*(drive[c][k] for c in ("x", "y", "yaw"))),
        }
        yield POSE, TYPES[POSE], stamp_ns + NETWORK_NS, content
        if k % every == 0:
            speed = {"steering_angle": drive["steering"][k] / 2.5, "speed": drive["throttle"][k] / 0.25}
            content = {"header": ros_bags.header(stamp_ns + command_ns), "drive": speed}
            yield COMMAND, TYPES[COMMAND], stamp_ns + NETWORK_NS + 1000, content


def findings_of(recording, identity):
    return [finding for finding in recording.audit.findings if finding.id == identity]


def check_commands(recording, drive, every=5):
    """Each state has the command of the same time or the newest one before it."""
    episode = recording.episode
    first_s = float(episode.metadata["time_origin_s"]) - EPOCH_NS * 1e-9
    k = np.round((first_s + episode.times_s[:-1]) * 100.0).astype(int)
    newest = every * (k // every)
    np.testing.assert_allclose(episode.states[:-1, 0], drive["x"][k], atol=1e-9)
    np.testing.assert_allclose(episode.sent[:, 0], drive["steering"][newest], atol=1e-6)


@pytest.mark.parametrize("command_ns", [0, -1_000_000])
@pytest.mark.parametrize("name", ["drive_sqlite3", "drive_mcap"])
def test_order_of_messages_does_not_matter(name, command_ns, drive, tmp_path):
    written = list(messages(drive, command_ns=command_ns))
    shuffled = [written[k] for k in np.random.default_rng(3).permutation(len(written))]
    for k, order in enumerate((written, written[::-1], shuffled)):
        path = ros_bags.write_messages(tmp_path / f"{k}_{name}", order)
        recording = carlab.load(path, mapping=mapping_of(tmp_path))
        assert len(recording.episode.times_s) == (196 if command_ns == 0 else 195)
        check_commands(recording, drive)


def test_poses_without_position_are_left_out_and_stated(drive, tmp_path):
    written = list(messages(drive))
    poses = [content for topic, _, _, content in written if topic == POSE]
    for k in (50, 51):
        poses[k]["pose"]["position"]["y"] = math.nan
    poses[60]["pose"]["orientation"] = {}  # all components are zero
    recording = carlab.load(ros_bags.write_messages(tmp_path / "drive", written), mapping=mapping_of(tmp_path))
    check_commands(recording, drive)
    assert len(recording.episode.times_s) == 195 - 3
    (finding,) = findings_of(recording, "left_out_messages")
    assert finding.sentence == f"3 of 200 messages of {POSE} have a number that is not finite and were left out."


def test_poses_before_the_first_and_after_the_last_command_are_stated(drive, tmp_path):
    late = [message for message in messages(drive) if message[0] == POSE or message[2] > EPOCH_NS + 200_000_000]
    recording = carlab.load(ros_bags.write_messages(tmp_path / "drive", late), mapping=mapping_of(tmp_path))
    (held,) = findings_of(recording, "held_values")
    assert held.count == 175
    assert "; 25 poses that are incomplete, or before the first or after the last value of a column" in held.sentence


def test_messages_that_the_index_counts_but_no_file_has_are_stated(drive, tmp_path):
    path = ros_bags.write_messages(tmp_path / "drive", messages(drive))
    metadata = path / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("message_count: 200", "message_count: 220"))
    recording = carlab.load(path, mapping=mapping_of(tmp_path))
    (finding,) = findings_of(recording, "unread_messages")
    assert (finding.severity.name, finding.channel, finding.count) == ("WARNING", POSE, 20)
    qos = "- {history: 1, depth: 1, reliability: 1, durability: 2, deadline: &t {sec: 0, nsec: 0}, lifespan: *t, "
    qos += "liveliness: 1, liveliness_lease_duration: *t, avoid_ros_namespace_conventions: false}"
    metadata.write_text(metadata.read_text().replace("profiles: ''", f'profiles: "{qos}"'))
    with pytest.raises(DataError, match=r"counts 220 messages of /car/pose, of which 0 can be read; correct the index"):
        carlab.load(path, mapping=mapping_of(tmp_path))


def test_topic_may_begin_with_the_name_of_another_one(drive, tmp_path):
    written = [("/car" if topic == POSE else topic, *rest) for topic, *rest in messages(drive)]
    written += [(topic, TYPES[POSE], EPOCH_NS, {}) for topic in ("/car/pose", "/car_raw")]
    path = ros_bags.write_messages(tmp_path / "drive", written)
    check_commands(carlab.load(path, mapping=mapping_of(tmp_path, pose="/car/pose")), drive)
    with pytest.raises(DataError, match=r"/car/pose has no field 'twist': geometry_msgs/msg/Pose has the fields"):
        carlab.load(path, mapping=mapping_of(tmp_path, pose="/car/pose", x="/car/pose/twist/x"))


@pytest.mark.parametrize("rate", [0.5, 2.0])
def test_simulation_that_is_not_in_real_time_is_refused(rate, drive, tmp_path):
    """Headers in simulated time, commands without header."""
    written = []
    for topic, kind, received_ns, content in messages(drive):
        late_ns = EPOCH_NS + round((received_ns - EPOCH_NS) / rate)
        if topic == POSE:
            simulated_ns = received_ns - EPOCH_NS
            written.append((topic, kind, late_ns, {**content, "header": ros_bags.header(simulated_ns)}))
        else:
            written += [(f"/{name}", FLOAT64, late_ns, {"data": value}) for name, value in content["drive"].items()]
    path = ros_bags.write_messages(tmp_path / "drive", written)
    mapping = mapping_of(tmp_path, steering="/steering_angle/data", throttle="/speed/data")
    with pytest.raises(DataError, match=r"cover 1.99 s by their headers and [\d.]+ s by .* record with --use-sim-time"):
        carlab.load(path, mapping=mapping)
    recording = carlab.load(path, mapping=mapping, message_times="received")
    assert recording.episode.times_s[-1] == pytest.approx(1.94 / rate, abs=0.02)


def test_import_states_the_time_between_header_and_reception(drive, tmp_path):
    path = ros_bags.write_messages(tmp_path / "drive", messages(drive))
    recording = carlab.load(path, mapping=mapping_of(tmp_path))
    assert f"{POSE} by its header (0.003 s before reception)" in recording.announcement


class TestElements:
    """Elements of a list that are chosen by a text or by a position."""

    def bag(self, path, drive, names=("drone", "car")):
        """Poses of two bodies, whose names follow an array of numbers."""
        written = []
        for topic, kind, received_ns, content in messages(drive):
            bodies = [{"name": name, "pose": content.get("pose")} for name in names]
            for body in bodies[:-1]:
                body["pose"] = ros_bags.pose(9.0, 9.0, 0.0)
            is_pose = topic == POSE
            content = {"header": content["header"], "bodies": bodies} if is_pose else content
            written.append((topic, "lab_msgs/msg/Bodies" if is_pose else kind, received_ns, content))
        return ros_bags.write_messages(path, written, LAB)

    def test_name_is_found_after_an_array(self, drive, tmp_path):
        path = self.bag(tmp_path / "drive_mcap", drive)
        check_commands(carlab.load(path, mapping=mapping_of(tmp_path, f"{POSE}/bodies[car]/pose")), drive)

    def test_missing_element_is_refused_with_the_existing_ones(self, drive, tmp_path):
        path = self.bag(tmp_path / "drive_mcap", drive)
        with pytest.raises(DataError, match=r"200 of 200 .* lack the chosen element .* 2 elements \('drone', 'car'\)"):
            carlab.load(path, mapping=mapping_of(tmp_path, f"{POSE}/bodies[truck]/pose"))

    def test_number_that_is_a_name_and_a_position_is_refused(self, drive, tmp_path):
        path = self.bag(tmp_path / "drive_mcap", drive, ("1", "2"))
        with pytest.raises(DataError, match=r'bodies\[1\] is the name of an element, .* write \["1"\] for the name'):
            carlab.load(path, mapping=mapping_of(tmp_path, f"{POSE}/bodies[1]/pose"))
        check_commands(carlab.load(path, mapping=mapping_of(tmp_path, f'{POSE}/bodies[\\"2\\"]/pose')), drive)
        path = self.bag(tmp_path / "names_mcap", drive)
        check_commands(carlab.load(path, mapping=mapping_of(tmp_path, f"{POSE}/bodies[1]/pose")), drive)


def test_header_may_have_another_stamp_than_that_of_ros(drive, tmp_path):
    definitions = {"lab_msgs/msg/Meta": "float64 stamp", "lab_msgs/msg/Pose": "Meta header\ngeometry_msgs/Pose pose"}
    written = [
        (topic, "lab_msgs/msg/Pose" if topic == POSE else kind, received_ns, {**content, "header": {"stamp": 1.5}})
        for topic, kind, received_ns, content in messages(drive)
        if topic == POSE
    ]
    written += [message for message in messages(drive, command_ns=NETWORK_NS) if message[0] == COMMAND]
    path = ros_bags.write_messages(tmp_path / "drive_mcap", written, definitions)
    recording = carlab.load(path, mapping=mapping_of(tmp_path))
    assert f"{POSE} by the time of reception" in recording.announcement
    check_commands(recording, drive)
