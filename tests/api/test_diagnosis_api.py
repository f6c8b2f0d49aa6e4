"""Test the Python interface (recordings, cars, diagnoses) and its agreement with the command line."""

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest

import carlab
from carlab.cli import run
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import ConfigError, DataError
from carlab.core.manoeuvres import steering_chirp
from carlab.core.quantities import CarState
from carlab.recording.mcap.sink import write_episode
from sim_backends.car_parameters import SimulatorConfig


def test_load_car_accepts_names_paths_and_cars(tmp_path: Path) -> None:
    car = carlab.load_car("eth_rc_car")
    copied = carlab.load_car(car.save(tmp_path / "copy.toml"))
    assert copied.simulator == car.simulator
    assert carlab.load_car(car) is car
    default = carlab.load_car()
    assert carlab.load_car(default.save(tmp_path / "default.toml")).simulator == default.simulator
    assert repr(default) == "<CarFile rc_car: dynamic>"
    with pytest.raises(ConfigError, match="eth_rc_car"):
        carlab.load_car("no_such_car")


def csv_file(path: Path, rows: int = 120) -> Path:
    t = np.arange(rows) / 30.0
    speed, rate = 1.0, 0.5
    x, y, yaw = 2.0 * np.sin(rate * t), 2.0 * (1 - np.cos(rate * t)), rate * t
    columns = [t, x, y, yaw, np.full(rows, speed), np.zeros(rows), np.full(rows, rate), 0.3 * np.sin(t), 0.2 + 0.0 * t]
    lines = ["t,x,y,yaw,vx,vy,yaw_rate,steering,throttle"]
    lines += [",".join(f"{value:.9f}" for value in row) for row in zip(*columns, strict=True)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_csv_is_loaded_with_audit_and_saved_as_mcap(tmp_path: Path) -> None:
    recording = carlab.load(csv_file(tmp_path / "drive.csv"))
    assert recording.audit is not None
    assert recording.episode.ticks == 119
    assert recording.duration_s == pytest.approx(119 / 30.0)
    assert "119 commands" in repr(recording)
    assert "<p>" in recording._repr_html_()
    reloaded = carlab.load(recording.save(tmp_path / "drive.mcap"))
    np.testing.assert_allclose(reloaded.episode.states, recording.episode.states, atol=1e-6)
    with pytest.raises(DataError, match="exists already"):
        recording.save(tmp_path / "drive.mcap")
    with pytest.raises(ConfigError, match="parquet"):
        recording.save(tmp_path / "drive.xlsx")


def test_options_of_import_are_arguments_of_load(tmp_path: Path) -> None:
    path = csv_file(tmp_path / "drive.csv")
    plain = carlab.load(path).episode
    flipped = carlab.load(path, steering_sign=-1).episode
    np.testing.assert_allclose(flipped.sent[:, 0], -plain.sent[:, 0])
    with pytest.raises(ConfigError, match="velocity_fram"):
        carlab.load(path, velocity_fram="world")


def test_load_refuses_missing_files_and_folders(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="does not exist"):
        carlab.load(tmp_path / "nothing.mcap")
    with pytest.raises(ConfigError, match="folder"):
        carlab.load(tmp_path)


def drive_of(simulator: SimulatorConfig, seconds: float = 25.0, seed: int = 1) -> EpisodeData:
    """Simulate a noisy steering chirp with varying throttle."""
    from sim_backends.plant import Plant

    chirp = steering_chirp(duration_s=seconds, high_hz=2.0)
    plant = Plant(simulator)
    plant.reset(CarState(), 0.0)
    period_s = simulator.control_period_s
    times, states, sent = [], [], []
    for k in range(int(seconds / period_s)):
        t_s = k * period_s
        states.append(plant.advance(t_s).to_array())
        times.append(t_s)
        action = chirp.at(t_s)
        action = type(action)(action.steering, 0.3 + 0.15 * np.sign(np.sin(0.7 * t_s)))
        plant.command(t_s, action)
        sent.append(action.to_array())
    rng = np.random.default_rng(seed)
    noisy = np.array(states) + rng.normal(0.0, (3e-4, 3e-4, 2e-3, 5e-3, 5e-3, 1e-2), (len(states), 6))
    commands = np.array(sent[:-1])
    return EpisodeData(np.array(times), noisy, commands, commands, np.full(len(commands), np.nan))


@pytest.fixture(scope="module")
def lagging(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, carlab.DiagnosisReport]:
    """Return a recording of a car with a servo lag of 90 ms, and its diagnosis with one candidate effect."""
    car = carlab.load_car("sim")
    simulator = car.simulator.with_values({"effects.steering_lag.time_constant": 0.09, "mocap.latency": 0.0})
    path = tmp_path_factory.mktemp("lagging") / "drive.mcap"
    write_episode(drive_of(simulator), path)
    report = carlab.diagnose(path, car, effects=("steering_lag",))
    return path, report


def test_diagnosis_names_the_lag_and_returns_a_loadable_model(
    lagging: tuple[Path, carlab.DiagnosisReport], tmp_path: Path
) -> None:
    report = lagging[1]
    assert report.is_conclusive
    assert set(report.effects) == {"steering_lag"}
    estimate = report.effects["steering_lag"].parameters["time_constant"]
    assert estimate.value == pytest.approx(0.09, abs=0.03)
    assert report.held_out["with_effects"].score < report.held_out["refit"].score
    model = carlab.load_car(report.model.save(tmp_path / "model.toml"))
    assert model.simulator == report.model.simulator
    assert model.simulator.effects["steering_lag"]["time_constant"] == pytest.approx(estimate.value)


def test_report_is_saved_and_has_notebook_html(lagging: tuple[Path, carlab.DiagnosisReport], tmp_path: Path) -> None:
    report = lagging[1]
    report.save_decisions(report.save(tmp_path / "out"))
    folder = report.save(tmp_path / "out")  # decisions of the earlier report would not belong to this one
    names = {path.name for path in folder.iterdir()}
    assert names == {"report.html", "report.json", "report.rrd", "summary.png", "model.toml"}
    assert json.loads((folder / "report.json").read_text())["verdict"] == report.verdict
    assert (folder / "model.toml").read_text() == report.model.text
    assert tomllib.loads(report.model.text)["effects"]["steering_lag"]
    assert report._repr_html_().startswith("<iframe srcdoc=")
    assert "steering" in str(report)
    assert repr(report) == str(report), "a Python session shows the verdict"


def test_verb_writes_the_report_of_the_call(
    lagging: tuple[Path, carlab.DiagnosisReport], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, report = lagging
    out = tmp_path / "out"
    assert run(["diagnose", str(path), "--effects", "steering_lag", "--out", str(out)]) == 0
    assert report.sentence.split(".")[0] in capsys.readouterr().out.replace("\n", " ")
    written, returned = json.loads((out / "report.json").read_text()), report.to_dict()
    for varying in ("seconds",):
        written.pop(varying), returned.pop(varying)
    assert written == json.loads(json.dumps(returned))


def test_short_recording_is_inconclusive_with_a_reason(tmp_path: Path) -> None:
    report = carlab.diagnose(carlab.load(csv_file(tmp_path / "short.csv")), out=tmp_path / "out")
    assert not report.is_conclusive
    assert report.verdict == "inconclusive"
    assert "The recordings to fit contain 4.0 s of driving. A diagnosis needs at least 8 s" in report.sentence
    assert (tmp_path / "out" / "report.json").is_file()


def test_recordings_too_short_to_be_split_are_inconclusive_with_a_remedy(tmp_path: Path) -> None:
    """Of seven drives of 120 rows at 30 Hz, nothing remains before the held-out last part of each and its gap."""
    drives = [csv_file(tmp_path / f"{k}.csv") for k in range(7)]
    for k, path in enumerate(drives):  # equal files are refused
        path.write_text(path.read_text() + k * "\n")
    sentence = carlab.diagnose(drives).sentence
    assert "contain 28.0 s of driving, but only 0.0 s without the last part of each recording" in sentence
    assert "Hold out whole recordings with --held-out" in sentence
    remedied = carlab.diagnose(drives[:5], held_out=drives[5:]).sentence
    assert "throttle command is constant" in remedied, "the next check, of commands, follows"


def test_invalid_arguments_are_refused(tmp_path: Path) -> None:
    recording = carlab.load(csv_file(tmp_path / "drive.csv"))
    with pytest.raises(ConfigError, match="both fitted and held out"):
        carlab.diagnose(recording, held_out=tmp_path / "drive.csv")
    with pytest.raises(ConfigError, match="There is no effect"):
        carlab.diagnose(recording, effects=["steering_leg"])
    with pytest.raises(ConfigError, match="at least one recording"):
        carlab.diagnose([])
    with pytest.raises(ConfigError, match="holdout-share"):
        carlab.diagnose(recording, held_out=csv_file(tmp_path / "other.csv"), holdout_share=0.2)


def test_copy_of_a_fitted_recording_is_not_held_out(tmp_path: Path) -> None:
    path, copy = csv_file(tmp_path / "drive.csv"), csv_file(tmp_path / "copy.csv")
    with pytest.raises(ConfigError, match=r"copy\.csv has the content of .*drive\.csv; name one of them"):
        carlab.diagnose(path, held_out=copy)
    with pytest.raises(ConfigError, match=r"copy\.csv has the content of"):
        carlab.compare(path, copy)
    episode = carlab.load(path).episodes[0]
    with pytest.raises(ConfigError, match="has the content of"):
        carlab.diagnose(episode, held_out=episode)


def test_each_predicted_recording_is_saved_with_its_own_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = []
    monkeypatch.setattr(
        "carlab.recording.rerun.sink.episode_to_rrd", lambda episode, file, name, overlays: names.append(name)
    )
    paths = [csv_file(tmp_path / name) for name in ("first.csv", "second.csv")]
    carlab.predict(paths, horizon_s=0.5).save(tmp_path / "predicted.rrd")
    assert names == ["first.csv", "second.csv"]


def test_one_name_need_not_be_in_a_list(tmp_path: Path) -> None:
    path = csv_file(tmp_path / "drive.csv")
    with pytest.raises(ConfigError, match=r"'steering_lagg'.*did you mean 'steering_lag'"):
        carlab.diagnose(path, effects="steering_lagg")
    with pytest.raises(ConfigError, match=r"'motor_lagg'.*did you mean 'motor_lag'"):
        carlab.compare(path, csv_file(tmp_path / "other.csv"), candidates="motor_lagg")
