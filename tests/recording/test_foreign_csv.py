"""Import of foreign CSV files: files with exactly known values, and refusal of each kind of invalid input."""

import gzip

import foreign_drive as foreign
import numpy as np
import pytest

from carlab.core.errors import ConfigError, DataError
from carlab.recording.audit.report import Severity
from carlab.recording.column_mapping import ColumnMapping, ColumnSource, load_mapping
from carlab.recording.csv.foreign import import_csv
from carlab.recording.csv.repairing_import import import_repaired
from carlab.recording.layouts import CANONICAL, DART, ETH

EVEN = np.arange(900) / 30.0


@pytest.fixture(scope="module")
def clean():
    return foreign.drive(EVEN)


class TestConversion:
    def test_canonical_file_is_imported_exactly(self, clean, tmp_path):
        imported = import_csv(foreign.write(tmp_path / "run.csv", clean))
        episode = imported.episode
        assert episode.ticks == len(EVEN) - 1
        np.testing.assert_array_equal(episode.times_s, EVEN)
        expected = np.column_stack([clean[name] for name in ("x", "y", "yaw", "vx", "vy", "yaw_rate")])
        np.testing.assert_array_equal(episode.states, expected)
        commands = np.column_stack([clean["steering"], clean["throttle"]])
        np.testing.assert_array_equal(episode.sent, commands[:-1])
        np.testing.assert_array_equal(episode.requested, commands[:-1])
        np.testing.assert_array_equal(episode.poses, np.column_stack([EVEN, expected[:, :3]]))
        assert "canonical" in imported.announcement
        assert "recognised" in imported.announcement

    def test_poses_have_their_capture_times_if_the_file_states_their_ages(self, clean, tmp_path):
        ages = np.where(np.arange(len(EVEN)) % 3 == 0, 0.008, 0.012)
        ages[5] = np.nan
        ages[7] = ages[6] + EVEN[7] - EVEN[6]  # no new pose since the row before
        imported = import_csv(foreign.write(tmp_path / "run.csv", {**clean, "pose_age_s": ages}))
        stamps = imported.episode.poses[:, 0]
        np.testing.assert_allclose(stamps, np.delete(EVEN - ages, 5), rtol=0, atol=1e-9)
        assert stamps[5] == stamps[6]
        np.testing.assert_array_equal(imported.episode.poses[:, 1], np.delete(clean["x"], 5))

    @pytest.mark.parametrize("delimiter", [";", "\t"])
    def test_gzip_delimiters_and_byte_order_mark_are_accepted(self, clean, tmp_path, delimiter):
        plain = foreign.write(tmp_path / "run.csv", clean, delimiter=delimiter)
        packed = tmp_path / "run.csv.gz"
        packed.write_bytes(gzip.compress(b"\xef\xbb\xbf" + plain.read_bytes()))
        np.testing.assert_array_equal(
            import_csv(packed).episode.states,
            import_csv(foreign.write(tmp_path / "commas.csv", clean)).episode.states,
        )

    def test_unpacked_file_with_the_name_of_a_packed_one_is_read(self, clean, tmp_path):
        """Browsers unpack some downloads and keep their names."""
        path = foreign.write(tmp_path / "run.csv", clean)
        plain = import_csv(path).episode.states
        unpacked = path.rename(tmp_path / "run.csv.gz")
        np.testing.assert_array_equal(import_csv(unpacked).episode.states, plain)
        unpacked.write_bytes(b"\x1f\xff" + bytes(100))
        with pytest.raises(DataError, match=r"run\.csv\.gz is neither a gzip file nor text in UTF-8; copy it again"):
            import_csv(unpacked)

    def test_rows_in_reverse_order_are_to_be_sorted_not_left_out(self, clean, tmp_path):
        path = foreign.write(tmp_path / "run.csv", {name: column[::-1] for name, column in clean.items()})
        with pytest.raises(DataError, match=r"sort the rows by time .--stamps drop would leave out 899 of 900 rows"):
            import_csv(path)
        with pytest.raises(DataError, match="sort the rows by time"):
            import_repaired(path)

    def test_empty_lines_before_the_header_are_skipped(self, clean, tmp_path):
        plain = foreign.write(tmp_path / "run.csv", clean, delimiter=";")
        padded = tmp_path / "padded.csv"
        padded.write_text("\n# a, b, c\n \n" + plain.read_text())
        np.testing.assert_array_equal(import_csv(padded).episode.states, import_csv(plain).episode.states)

    @pytest.mark.parametrize(("unit", "factor"), [("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
    def test_stamps_in_another_unit_are_refused_until_it_is_declared(self, clean, tmp_path, unit, factor):
        path = foreign.write(tmp_path / "run.csv", {**clean, "t": clean["t"] * factor})
        with pytest.raises(DataError, match=f"looks like {unit}; say so with --t-unit {unit}"):
            import_csv(path)
        declared = CANONICAL.with_options(columns={"t": {"unit": unit}})
        np.testing.assert_allclose(import_csv(path, mapping=declared).episode.times_s, EVEN, atol=1e-6)

    def test_mapping_file_converts_names_units_and_signs(self, clean, tmp_path):
        columns = {
            "stamp": clean["t"] * 1e3 + 5e6,
            "east": clean["x"] * 1e3,
            "south": -clean["y"] * 1e2,
            "heading": np.rad2deg(clean["yaw"]),
            "speed": clean["vx"] * 3.6,
            "drift": clean["vy"] * 3.6,
            "gyro": -np.rad2deg(clean["yaw_rate"]),
            "servo": -25.0 * clean["steering"],
            "gas": 100.0 * clean["throttle"],
            "battery": np.linspace(8.4, 7.9, len(EVEN)),
        }
        (tmp_path / "map.toml").write_text(
            """
            layout = "workshop logger"
            [columns]
            t = {name = "stamp", unit = "ms"}
            x = {name = "east", unit = "mm"}
            y = {name = "south", unit = "cm", sign = -1}
            yaw = {name = "heading", unit = "deg"}
            vx = {name = "speed", unit = "km/h"}
            vy = {name = "drift", unit = "km/h"}
            yaw_rate = {name = "gyro", unit = "deg/s", sign = -1}
            steering = {name = "servo", scale = 0.04, sign = -1}
            throttle = {name = "gas", unit = "%"}
            """
        )
        path = foreign.write(tmp_path / "run.csv", columns)
        imported = import_csv(path, mapping=load_mapping(tmp_path / "map.toml"))
        episode = imported.episode
        expected = np.column_stack([clean[name] for name in ("x", "y", "yaw", "vx", "vy", "yaw_rate")])
        np.testing.assert_allclose(episode.states, expected, atol=1e-9)
        np.testing.assert_allclose(episode.sent[:, 0], clean["steering"][:-1], atol=1e-12)
        np.testing.assert_allclose(episode.sent[:, 1], clean["throttle"][:-1], atol=1e-12)
        np.testing.assert_allclose(episode.times_s, EVEN, atol=1e-6)
        assert float(episode.metadata["time_origin_s"]) == pytest.approx(5e3)
        np.testing.assert_array_equal(episode.extra["battery"], columns["battery"])
        assert imported.report.worst <= Severity.INFO
        assert "workshop logger" in imported.announcement

    def test_world_velocities_are_rotated_by_the_yaw_at_their_time(self, tmp_path):
        """Backward differences are late by half a row; they are rotated by the yaw of half a row before."""
        t = EVEN
        columns = foreign.drive(t)
        late = t - 0.5 / 30.0
        v, yaw = foreign.speed(late), foreign.yaw(late)
        columns["vx_world"], columns["vy_world"] = v * np.cos(yaw), v * np.sin(yaw)
        columns["yaw_rate"] = foreign.yaw_rate(late)
        del columns["vx"], columns["vy"]
        imported = import_csv(foreign.write(tmp_path / "run.csv", columns))
        assert imported.mapping == ETH
        states = imported.episode.states
        # Rotated by the yaw of the row itself, vy would be off by v * yaw_rate / 60: up to 0.04 m/s.
        np.testing.assert_allclose(states[1:, 3], v[1:], atol=1e-3)
        np.testing.assert_allclose(states[1:, 4], 0.0, atol=1e-3)
        assert float(imported.episode.metadata["velocity_delay_s"]) == pytest.approx(1 / 60, rel=1e-5)

    def test_throttle_gate_gives_requested_and_sent_throttle(self, clean, tmp_path):
        gate = np.where((EVEN > 10) & (EVEN < 12), 0.0, 1.0)
        columns = {
            "vicon time": clean["t"] + 1.7e9,
            "vicon x": clean["x"],
            "vicon y": clean["y"],
            "vicon yaw": clean["yaw"],
            "steering": clean["steering"],
            "throttle": clean["throttle"],
            "safety_value": gate,
        }
        imported = import_csv(foreign.write(tmp_path / "run.csv", columns))
        assert imported.mapping == DART
        episode = imported.episode
        # The logger of DART has a mean delay of 0.05 s: at 30 Hz the command of a row is in the next row.
        np.testing.assert_array_equal(episode.requested[:, 1], clean["throttle"][1:])
        np.testing.assert_array_equal(episode.sent[:, 1], (clean["throttle"] * gate)[1:])
        assert imported.report.of("column_shift")[0].evidence["lag_s"] == 0.05
        (finding,) = imported.report.of("gated_throttle")
        assert finding.count == np.sum(gate == 0)
        np.testing.assert_array_equal(episode.extra["safety_value"], gate)
        columns["safety_value"] = np.where(EVEN[50] == EVEN, np.nan, gate)
        with pytest.raises(DataError, match="'safety_value' has no number in 1 of 900 rows, the first in row 51"):
            import_csv(foreign.write(tmp_path / "hole.csv", columns))

    def test_dead_reckoning_without_a_pose_reproduces_a_circle(self, tmp_path):
        """1.5 m/s and 0.75 rad/s: a circle of 2 m radius about (0, 2)."""
        t = np.arange(200) * 0.05
        columns = {
            "elapsed time sensors": t,
            "vel encoder": np.full(200, 1.5),
            "W (IMU)": np.full(200, 0.75),
            "safety_value": np.ones(200),
            "throttle": 0.3 + 0.01 * np.sin(t),
            "steering": 0.2 + 0.01 * np.sin(t),
        }
        episode = import_csv(foreign.write(tmp_path / "run.csv", columns)).episode
        np.testing.assert_allclose(np.hypot(episode.states[:, 0], episode.states[:, 1] - 2.0), 2.0, atol=2e-3)
        np.testing.assert_allclose(episode.states[:, 2], 0.75 * t, atol=1e-9)
        assert len(episode.poses) == 0
        assert "not measured" in episode.metadata["pose_source"]

    def test_file_without_time_is_imported_with_its_rate_and_swapped_axes(self, clean, tmp_path):
        columns = {name: clean[name] for name in ("steering", "throttle")}
        columns |= {"north": clean["x"], "east": -clean["y"], "compass": -clean["yaw"]}
        mapping = ColumnMapping(
            {
                "y": ColumnSource("north"),
                "x": ColumnSource("east", sign=-1),
                "yaw": ColumnSource("compass", sign=-1),
                "steering": ColumnSource("steering"),
                "throttle": ColumnSource("throttle"),
            },
            rate_hz=30.0,
            swap_xy=True,
        )
        episode = import_csv(foreign.write(tmp_path / "run.csv", columns), mapping=mapping).episode
        np.testing.assert_allclose(episode.states[:, 0], clean["x"], atol=1e-12)
        np.testing.assert_allclose(episode.states[:, 1], clean["y"], atol=1e-12)
        np.testing.assert_allclose(episode.states[10:-10, 3], clean["vx"][10:-10], atol=5e-3)

    def test_text_column_is_dropped_and_reported(self, clean, tmp_path):
        columns = {**clean, "driver": np.array(["anna"] * len(EVEN))}
        imported = import_csv(foreign.write(tmp_path / "run.csv", columns))
        assert "driver" not in imported.episode.extra
        assert imported.report.of("text_column", "driver")


@pytest.mark.parametrize("rows", [3, 4, 7, 20, 200])
@pytest.mark.parametrize("still", [True, False])
def test_short_and_still_recordings_import_without_a_warning(rows, still, clean, tmp_path):
    columns = {name: column[:rows].copy() for name, column in clean.items()}
    if still:
        columns = {name: column if name == "t" else np.zeros(rows) for name, column in columns.items()}
    imported = import_csv(foreign.write(tmp_path / "run.csv", columns))
    assert imported.episode.ticks == rows - 1
    for name in ("vx", "vy", "yaw_rate"):
        del columns[name]
    states = import_csv(foreign.write(tmp_path / "run.csv", columns)).episode.states
    assert np.isfinite(states).all()
    if not still:
        np.testing.assert_allclose(states[:, 3], clean["vx"][:rows], atol=0.08)


class TestRefusal:
    """Each fault is refused in one sentence with its place and the next step."""

    def refuse(self, tmp_path, columns, *parts, mapping=None):
        path = foreign.write(tmp_path / "run.csv", columns)
        with pytest.raises(DataError) as caught:
            import_csv(path, mapping=mapping)
        message = str(caught.value)
        for part in ("run.csv", *parts):
            assert part in message
        assert "\n" not in message
        return message

    def test_missing_column_is_refused_with_the_similar_name(self, clean, tmp_path):
        columns = {("heading_yaw" if k == "yaw" else k): v for k, v in clean.items()}
        self.refuse(tmp_path, columns, "no column yaw", "'heading_yaw'", "mapping")

    def test_missing_column_of_a_mapping_is_refused(self, clean, tmp_path):
        mapping = CANONICAL.with_options(columns={"yaw": {"name": "psi"}})
        self.refuse(tmp_path, clean, "psi (for yaw)", mapping=mapping)

    def test_nan_is_refused_or_its_rows_are_dropped(self, clean, tmp_path):
        x = clean["x"].copy()
        x[[41, 300]] = np.nan
        self.refuse(tmp_path, {**clean, "x": x}, "'x'", "2 of 900 rows", "row 42", "--missing drop")
        imported = import_csv(tmp_path / "run.csv", mapping=CANONICAL.with_options(missing="drop"))
        assert imported.episode.ticks == 897
        assert np.isfinite(imported.episode.states).all()
        assert EVEN[41] not in imported.episode.times_s

    def test_infinity_is_refused(self, clean, tmp_path):
        throttle = clean["throttle"].copy()
        throttle[7] = np.inf
        self.refuse(tmp_path, {**clean, "throttle": throttle}, "'throttle'", "the first is inf in row 8")

    def test_implausible_number_is_refused_with_its_value_in_the_file(self, clean, tmp_path):
        vx = clean["vx"].copy()
        vx[[20, 40]] = 1e30, -1e300
        mapping = CANONICAL.with_options(columns={"vx": {"unit": "km/h"}})
        self.refuse(tmp_path, {**clean, "vx": vx}, "'vx'", "2 of 900 rows", "1e+30 in row 21", mapping=mapping)
        self.refuse(tmp_path, {**clean, "vx": np.full(900, 1e30)}, "no plausible number", "1e+30", "remove it")
        vx[60] = np.nan
        with pytest.raises(DataError, match=r"(?s)2 faults.*no number in 1 of 900 rows.*row 61.*1e\+30 in row 21"):
            import_csv(foreign.write(tmp_path / "run.csv", {**clean, "vx": vx}))

    def test_missing_last_command_is_accepted(self, clean, tmp_path):
        steering = clean["steering"].copy()
        steering[-1] = np.nan
        imported = import_csv(foreign.write(tmp_path / "run.csv", {**clean, "steering": steering}))
        assert np.isfinite(imported.episode.sent).all()
        assert not imported.report.of("not_a_number")

    def test_text_in_a_number_column_is_refused(self, clean, tmp_path):
        y = clean["y"].astype(object)
        y[12] = "12,5"
        self.refuse(tmp_path, {**clean, "y": y}, "Row 13", "'y'", "'12,5'")

    def test_gap_is_refused_split_or_kept_without_loss_of_rows(self, clean, tmp_path):
        kept = np.ones(len(EVEN), dtype=bool)
        kept[400:430] = False
        columns = {name: column[kept] for name, column in clean.items()}
        self.refuse(tmp_path, columns, "1 gap in time", "after row 400", "1.033 s", "--gaps split")
        imported = import_csv(tmp_path / "run.csv", mapping=CANONICAL.with_options(gaps="split"))
        first, second = imported.episodes
        assert (first.ticks, second.ticks) == (399, 469)
        np.testing.assert_array_equal(np.concatenate([first.times_s, second.times_s]), EVEN[kept])
        with pytest.raises(DataError, match="2 episodes"):
            _ = imported.episode
        with_gap = import_csv(tmp_path / "run.csv", mapping=CANONICAL.with_options(gaps="keep")).episode
        assert with_gap.ticks == 869
        assert set(np.unique(with_gap.extra["segment"])) == {0.0, 1.0}

    def test_repeated_and_decreasing_stamps_are_refused_or_dropped(self, clean, tmp_path):
        t = clean["t"].copy()
        t[100] = t[99]
        t[500] = t[400]
        self.refuse(tmp_path, {**clean, "t": t}, "1 stamps repeat", "1 go back", "row 100", "--stamps drop")
        imported = import_csv(tmp_path / "run.csv", mapping=CANONICAL.with_options(stamps="drop"))
        assert imported.episode.ticks == 897
        assert np.all(np.diff(imported.episode.times_s) > 0)

    def test_constant_time_column_is_replaced_by_the_rate_of_the_rows(self, clean, tmp_path):
        message = self.refuse(tmp_path, {**clean, "t": 0.0 * EVEN}, "899 of 900 stamps repeat", "--rate", "--mapping")
        assert "--stamps drop" not in message
        with pytest.raises(DataError, match="899 of 900 stamps repeat"):
            import_csv(tmp_path / "run.csv", mapping=CANONICAL.with_options(stamps="drop"))
        without_time = foreign.write(tmp_path / "rate.csv", {k: v for k, v in clean.items() if k != "t"})
        imported = import_csv(without_time, mapping=CANONICAL.with_options(rate_hz=30.0))
        assert imported.episode.ticks == 899

    def test_yaw_in_degrees_is_refused_or_converted(self, clean, tmp_path):
        columns = {**clean, "yaw": np.rad2deg(clean["yaw"])}
        self.refuse(tmp_path, columns, "'yaw'", "degrees", "--yaw-unit deg")
        mapping = CANONICAL.with_options(columns={"yaw": {"unit": "deg"}})
        episode = import_csv(tmp_path / "run.csv", mapping=mapping).episode
        np.testing.assert_allclose(episode.states[:, 2], clean["yaw"], atol=1e-12)

    def test_yaw_rate_in_degrees_per_second_is_refused(self, clean, tmp_path):
        columns = {**clean, "yaw_rate": np.rad2deg(clean["yaw_rate"])}
        self.refuse(tmp_path, columns, "57.3 times", "--yaw-rate-unit deg/s")

    def test_position_in_millimetres_is_refused(self, clean, tmp_path):
        columns = {**clean, "x": 1e3 * clean["x"], "y": 1e3 * clean["y"]}
        self.refuse(tmp_path, columns, "mm", "--x-unit mm --y-unit mm")

    def test_speed_in_kilometres_per_hour_is_refused(self, clean, tmp_path):
        columns = {**clean, "vx": 3.6 * clean["vx"], "vy": 3.6 * clean["vy"]}
        self.refuse(tmp_path, columns, "times the speed of the pose", "km/h", "--vx-unit km/h")

    def test_commands_beyond_one_are_refused(self, clean, tmp_path):
        steering = 25 * clean["steering"] / np.abs(clean["steering"]).max()
        self.refuse(tmp_path, {**clean, "steering": steering}, "reaches 25", "--steering-scale 0.04")

    def test_several_faults_are_reported_together(self, clean, tmp_path):
        columns = {**clean, "steering": 25 * clean["steering"], "yaw_rate": np.rad2deg(clean["yaw_rate"])}
        with pytest.raises(DataError, match="2 faults") as caught:
            import_csv(foreign.write(tmp_path / "run.csv", columns))
        assert str(caught.value).count("\n  - ") == 2

    @pytest.mark.parametrize(
        ("content", "message"),
        [
            (b"", "is empty"),
            (b"t,x,y,yaw,steering,throttle\n", r"has too few rows \(0\); a recording needs at least three"),
            (b"t,x,y,yaw,steering,throttle\n" + 2 * b"0,0,0,0,0,0\n", r"has too few rows \(2\); a recording needs"),
            (b"t,x,y,yaw,steering,throttle\n" + 3 * b"2024-01-22 11:59:45,0,0,0,0,0\n", "write the column as numbers"),
            (b"0,1,2,3,4,5\n1,1,1,1,1,1\n2,2,2,2,2,2\n", "header line"),
            (b"t,x,y,yaw,steering,throttle\n0,0,0,0,0,0\n1,1,1\n2,2,2,2,2,2\n", "Row 2"),
            (b"t,t,y,yaw,steering,throttle\n0,0,0,0,0,0\n1,1,1,1,1,1\n", "two columns named 't'"),
            (b"t|x|y\n0|0|0\n1|1|1\n", r"single column, 't\|x\|y'; separate the columns by commas"),
            (b"t x y\n0 0 0\n1 1 1\n", "single column, 't x y'; separate the columns by commas"),
            (b"\x89PNG\r\n\x1a\n\xff\xd8", "not a text file"),
            (gzip.compress(b"t,x,y\n" * 1000, mtime=0)[:-20], "not a complete gzip file"),
        ],
    )
    def test_files_that_are_no_recording_are_refused(self, content, message, tmp_path):
        path = tmp_path / "run.csv"
        path.write_bytes(content)
        with pytest.raises(DataError, match=message):
            import_csv(path)

    def test_missing_file_is_reported(self, tmp_path):
        with pytest.raises(DataError, match="check the path"):
            import_csv(tmp_path / "nowhere.csv")


class TestMappingFile:
    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("velocity_frane = 'world'\n[columns]\nt = 't'\n", "did you mean 'velocity_frame'"),
            ("[columns.yawrate]\nname = 'w'\n", "did you mean 'yaw_rate'"),
            ("[columns.yaw]\nname = 'psi'\nunit = 'degrees'\n", "Unit 'degrees' of yaw"),
            ("[columns.yaw]\nname = 'psi'\nsign = -2\n", "must be one of"),
            ("[columns.yaw\n", "not valid TOML"),
            ("layout = 'x'\n", "names no columns"),
        ],
    )
    def test_mistakes_in_a_mapping_file_are_named(self, text, message, tmp_path):
        (tmp_path / "map.toml").write_text(text)
        with pytest.raises(ConfigError, match=message):
            load_mapping(tmp_path / "map.toml")

    def test_options_of_a_changed_mapping_are_checked(self):
        with pytest.raises(ConfigError, match="did you mean 'velocities'"):
            CANONICAL.with_options(velocitys="pose")
        changed = CANONICAL.with_options(columns={"steering": {"sign": -1}}, velocities="pose")
        assert changed.columns["steering"] == ColumnSource("steering", sign=-1)
        assert CANONICAL.columns["steering"].sign == 1
