"""Wrong paths, repeated inputs and existing outputs are refused before any work; nothing is overwritten."""

from __future__ import annotations

import io
import json
import logging
from pathlib import Path

import numpy as np
import pytest

from carlab import cli
from carlab.cli.console import PACKAGES, log_to_console
from carlab.recording.csv.table import read_csv
from tests.cli.test_bad_input import canonical_csv, write
from tests.helpers.command_line import Carlab


@pytest.fixture
def drive_csv(tmp_path: Path) -> Path:
    return write(*canonical_csv(tmp_path, rows=60))


@pytest.mark.parametrize("verb", ["diagnose", "compare"])
def test_folder_that_cannot_be_written_is_refused_before_the_work(
    carlab: Carlab, drive_csv: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verb: str
) -> None:
    """The recording does not exist: its error would come first if the folder were checked later."""
    code, text = carlab(verb, tmp_path / "missing.csv", "--out", drive_csv / "out")
    assert code == 1
    assert f"{drive_csv} is a file; choose another folder." in text
    monkeypatch.setattr("os.access", lambda path, mode: False)
    code, text = carlab(verb, tmp_path / "missing.csv", "--out", tmp_path / "out")
    assert code == 1
    assert f"{tmp_path} is not writable" in text


def test_existing_picture_is_not_replaced(carlab: Carlab, drive_csv: Path, tmp_path: Path) -> None:
    picture = tmp_path / "mine.png"
    picture.write_bytes(b"mine")
    code, text = carlab("view", drive_csv, "--screenshot", picture)
    assert code == 1
    assert "mine.png exists already; remove it or choose another --screenshot." in text
    assert picture.read_bytes() == b"mine"


def test_picture_of_a_diagnosis_needs_no_viewer(
    carlab: Carlab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("carlab.recording.rerun.screenshot.has_vulkan_driver", lambda: False)
    (tmp_path / "report.rrd").write_bytes(b"RRF2 the report")
    (tmp_path / "summary.png").write_bytes(b"the summary")
    code, _ = carlab("view", tmp_path, "--screenshot", tmp_path / "new" / "copy.png")
    assert code == 0
    assert (tmp_path / "new" / "copy.png").read_bytes() == b"the summary"


@pytest.mark.parametrize("verb", ["diagnose", "compare"])
def test_recording_that_is_given_twice_is_refused(carlab: Carlab, drive_csv: Path, tmp_path: Path, verb: str) -> None:
    second = ["--with", tmp_path / "other.csv"] if verb == "compare" else []
    code, text = carlab(verb, drive_csv, tmp_path / "." / "drive.csv", *second, "--out", tmp_path / "out")
    assert code == 2
    assert "drive.csv is given twice; name it once." in text
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (("drive", "--car", "FOLDER"), "is a folder; name a car file in it"),
        (("drive", "--vehicle", "FOLDER"), "is a folder; name a car file in it"),
        (("replay", "FOLDER"), "is a folder; name a file in it"),
        (("diagnose", "CSV", "--held-out"), "--held-out names no recording; name one or more after it, or remove the"),
        (("diagnose", "CSV", "--holdout"), "--held-out names no recording"),
        (("diagnose", "CSV", "--effects", "steering_lagg"), "in the catalogue; did you mean 'steering_lag'?"),
        (("diagnose", "CSV", "--effects", "drive_map"), "There is no effect 'drive_map' in the catalogue"),
    ],
)
def test_message_names_the_mistake(
    carlab: Carlab,
    drive_csv: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    argv: tuple[str, ...],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    places = {"FOLDER": "folder", "CSV": str(drive_csv)}
    code, text = carlab(*(places.get(word, word) for word in argv))
    assert code == 2
    assert message in text
    assert {file.name for file in tmp_path.iterdir()} == {"folder", "drive.csv"}


@pytest.mark.parametrize(
    ("table", "name"),
    [("[vehicle]\nmass = 1650", "vehicle.mass"), ("[vehicle]\nfront_axle = 130", "vehicle.front_axle")],
)
def test_grams_and_millimetres_are_refused(carlab: Carlab, tmp_path: Path, table: str, name: str) -> None:
    path = tmp_path / "car.toml"
    path.write_text(table, encoding="utf-8")
    code, text = carlab("drive", "--car", path, "--out", tmp_path / "runs")
    assert code == 2
    assert name in text
    assert "is it in another unit?" in text


def test_rerun_file_is_not_exported_and_the_message_says_what_to_name(carlab: Carlab, tmp_path: Path) -> None:
    (tmp_path / "0001.rrd").write_bytes(b"RRF2\x00")
    code, text = carlab("export", tmp_path / "0001.rrd", "--out", tmp_path / "a.csv")
    assert code == 1
    assert "is for the rerun viewer (carlab view); name the .mcap recording instead." in text


def test_name_that_the_terminal_cannot_show_is_escaped(
    drive_csv: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = io.BytesIO()
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(shown, encoding="latin-1"))
    with pytest.raises(SystemExit) as ended:
        cli.main(["export", str(drive_csv), "--out", str(tmp_path / "\u65e5.csv")])
    assert ended.value.code == 0
    assert b"\\u65e5.csv: 60 rows" in shown.getvalue()


def test_no_part_is_written_if_one_exists(carlab: Carlab, tmp_path: Path) -> None:
    path, data = canonical_csv(tmp_path)
    data[len(data) // 2 :, 0] += 5.0
    (tmp_path / "run-2.mcap").write_bytes(b"other")
    code, text = carlab("import", write(path, data), "--gaps", "split", "--out", tmp_path / "run.mcap")
    assert code == 1
    assert "run-2.mcap exists already" in text
    assert not (tmp_path / "run-1.mcap").exists()
    assert (tmp_path / "run-2.mcap").read_bytes() == b"other"


def test_rate_of_a_file_with_a_time_column_is_refused(carlab: Carlab, drive_csv: Path, tmp_path: Path) -> None:
    code, text = carlab("import", drive_csv, "--rate", "30", "--out", tmp_path / "a.mcap")
    assert code == 1
    assert "has the time column 't'; remove --rate" in text


def test_interrupt_during_the_imports_is_one_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "_verbs", interrupted)
    with pytest.raises(SystemExit) as end:
        cli.main(["drive"])
    assert end.value.code == 130
    assert capsys.readouterr().err == "carlab: Interrupted.\n"


def test_manoeuvre_of_a_simulated_car_is_driven_to_its_end(carlab: Carlab, tmp_path: Path) -> None:
    """steering_steps takes 7.2 s and 7 m; the arena of parking is 4.2 m long and its episode 3.3 s."""
    code, text = carlab("drive", "--policy", "steering_steps", "--out", tmp_path, "--no-rerun", "--no-picture")
    assert code == 0, text
    (run,) = tmp_path.iterdir()
    (episode,) = json.loads((run / "result.json").read_text())["episodes"]
    assert episode["end_reason"] == "POLICY_FINISHED"
    assert episode["ticks"] == pytest.approx(7.2 * 30, abs=2)


def test_manoeuvre_with_a_task_stays_in_its_arena(carlab: Carlab, tmp_path: Path) -> None:
    code, text = carlab(
        *("drive", "--policy", "steering_steps", "--task", "parking", "--out", tmp_path, "--no-rerun", "--no-picture")
    )
    assert code == 4
    assert "enlarge the arena" in text


def test_run_of_another_version_names_that_version(carlab: Carlab, tmp_path: Path) -> None:
    run = tmp_path / "run"
    run.mkdir()
    (run / "campaign.json").write_text('{"plan": {"a_later_setting": 1}}', encoding="utf-8")
    (run / "environment.json").write_text('{"carlab": "9.8.7"}', encoding="utf-8")
    code, text = carlab("drive", "--policy", run, "--out", tmp_path / "runs")
    assert code == 1
    assert "was written by carlab 9.8.7, and carlab" in text
    assert "a_later_setting" not in text
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("head", ["# ", "#", "# Recorded on Monday, by hand\n# ", "# Recorded on Monday\n"])
def test_comments_before_the_header_are_skipped(carlab: Carlab, drive_csv: Path, tmp_path: Path, head: str) -> None:
    """numpy.savetxt writes its header as a comment."""
    commented = tmp_path / "commented.csv"
    commented.write_text(head + drive_csv.read_text(), encoding="utf-8")
    np.testing.assert_array_equal(read_csv(commented).column("yaw"), read_csv(drive_csv).column("yaw"))
    assert carlab("import", commented, "--out", tmp_path / "a.mcap")[0] == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--seconds", "2"), "--seconds has no effect on predictions; add --drive, or remove it."),
        (("--reality", "rc_car"), "--reality has no effect on predictions; add --drive, or remove it."),
        (("--drive", "--save", "a.rrd"), "--save is for predictions by a simulated car; remove it to drive."),
        (("--drive", "--adapt"), "--adapt is for predictions by a simulated car; remove it to drive."),
        (("--drive", "--horizon", "2"), "--horizon is for predictions by a simulated car; remove it to drive."),
        (("--drive", "--holdout-share", "0.2"), "--holdout-share is for predictions by a simulated car; remove it to"),
        (("--drive", "--keep-events"), "--keep-events is for predictions by a simulated car; remove it to drive."),
    ],
)
def test_option_of_the_other_kind_of_replay_is_refused(
    carlab: Carlab, drive_csv: Path, options: tuple[str, ...], message: str
) -> None:
    code, text = carlab("replay", drive_csv, *options)
    assert code == 2
    assert message in text


def test_arena_in_millimetres_is_refused(carlab: Carlab, tmp_path: Path) -> None:
    """It would be a geofence that never stops the car."""
    path = tmp_path / "car.toml"
    corners = "[[-1400, -2600], [2800, -2600], [2800, 1500], [-1400, 1500]]"
    path.write_text(f"[hardware.arena]\ncorners_m = {corners}\n", encoding="utf-8")
    code, text = carlab("check", "--car", path)
    assert code == 2
    assert "has a corner at 2800 m; it must be at most 500 m (is it in another unit?)." in text


def test_latency_in_milliseconds_is_refused(carlab: Carlab, tmp_path: Path) -> None:
    path = tmp_path / "car.toml"
    path.write_text("[mocap]\nlatency = 8\n", encoding="utf-8")
    code, text = carlab("drive", "--car", path, "--out", tmp_path / "runs")
    assert code == 2
    assert "mocap.latency is 8 s; it must be at most 1 (is it in another unit?)." in text


def test_existing_findings_are_not_replaced(carlab: Carlab, drive_csv: Path, tmp_path: Path) -> None:
    findings = tmp_path / "findings.json"
    findings.write_text("mine", encoding="utf-8")
    code, text = carlab("import", drive_csv, "--out", tmp_path / "a.mcap", "--report", findings)
    assert code == 1
    assert "findings.json exists already; remove it or choose another --report." in text
    assert findings.read_text() == "mine"
    assert not (tmp_path / "a.mcap").exists()


def test_report_of_a_refused_import_is_written_with_the_reason(carlab: Carlab, tmp_path: Path) -> None:
    path, data = canonical_csv(tmp_path)
    data[:, 8] *= 100.0
    write(path, data)
    report = tmp_path / "reports" / "audit.json"
    code, text = carlab("import", path, "--report", report)
    assert code == 1
    content = json.loads(report.read_text())
    assert " ".join(content["refusal"].split()) in text
    (error,) = [finding for finding in content["findings"] if finding["severity"] == "error"]
    assert error["channel"] == "throttle"
    assert error["option"] == "--throttle-scale 0.01"
    code, text = carlab("import", path, "--throttle-scale", "0.01", "--report", report)
    assert code == 0, text
    assert json.loads(report.read_text())["refusal"] is None
    code, text = carlab("import", path, "--out", tmp_path / "b.mcap", "--report", report)
    assert code == 1
    assert "audit.json exists already" in text, "the report of a finished import is kept"


def test_report_of_a_file_that_is_no_recording_has_the_reason(carlab: Carlab, tmp_path: Path) -> None:
    (tmp_path / "drive.csv").write_text("time,x,y\n0,0,0\n1,1,1\n2,2,2\n", encoding="utf-8")
    assert carlab("import", tmp_path / "drive.csv", "--report", tmp_path / "audit.json")[0] == 1
    content = json.loads((tmp_path / "audit.json").read_text())
    assert "drive.csv has no column t" in content["refusal"]
    assert content["findings"] == []


@pytest.mark.parametrize("option", ["--out", "--report"])
def test_output_below_a_file_is_refused_before_the_import(
    carlab: Carlab, drive_csv: Path, tmp_path: Path, option: str
) -> None:
    outputs = {"--out": tmp_path / "a.mcap", "--report": tmp_path / "a.json"}
    (tmp_path / "file").touch()
    outputs[option] = tmp_path / "file" / outputs[option].name
    code, text = carlab("import", drive_csv, *(word for pair in outputs.items() for word in pair))
    assert code == 1
    assert f"{option} {outputs[option]}: {tmp_path / 'file'} is a file; choose another folder." in text
    assert {path.name for path in tmp_path.iterdir()} == {"file", "drive.csv"}


@pytest.mark.parametrize("words", [("diagnose", "runs"), ("compare", "a.csv", "--with", "runs")])
def test_folder_of_runs_is_refused_with_a_run_in_it(
    carlab: Carlab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("runs").mkdir()
    code, text = carlab(*words)
    assert code == 2
    assert "runs is not the folder of a run; name a run folder, or a recording." in text
    Path("runs", "2026-11-24_drive", "episodes").mkdir(parents=True)
    assert "name a run folder, for example runs/2026-11-24_drive, or a recording." in carlab(*words)[1]


@pytest.mark.parametrize("verb", ["diagnose", "replay", "view"])
def test_message_of_a_verb_without_import_options_names_the_import(
    carlab: Carlab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verb: str
) -> None:
    monkeypatch.chdir(tmp_path)
    path, data = canonical_csv(tmp_path)
    data[:, 8] *= 100.0
    write(path, data)
    hint = f"Convert the file with carlab import and this option first, then {verb} the .mcap file."
    code, text = carlab(verb, path)
    assert code == 1
    assert "--throttle-scale 0.01" in text
    assert text.endswith(hint)
    assert "Convert the file" not in carlab("import", path)[1]
    write(path, data, header="time,x,y,yaw,vx,vy,yaw_rate,steering,throttle")
    assert "carlab import --mapping FILE.toml" in carlab(verb, path)[1]


def test_import_is_named_below_a_list_of_faults(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, data = canonical_csv(tmp_path)
    data[:, 7:] *= 100.0
    write(path, data)
    assert cli.run(["diagnose", str(path)]) == 1
    *faults, last = capsys.readouterr().err.splitlines()
    assert any("--throttle-scale 0.01" in line for line in faults)
    assert last == "Convert the file with carlab import and these options first, then diagnose the .mcap file."


def test_empty_car_file_is_not_the_default_car(carlab: Carlab, tmp_path: Path) -> None:
    path = tmp_path / "car.toml"
    path.write_text("# cut off\n", encoding="utf-8")
    code, text = carlab("drive", "--car", path, "--out", tmp_path / "runs")
    assert code == 2
    assert "car.toml is empty; a car file has at least one table such as [vehicle]." in text


def test_verbose_log_has_details_of_the_program_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Matplotlib's search for fonts filled pages."""
    for name in ("", *PACKAGES):
        monkeypatch.setattr(logging.getLogger(name), "level", logging.WARNING)
    monkeypatch.setattr(logging.getLogger(), "handlers", [])
    log_to_console(verbose=True)
    assert logging.getLogger("carlab.diagnosis").isEnabledFor(logging.DEBUG)
    assert not logging.getLogger("matplotlib.font_manager").isEnabledFor(logging.DEBUG)


@pytest.mark.parametrize("target", [("--out=~/drive.csv",), ("--out", "~/drive.csv")])
def test_home_folder_is_expanded_in_options(
    carlab: Carlab, drive_csv: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, target: tuple[str, ...]
) -> None:
    """A shell expands ``~`` in neither of them: not after ``=``, and not in quotation marks."""
    home, elsewhere = tmp_path / "home", tmp_path / "elsewhere"
    home.mkdir()
    elsewhere.mkdir()
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.chdir(elsewhere)
    code, _ = carlab("export", drive_csv, *target)
    assert code == 0
    assert (home / "drive.csv").is_file()
    assert list(elsewhere.iterdir()) == []
