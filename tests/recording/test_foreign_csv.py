"""Foreign files whose every number is known in closed form, and files with each kind of bad input."""

import gzip
import importlib.util
from pathlib import Path

import numpy as np
import pytest

from carlab.core.errors import ConfigError, DataError
from carlab.recording.audit.audit import Severity
from carlab.recording.column_mapping import CANONICAL, DART, ETH, ColumnMapping, ColumnSource, load_mapping
from carlab.recording.csv.foreign import import_csv

_spec = importlib.util.spec_from_file_location("foreign_drive", Path(__file__).with_name("foreign_drive.py"))
foreign = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(foreign)

EVEN = np.arange(900) / 30.0


@pytest.fixture(scope="module")
def clean():
    return foreign.drive(EVEN)


def jittered(rng, rate_hz, seconds):
    t = np.arange(int(rate_hz * seconds)) / rate_hz
    return t + rng.uniform(-0.3, 0.3, len(t)) / rate_hz


class TestConversion:
    def test_canonical_file_comes_through_number_for_number(self, clean, tmp_path):
        imported = import_csv(foreign.write(tmp_path / "run.csv", clean))
        episode = imported.episode
        assert episode.ticks == len(EVEN) - 1
        np.testing.assert_array_equal(episode.times_s, EVEN)
        wanted = np.column_stack([clean[name] for name in ("x", "y", "yaw", "vx", "vy", "yaw_rate")])
        np.testing.assert_array_equal(episode.states, wanted)
        commands = np.column_stack([clean["steering"], clean["throttle"]])
        np.testing.assert_array_equal(episode.sent, commands[:-1])
        np.testing.assert_array_equal(episode.requested, commands[:-1])
        np.testing.assert_array_equal(episode.poses, np.column_stack([EVEN, wanted[:, :3]]))
        assert "canonical" in imported.announcement
        assert "recognised" in imported.announcement

    def test_gzip_and_semicolons_and_byte_order_mark(self, clean, tmp_path):
        plain = foreign.write(tmp_path / "run.csv", clean, delimiter=";")
        packed = tmp_path / "run.csv.gz"
        packed.write_bytes(gzip.compress(b"\xef\xbb\xbf" + plain.read_bytes()))
        np.testing.assert_array_equal(
            import_csv(packed).episode.states,
            import_csv(foreign.write(tmp_path / "commas.csv", clean)).episode.states,
        )

    def test_every_unit_sign_and_name_by_a_mapping_file(self, clean, tmp_path):
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
        wanted = np.column_stack([clean[name] for name in ("x", "y", "yaw", "vx", "vy", "yaw_rate")])
        np.testing.assert_allclose(episode.states, wanted, atol=1e-9)
        np.testing.assert_allclose(episode.sent[:, 0], clean["steering"][:-1], atol=1e-12)
        np.testing.assert_allclose(episode.sent[:, 1], clean["throttle"][:-1], atol=1e-12)
        np.testing.assert_allclose(episode.times_s, EVEN, atol=1e-6)
        assert float(episode.metadata["time_origin_s"]) == pytest.approx(5e3)
        np.testing.assert_array_equal(episode.extra["battery"], columns["battery"])
        assert imported.report.worst <= Severity.INFO
        assert "workshop logger" in imported.announcement

    def test_world_velocities_are_rotated_by_the_yaw_of_their_own_moment(self, tmp_path):
        """Velocities that are late by half a row, as backward differences are, turn with the car of that moment."""
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

    @pytest.mark.parametrize("rate_hz", [30.0, 100.0])
    def test_velocities_from_a_noisy_pose_at_uneven_stamps_across_wraps(self, rng, rate_hz, tmp_path):
        t = jittered(rng, rate_hz, 25.0)
        columns = foreign.drive(t)
        for name, std in (("x", 3e-4), ("y", 3e-4), ("yaw", 1e-3)):
            columns[name] = columns[name] + rng.normal(0.0, std, len(t))
        columns["yaw"] = (columns["yaw"] + np.pi) % (2 * np.pi) - np.pi
        assert np.sum(np.abs(np.diff(columns["yaw"])) > 5) >= 2
        for name in ("vx", "vy", "yaw_rate"):
            del columns[name]
        episode = import_csv(foreign.write(tmp_path / "run.csv", columns)).episode
        inner = slice(5, -5)
        truth = np.column_stack([foreign.speed(t), np.zeros_like(t), foreign.yaw_rate(t)])
        error = (episode.states[:, 3:] - truth)[inner]
        # Slope of a least-squares line through W samples at spacing dt: std * sqrt(12 / (W (W^2 - 1))) / dt.
        width = 5 if rate_hz == 30.0 else 11
        gain = np.sqrt(12 / (width * (width**2 - 1))) * rate_hz
        assert np.std(error[:, 0]) < 1.5 * 3e-4 * gain + 0.002
        assert np.std(error[:, 2]) < 1.5 * 1e-3 * gain + 0.002
        assert np.abs(error).max() < 0.2
        # No delay: a late estimate would correlate with the derivative of the truth.
        late_s = np.dot(error[:, 0], foreign.acceleration(t)[inner]) / np.sum(foreign.acceleration(t)[inner] ** 2)
        assert abs(late_s) < 2e-3
        assert "no delay" in episode.metadata["velocity_source"]
        assert episode.metadata["velocity_delay_s"] == "0"

    def test_throttle_gate_keeps_what_was_asked_and_what_arrived(self, clean, tmp_path):
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
        # That logger is 0.05 s late on average: at 30 Hz, a row's command is the one that the next row holds.
        np.testing.assert_array_equal(episode.requested[:, 1], clean["throttle"][1:])
        np.testing.assert_array_equal(episode.sent[:, 1], (clean["throttle"] * gate)[1:])
        assert imported.report.of("column_shift")[0].evidence["lag_s"] == 0.05
        (finding,) = imported.report.of("gated_throttle")
        assert finding.count == np.sum(gate == 0)
        np.testing.assert_array_equal(episode.extra["safety_value"], gate)
        columns["safety_value"] = np.where(EVEN[50] == EVEN, np.nan, gate)
        with pytest.raises(DataError, match="'safety_value' has no number in 1 of 900 rows, the first in row 51"):
            import_csv(foreign.write(tmp_path / "hole.csv", columns))

    def test_dead_reckoning_of_a_file_without_a_pose_drives_a_circle(self, tmp_path):
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

    def test_file_without_time_by_its_rate_and_other_axes(self, clean, tmp_path):
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

    def test_text_column_is_left_out_and_said(self, clean, tmp_path):
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
    """Each fault: one clear sentence that names the place and the next step."""

    def refuse(self, tmp_path, columns, *parts, mapping=None):
        path = foreign.write(tmp_path / "run.csv", columns)
        with pytest.raises(DataError) as caught:
            import_csv(path, mapping=mapping)
        message = str(caught.value)
        for part in ("run.csv", *parts):
            assert part in message
        assert "\n" not in message
        return message

    def test_missing_column_names_the_likely_one(self, clean, tmp_path):
        columns = {("heading_yaw" if k == "yaw" else k): v for k, v in clean.items()}
        self.refuse(tmp_path, columns, "no column yaw", "'heading_yaw'", "mapping")

    def test_missing_column_of_a_mapping(self, clean, tmp_path):
        mapping = CANONICAL.with_options(columns={"yaw": {"name": "psi"}})
        self.refuse(tmp_path, clean, "psi (for yaw)", mapping=mapping)

    def test_not_a_number_and_leaving_those_rows_out(self, clean, tmp_path):
        x = clean["x"].copy()
        x[[41, 300]] = np.nan
        self.refuse(tmp_path, {**clean, "x": x}, "'x'", "2 of 900 rows", "row 42", "--missing drop")
        imported = import_csv(tmp_path / "run.csv", mapping=CANONICAL.with_options(missing="drop"))
        assert imported.episode.ticks == 897
        assert np.isfinite(imported.episode.states).all()
        assert EVEN[41] not in imported.episode.times_s

    def test_infinity_is_not_a_number_either(self, clean, tmp_path):
        throttle = clean["throttle"].copy()
        throttle[7] = np.inf
        self.refuse(tmp_path, {**clean, "throttle": throttle}, "'throttle'", "row 8")

    def test_damage_that_is_a_number_is_refused_too(self, clean, tmp_path):
        vx = clean["vx"].copy()
        vx[20] = 1e300
        self.refuse(tmp_path, {**clean, "vx": vx}, "'vx'", "row 21")

    def test_last_command_may_be_missing(self, clean, tmp_path):
        steering = clean["steering"].copy()
        steering[-1] = np.nan
        imported = import_csv(foreign.write(tmp_path / "run.csv", {**clean, "steering": steering}))
        assert np.isfinite(imported.episode.sent).all()
        assert not imported.report.of("not_a_number")

    def test_text_in_a_number_column(self, clean, tmp_path):
        y = clean["y"].astype(object)
        y[12] = "12,5"
        self.refuse(tmp_path, {**clean, "y": y}, "Row 13", "'y'", "'12,5'")

    def test_gap_and_splitting_there_loses_nothing(self, clean, tmp_path):
        kept = np.ones(len(EVEN), dtype=bool)
        kept[400:430] = False
        columns = {name: column[kept] for name, column in clean.items()}
        self.refuse(tmp_path, columns, "1 gaps", "after row 400", "1.033 s", "--gaps split")
        imported = import_csv(tmp_path / "run.csv", mapping=CANONICAL.with_options(gaps="split"))
        first, second = imported.episodes
        assert (first.ticks, second.ticks) == (399, 469)
        np.testing.assert_array_equal(np.concatenate([first.times_s, second.times_s]), EVEN[kept])
        with pytest.raises(DataError, match="2 episodes"):
            _ = imported.episode
        whole = import_csv(tmp_path / "run.csv", mapping=CANONICAL.with_options(gaps="keep")).episode
        assert whole.ticks == 869
        assert set(np.unique(whole.extra["segment"])) == {0.0, 1.0}

    def test_time_that_goes_back_or_stands(self, clean, tmp_path):
        t = clean["t"].copy()
        t[100] = t[99]
        t[500] = t[400]
        self.refuse(tmp_path, {**clean, "t": t}, "1 stamps repeat", "1 go back", "row 100", "--stamps drop")
        imported = import_csv(tmp_path / "run.csv", mapping=CANONICAL.with_options(stamps="drop"))
        assert imported.episode.ticks == 897
        assert np.all(np.diff(imported.episode.times_s) > 0)

    def test_degrees_where_radians_belong(self, clean, tmp_path):
        columns = {**clean, "yaw": np.rad2deg(clean["yaw"])}
        self.refuse(tmp_path, columns, "'yaw'", "degrees", "--yaw-unit deg")
        mapping = CANONICAL.with_options(columns={"yaw": {"unit": "deg"}})
        episode = import_csv(tmp_path / "run.csv", mapping=mapping).episode
        np.testing.assert_allclose(episode.states[:, 2], clean["yaw"], atol=1e-12)

    def test_degrees_a_second(self, clean, tmp_path):
        columns = {**clean, "yaw_rate": np.rad2deg(clean["yaw_rate"])}
        self.refuse(tmp_path, columns, "57.3 times", "--yaw-rate-unit deg/s")

    def test_millimetres(self, clean, tmp_path):
        columns = {**clean, "x": 1e3 * clean["x"], "y": 1e3 * clean["y"]}
        self.refuse(tmp_path, columns, "mm", "--x-unit mm --y-unit mm")

    def test_speed_in_kilometres_an_hour(self, clean, tmp_path):
        columns = {**clean, "vx": 3.6 * clean["vx"], "vy": 3.6 * clean["vy"]}
        self.refuse(tmp_path, columns, "times the speed of the pose", "km/h", "--vx-unit km/h")

    def test_commands_of_another_range(self, clean, tmp_path):
        steering = 25 * clean["steering"] / np.abs(clean["steering"]).max()
        self.refuse(tmp_path, {**clean, "steering": steering}, "reaches 25", "--steering-scale 0.04")

    def test_several_faults_are_told_at_once(self, clean, tmp_path):
        columns = {**clean, "steering": 25 * clean["steering"], "yaw_rate": np.rad2deg(clean["yaw_rate"])}
        with pytest.raises(DataError, match="2 faults") as caught:
            import_csv(foreign.write(tmp_path / "run.csv", columns))
        assert str(caught.value).count("\n  - ") == 2

    @pytest.mark.parametrize(
        ("content", "said"),
        [
            (b"", "is empty"),
            (b"t,x,y,yaw,steering,throttle\n", "has 0 rows"),
            (b"0,1,2,3,4,5\n1,1,1,1,1,1\n2,2,2,2,2,2\n", "header line"),
            (b"t,x,y,yaw,steering,throttle\n0,0,0,0,0,0\n1,1,1\n2,2,2,2,2,2\n", "Row 2"),
            (b"t,t,y,yaw,steering,throttle\n0,0,0,0,0,0\n1,1,1,1,1,1\n", "two columns named 't'"),
            (b"\x89PNG\r\n\x1a\n\xff\xd8", "not a text file"),
            (gzip.compress(b"t,x,y\n" * 1000, mtime=0)[:-20], "not a whole gzip file"),
        ],
    )
    def test_files_that_are_no_recording(self, content, said, tmp_path):
        path = tmp_path / "run.csv"
        path.write_bytes(content)
        with pytest.raises(DataError, match=said):
            import_csv(path)

    def test_no_such_file(self, tmp_path):
        with pytest.raises(DataError, match="check the path"):
            import_csv(tmp_path / "nowhere.csv")


class TestMappingFile:
    @pytest.mark.parametrize(
        ("text", "said"),
        [
            ("velocity_frane = 'world'\n[columns]\nt = 't'\n", "did you mean 'velocity_frame'"),
            ("[columns.yawrate]\nname = 'w'\n", "did you mean 'yaw_rate'"),
            ("[columns.yaw]\nname = 'psi'\nunit = 'degrees'\n", "Unit 'degrees' of yaw"),
            ("[columns.yaw]\nname = 'psi'\nsign = -2\n", "must be one of"),
            ("[columns.yaw\n", "not valid TOML"),
            ("layout = 'x'\n", "names no columns"),
        ],
    )
    def test_mistakes_are_named(self, text, said, tmp_path):
        (tmp_path / "map.toml").write_text(text)
        with pytest.raises(ConfigError, match=said):
            load_mapping(tmp_path / "map.toml")

    def test_options_of_a_copy_are_checked(self):
        with pytest.raises(ConfigError, match="did you mean 'velocities'"):
            CANONICAL.with_options(velocitys="pose")
        changed = CANONICAL.with_options(columns={"steering": {"sign": -1}}, velocities="pose")
        assert changed.columns["steering"] == ColumnSource("steering", sign=-1)
        assert CANONICAL.columns["steering"].sign == 1
