"""Invalid input is refused with one sentence, the next step and a non-zero exit code; never with a traceback."""

import json
import math
import os
import re
import socket
import sys
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from carlab import cli
from carlab.cars.emulated_world import World, WorldConfig
from carlab.core.clock import MonotonicClock
from mocap.emulators.faults import ServerFaults
from mocap.natnet.models import BitstreamVersion
from sim_backends.car_parameters import SimulatorConfig
from tests.helpers.command_line import Carlab

CAR = """
[hardware]
name = "test car"
[hardware.actuator]
port = "{port}"
open_timeout_s = 1.0
[hardware.mocap]
server_address = "127.0.0.1"
local_interface = "127.0.0.1"
command_port = {command_port}
timeout_s = 0.6
{mocap}
[hardware.arena]
corners_m = [[-3, -3], [3, -3], [3, 3], [-3, 3]]
"""


@pytest.fixture
def world() -> World:
    return World(WorldConfig(simulator=SimulatorConfig().to_tables()))


def car_file(folder: Path, port: str = "/dev/carlab-nowhere", command_port: int = 9, mocap: str = "") -> Path:
    path = folder / "car.toml"
    path.write_text(CAR.format(port=port, command_port=command_port, mocap=mocap), encoding="utf-8")
    return path


def canonical_csv(folder: Path, rows: int = 300) -> tuple[Path, np.ndarray]:
    """Path of a CSV and an exact circle at 1 m/s, shape (rows, 9)."""
    t = np.arange(rows) / 30.0
    yaw = 0.8 * t
    columns = [t, np.sin(yaw) / 0.8, (1 - np.cos(yaw)) / 0.8, (yaw + math.pi) % (2 * math.pi) - math.pi]
    columns += [np.ones(rows), np.zeros(rows), np.full(rows, 0.8), np.full(rows, 0.4), 0.3 + 0.01 * np.sin(t)]
    data = np.stack(columns, axis=1)
    return folder / "drive.csv", data


def write(path: Path, data: np.ndarray, header: str = "t,x,y,yaw,vx,vy,yaw_rate,steering,throttle") -> Path:
    np.savetxt(path, data, delimiter=",", header=header, comments="")
    return path


def test_wrong_port_and_silent_mocap_server_are_reported_together(carlab: Carlab, tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as silent_server:
        silent_server.bind(("127.0.0.1", 0))
        path = car_file(tmp_path, command_port=silent_server.getsockname()[1])
        code, text = carlab("check", "--car", path)
    assert code == 3
    assert "/dev/carlab-nowhere" in text
    assert "port" in text
    assert "NatNet" in text or "motion capture" in text.lower()
    assert "Motive" in text


def test_unknown_rigid_body_is_refused_with_the_available_ones(carlab: Carlab, tmp_path: Path, world: World) -> None:
    with world:
        addresses = world.addresses
        path = car_file(tmp_path, addresses["port"], addresses["command_port"], 'body = "truck"')
        code, text = carlab("check", "--car", path)
        assert code == 3
        assert "truck" in text
        assert "car" in text.split("truck")[1]
        path = car_file(tmp_path, addresses["port"], addresses["command_port"], "body_id = 77")
        code, text = carlab("listen", "--car", path, "--seconds", "0.2")
        assert code == 3
        assert "77" in text


def test_frames_of_another_natnet_version_are_refused(carlab: Carlab, tmp_path: Path, world: World) -> None:
    world.server.faults = ServerFaults(frame_version=BitstreamVersion(3, 0))
    with world:
        addresses = world.addresses
        path = car_file(tmp_path, addresses["port"], addresses["command_port"])
        code, text = carlab("listen", "--car", path, "--seconds", "0.3")
    assert code == 3
    assert "4.1" in text


def test_malformed_frames_are_counted_and_ignored(carlab: Carlab, tmp_path: Path, world: World) -> None:
    world.server.faults = ServerFaults(garbage=0.3, truncation=0.3)
    with world:
        addresses = world.addresses
        path = car_file(tmp_path, addresses["port"], addresses["command_port"])
        code, text = carlab("listen", "--car", path, "--seconds", "0.8")
    assert code == 0
    assert "malformed" in text
    assert re.search(r"rate +[\d.]+ +Hz", text)


def test_wrong_up_axis_is_reported_and_prevents_driving(carlab: Carlab, tmp_path: Path, world: World) -> None:
    with world:
        world.answer({"do": "place", "state": [0.0, 0.0, 1.2, 0.0, 0.0, 0.0]})
        addresses = world.addresses
        path = car_file(tmp_path, addresses["port"], addresses["command_port"], 'body = "car"\nup_axis = "y"')
        code, text = carlab("check", "--car", path, "--seconds", "0.5")
        assert (code, "Ready." in text) == (0, True), text
        path = car_file(tmp_path, addresses["port"], addresses["command_port"], 'body = "car"\nup_axis = "z"')
        code, text = carlab("check", "--car", path, "--seconds", "0.5")
        assert code == 3
        assert "Not ready." in text
        assert 'up_axis = "y" may be right' in text
        options = ["--no-place", "--no-rerun", "--ticks", "10", "--policy", "slow_circle"]
        code, text = carlab("drive", "--car", path, *options, "--out", tmp_path / "runs")
        assert code == 3
        assert 'up_axis = "y" may be right' in text
        assert all(entry.value == 0.0 for entry in world.log.motor()), "no moving command has reached the firmware"
        code, text = carlab("listen", "--car", path, "--seconds", "0.5")
        assert code == 0
        assert 'up_axis = "y" may be right' in text


def test_wrong_up_axis_ends_a_drive_that_begins_at_yaw_0(carlab: Carlab, tmp_path: Path, world: World) -> None:
    with world:
        world.answer({"do": "place", "state": [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]})
        addresses = world.addresses
        path = car_file(tmp_path, addresses["port"], addresses["command_port"], 'body = "car"\nup_axis = "z"')
        options = ["--no-place", "--no-rerun", "--no-picture", "--policy", "slow_circle"]
        code, text = carlab("drive", "--car", path, *options, "--out", tmp_path / "runs")
        assert code == 4
        assert 'up_axis = "y" may be right' in text
        yaw_rad = world.answer({"do": "state"})["state"][2]
        assert 0.6 < yaw_rad < 1.4, "the drive ended soon after the turn by 40 degrees"


@pytest.mark.parametrize(
    ("table", "parts"),
    [
        ("[vehicle]\nmas = 1.6\n", ["'mas'", "did you mean 'mass'?"]),
        ("[vehicle]\nmass = -1.0\n", ["mass"]),
        ("[effects.steering_lagg]\ntime_constant = 0.1\n", ["steering_lagg", "steering_lag"]),
        ("[hardware]\nname = 'x'\n", ["arena"]),
        ("[hardware.limits]\nmax_sped_mps = 2\n", ["max_sped_mps", "max_speed_mps"]),
        ("this is no toml\n", ["TOML"]),
    ],
)
def test_invalid_car_file_is_refused_with_the_name_of_the_key(
    carlab: Carlab, tmp_path: Path, table: str, parts: list[str]
) -> None:
    path = tmp_path / "wrong.toml"
    path.write_text(table, encoding="utf-8")
    code, text = carlab("drive", "--car", path, "--out", tmp_path / "runs")
    assert code == 2
    for part in parts:
        assert part in text
    assert not (tmp_path / "runs").exists()


def test_unknown_car_is_refused(carlab: Carlab, tmp_path: Path) -> None:
    code, text = carlab("drive", "--car", "emulatd", "--out", tmp_path)
    assert code == 2
    assert "emulated" in text
    code, text = carlab("drive", "--car", tmp_path / "none.toml", "--out", tmp_path)
    assert code == 2
    assert "none.toml" in text


def damaged(kind: str, data: np.ndarray) -> tuple[np.ndarray, str]:
    header = "t,x,y,yaw,vx,vy,yaw_rate,steering,throttle"
    if kind == "gap":
        return np.delete(data, np.s_[100:130], axis=0), header
    if kind == "nan":
        data[50, 2] = np.nan
    if kind == "degrees":
        data[:, 3] = np.degrees(data[:, 3])
    if kind == "unsorted":
        data[[40, 41]] = data[[41, 40]]
    if kind == "column":
        return np.delete(data, 3, axis=1), header.replace("yaw,", "", 1)
    return data, header


@pytest.mark.parametrize(
    ("kind", "parts", "option"),
    [
        ("gap", ["gap"], ["--gaps", "split"]),
        ("nan", ["51"], ["--missing", "drop"]),
        ("degrees", ["degree"], ["--yaw-unit", "deg"]),
        ("unsorted", ["row"], ["--stamps", "drop"]),
        ("column", ["yaw"], None),
    ],
)
def test_damaged_csv_is_refused_with_an_option_that_repairs_it(
    carlab: Carlab, tmp_path: Path, kind: str, parts: list[str], option: list[str] | None
) -> None:
    path, data = canonical_csv(tmp_path)
    write(path, *damaged(kind, data))
    out = tmp_path / "drive.mcap"
    code, text = carlab("import", path, "--out", out)
    assert code == 1
    for part in parts:
        assert part in text
    assert not list(tmp_path.glob("*.mcap*"))
    if option is not None:
        assert " ".join(option) in text
        code, text = carlab("import", path, "--out", out, *option)
        assert code == 0, text
        assert list(tmp_path.glob("*.mcap"))


def test_truncated_mcap_is_recovered_and_mcap_without_ticks_is_refused(carlab: Carlab, tmp_path: Path) -> None:
    path, data = canonical_csv(tmp_path)
    complete = tmp_path / "drive.mcap"
    assert carlab("import", write(path, data), "--out", complete)[0] == 0
    truncated = tmp_path / "truncated.mcap"
    truncated.write_bytes(complete.read_bytes()[: complete.stat().st_size // 2])
    code, text = carlab("export", truncated, "--out", tmp_path / "cut.csv")
    assert code == 0
    assert "truncated.mcap ends at byte" in text
    assert "complete ticks were recovered; copy it again." in text
    rows = np.genfromtxt(tmp_path / "cut.csv", delimiter=",", names=True)
    assert 20 < len(rows) < len(data)
    np.testing.assert_allclose(rows["x"], data[: len(rows), 1], atol=1e-12)
    for content in (b"", b"\x89MCAP0\r\n", b"t,x,y\n1,2,3\n", complete.read_bytes()[:300]):
        truncated.write_bytes(content)
        code, text = carlab("view", truncated, "--save", tmp_path / "cut.rrd")
        assert code == 1
        assert "truncated.mcap" in text
        assert not (tmp_path / "cut.rrd").exists()


def test_verbs_that_fit_name_a_truncated_mcap_and_the_report_lists_it(carlab: Carlab, tmp_path: Path) -> None:
    path, data = canonical_csv(tmp_path)
    recording = tmp_path / "drive.mcap"
    assert carlab("import", write(path, data), "--out", recording)[0] == 0
    recording.write_bytes(recording.read_bytes()[: recording.stat().st_size // 2])
    named = f"{recording}: reported: the file ends at byte {recording.stat().st_size} before its closing record"
    out = tmp_path / "diagnosis"
    for verb in (("diagnose", "--out", out), ("replay",)):
        code, text = carlab(*verb, recording)
        assert named in text, (code, text)
        assert "complete ticks were recovered; copy it again." in text
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    assert [fault["id"] for fault in report["data_faults"]] == ["incomplete_file"]
    assert "complete ticks were recovered" in (out / "report.html").read_text(encoding="utf-8")


def test_import_does_not_overwrite_a_recording(carlab: Carlab, tmp_path: Path) -> None:
    path, data = canonical_csv(tmp_path)
    out = tmp_path / "drive.mcap"
    assert carlab("import", write(path, data), "--out", out)[0] == 0
    before = out.read_bytes()
    code, text = carlab("import", path, "--out", out)
    assert code == 1
    assert "already" in text
    assert out.read_bytes() == before


def test_damaged_byte_of_a_recording_is_named(carlab: Carlab, tmp_path: Path) -> None:
    path, data = canonical_csv(tmp_path)
    recording = tmp_path / "drive.mcap"
    assert carlab("import", write(path, data), "--out", recording)[0] == 0
    with recording.open("r+b") as file:
        chunk = make_reader(file).get_summary().chunk_indexes[2]
        file.seek(chunk.chunk_start_offset + chunk.chunk_length - 10)
        file.write(b"damage")
    code, text = carlab("export", recording, "--out", tmp_path / "table.csv")
    assert code == 0
    rows = np.genfromtxt(tmp_path / "table.csv", delimiter=",", names=True)
    assert f"{len(rows) - 1} of {len(data) - 1} ticks were recovered; copy it again." in text
    assert f"drive.mcap is damaged at byte {chunk.chunk_start_offset};" in text
    assert 0.7 * len(data) < len(rows) < len(data)
    assert rows["x"][-1] == data[-1, 1]


def test_unfinished_recording_is_named_by_import_and_view(carlab: Carlab, tmp_path: Path) -> None:
    path, data = canonical_csv(tmp_path)
    unfinished = tmp_path / "drive.mcap.partial"
    assert carlab("import", write(path, data), "--out", tmp_path / "complete.mcap")[0] == 0
    content = (tmp_path / "complete.mcap").read_bytes()
    unfinished.write_bytes(content[: len(content) // 2])
    code, text = carlab("import", path)
    assert code == 1
    assert f"{unfinished} exists: another command writes it, or one was interrupted; move or remove" in text
    assert unfinished.stat().st_size == len(content) // 2
    for options in (("view",), ("replay",), ("export", "--out", tmp_path / "table.csv")):
        code, text = carlab(*options, tmp_path / "drive.mcap")
        assert code == 2
        assert f"does not exist, because its writer was stopped; name '{unfinished}'" in text
    code, text = carlab("export", unfinished, "--out", tmp_path / "drive_again.csv")
    assert code == 0, text


@pytest.mark.parametrize("option", ["--help", "--version"])
def test_closed_pipe_ends_the_program_without_a_traceback(option: str, monkeypatch: pytest.MonkeyPatch) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "w") as closed_pipe:
        monkeypatch.setattr(sys, "stdout", closed_pipe)
        with pytest.raises(SystemExit) as end:
            cli.main([option])
    assert end.value.code == 141


def test_misspelt_option_is_refused_with_a_suggestion(carlab: Carlab) -> None:
    code, text = carlab("drive", "--epsodes", "3")
    assert code == 2
    assert "--episodes" in text
    code, _ = carlab("drive", "--episodes", "0")
    assert code == 2


@pytest.mark.parametrize(
    ("command", "parts"),
    [
        ("drive --seed -1", ["--seed"]),
        ("drive --seed 4294967296", ["--seed 4294967296: give at most 4294967295."]),
        ("replay drive.csv --seed 4294967296", ["--seed 4294967296: give at most 4294967295."]),
        ("diagnose drive.csv --seed 4294967296", ["--seed 4294967296: give at most 4294967295."]),
        ("emulate --seed 4294967296", ["--seed 4294967296: give at most 4294967295."]),
        ("prove --out proof --seed 4294967296", ["--seed 4294967296: give at most 4294967295."]),
        ("bench parking --seeds 3 --first-seed 4294967294", ["--first-seed 4294967294: give at most 4294967293."]),
        ("drive --ticks 0", ["--ticks"]),
        ("drive --max-throttle 2", ["--max-throttle"]),
        ("drive --max-throttle nan", ["--max-throttle"]),
        ("drive --task path", ["--policy"]),
        ("check --seconds 0", ["--seconds"]),
        ("listen --seconds -1", ["--seconds"]),
        ("emulate --command-port 70000", ["--command-port", "65535"]),
        ("emulate --data-port -1", ["--data-port"]),
        ("emulate --actuator can --can-channel vcan0", ["--can-channel", "GROUP:PORT"]),
        ("emulate --port nowhere/vesc", ["--port", "folder"]),
        ("import drive.csv --out drive.txt", [".mcap"]),
        ("replay drive.csv --save drive.png", [".rrd"]),
    ],
)
def test_invalid_option_is_refused_before_a_file_is_written(
    carlab: Carlab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str, parts: list[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write(*canonical_csv(tmp_path))
    code, text = carlab(*command.split())
    assert code == 2
    for part in parts:
        assert part in text
    assert [entry.name for entry in tmp_path.iterdir()] == ["drive.csv"]


def test_second_emulator_does_not_take_the_port_of_the_first(carlab: Carlab, tmp_path: Path) -> None:
    link = tmp_path / "carlab-vesc"
    config = WorldConfig(simulator=SimulatorConfig().to_tables(), serial_link=str(link))
    with World(config):
        terminal = link.readlink()
        code, text = carlab("emulate", "--port", link, "--command-port", "0", "--data-port", "0")
        assert code == 3
        assert "carlab-vesc" in text
        assert link.readlink() == terminal
        assert terminal.exists()


def test_drive_is_refused_if_its_folder_cannot_be_created(carlab: Carlab, tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    start_s = MonotonicClock().now_s()
    code, text = carlab("drive", "--out", blocked / "runs")
    assert code == 1
    assert str(blocked) in text
    assert MonotonicClock().now_s() - start_s < 60
