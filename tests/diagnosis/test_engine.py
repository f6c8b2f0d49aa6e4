"""Test diagnoses of drives of an independent generator with a concealed effect."""

import json
import re
import tomllib
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path

import pytest

import carlab
from carlab.benchmark.cases.case import make_case
from carlab.benchmark.proof.calibration import passes
from carlab.cli import run
from carlab.cli.diagnose import Diagnose
from tests.helpers.case_files import write_case


@pytest.fixture(scope="module")
def concealed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, float]:
    """Write 45 s to fit and 20 s held out with a concealed servo lag and base parameters wrong by up to 10 %."""
    case = make_case("single", 11, effects=("steering_lag",), excess=4.0, fit_s=45, hold_s=20)
    folder = write_case(case, tmp_path_factory.mktemp("concealed"))
    return folder, case.answer()["effects"][0]["parameters"]["time_constant"]


@pytest.fixture(scope="module")
def diagnosed(concealed: tuple[Path, float]) -> Path:
    """Run the diagnosis with the held-out recording; return the folder of its report."""
    folder = concealed[0]
    arguments = [str(folder / "fit.csv"), "--car", str(folder / "car.toml"), "--holdout", str(folder / "hold.csv")]
    few = ["--effects", "steering_lag", "steering_delay", "aerodynamic_drag"]
    assert run(["diagnose", *arguments, "--out", str(folder / "out"), "--decisions", *few]) == 0
    return folder / "out"


def test_concealed_servo_lag_is_named_first_and_estimated(concealed: tuple[Path, float], diagnosed: Path) -> None:
    report = json.loads((diagnosed / "report.json").read_text())
    assert report["verdict"] == "mismatch"
    first = report["effects"][0]
    assert first["id"] == "steering_lag"
    assert first["parameters"]["time_constant"]["value"] == pytest.approx(concealed[1], rel=0.05)
    held_out = report["fit"]["held_out"]
    assert report["fit"]["held_out_share"] is None
    assert "is held out: no fit uses it" not in (diagnosed / "report.html").read_text()
    assert held_out["with_effects"]["score"] < 0.5 * held_out["refit"]["score"]
    assert held_out["constant_velocity"]["score"] > held_out["refit"]["score"]
    for name in ("report.html", "report.rrd", "model.toml"):
        assert (diagnosed / name).stat().st_size > 0
    decisions = json.loads((diagnosed / "decisions.json").read_text())["decisions"]
    assert any(d["stage"] == "accept" and d["effect"] == "steering_lag" and d["passed"] for d in decisions)
    for d in decisions:
        assert passes(d, "", 0.0) == d["passed"], f"the recorded statistics give another decision: {d}"


@pytest.mark.slow
def test_servo_lag_is_named_first_of_the_whole_catalogue(concealed: tuple[Path, float]) -> None:
    folder = concealed[0]
    report = carlab.diagnose(folder / "fit.csv", folder / "car.toml", held_out=folder / "hold.csv")
    first = report.diagnosis.effects[0]
    assert (report.diagnosis.verdict, first.id) == ("mismatch", "steering_lag")
    assert first.parameters["time_constant"].value == pytest.approx(concealed[1], rel=0.05)


def replayed(recording: Path, car: str, part: str, capfd: pytest.CaptureFixture[str]) -> dict[str, list[float]]:
    """Return the errors and scores by row that ``carlab replay`` prints for one part."""
    capfd.readouterr()
    assert run(["replay", str(recording), "--car", car]) == 0
    text = capfd.readouterr().out
    assert part in text
    lines = text[text.index(part) :].splitlines()
    rows = [re.fullmatch(r"([a-z ]+?) +([\d. ]+)", line.strip()) for line in lines[3:7]]
    assert all(rows)
    return {row[1]: [float(v) for v in row[2].split()] for row in rows if row}


def assert_agree(row: list[float], errors: dict[str, float], digits: float = 6e-5) -> None:
    """Assert equality within 1 % or the last printed digit."""
    expected = [errors[name] for name in ("position_m", "yaw_rad", "vx", "vy", "yaw_rate")]
    assert row[:5] == pytest.approx(expected, rel=0.01, abs=digits)


def test_replay_of_the_model_prints_the_error_of_the_report(
    concealed: tuple[Path, float], diagnosed: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    held_out = json.loads((diagnosed / "report.json").read_text())["fit"]["held_out"]
    hold = concealed[0] / "hold.csv"
    rows = replayed(hold, str(diagnosed / "model.toml"), "whole recording", capfd)
    # The model corrects the initial states here, the car file in the report: scores differ by some hundredths.
    assert_agree(rows["model"], held_out["with_effects"], 2e-4)
    assert_agree(rows["constant velocity"], held_out["constant_velocity"])
    scores = [held_out[name]["score"] for name in ("with_effects", "constant_velocity")]
    assert [rows[name][5] for name in ("model", "constant velocity")] == pytest.approx(scores, rel=0.01, abs=0.03)
    rows = replayed(hold, str(concealed[0] / "car.toml"), "whole recording", capfd)
    assert_agree(rows["model"], held_out["nominal"])


def test_replay_scores_the_held_out_share_of_a_diagnosis(
    concealed: tuple[Path, float], capfd: pytest.CaptureFixture[str]
) -> None:
    fit, car = concealed[0] / "fit.csv", str(concealed[0] / "car.toml")
    report = carlab.diagnose(fit, car, stop=lambda: True)
    assert report.to_dict()["fit"]["held_out_share"] == 0.3
    assert "The last 30 % of each recording is held out: no fit uses it." in report.to_html()
    Diagnose((fit,))._print(report.diagnosis)
    assert "Error after 1.0 s in the last 30 % of each recording, which no fit uses" in capfd.readouterr().out
    rows = replayed(fit, car, "last 30 %", capfd)
    assert_agree(rows["model"], asdict(report.held_out["nominal"]))
    assert_agree(rows["constant velocity"], asdict(report.held_out["constant_velocity"]))


def test_replay_of_a_real_recording_prints_the_error_of_the_report(
    shared: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """The recordings of the ETH car have many kinds of faults; the given car file needs no fit."""
    recording = shared / "data" / "eth_rc_car" / "train_2.csv.gz"
    report = carlab.diagnose(recording, "eth_rc_car", stop=lambda: True)
    rows = replayed(recording, "eth_rc_car", "last 30 %", capfd)
    assert_agree(rows["model"], asdict(report.held_out["nominal"]))
    assert_agree(rows["constant velocity"], asdict(report.held_out["constant_velocity"]))


def test_parked_car_is_inconclusive_with_advice(
    concealed: tuple[Path, float], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    rows = (concealed[0] / "fit.csv").read_text().splitlines()
    first = rows[1].split(",")
    parked = [rows[0], *(",".join([r.split(",")[0], *first[1:4], "0", "0", "0", *r.split(",")[7:]]) for r in rows[1:])]
    path = tmp_path / "parked.csv"
    path.write_text("\n".join(parked) + "\n")
    assert run(["diagnose", str(path), "--out", str(tmp_path / "out")]) == 5
    assert "record a drive" in " ".join(capfd.readouterr().err.split())
    assert json.loads((tmp_path / "out" / "report.json").read_text())["verdict"] == "inconclusive"


@pytest.mark.parametrize("held_out", [False, True])
def test_short_recording_is_inconclusive(
    concealed: tuple[Path, float], tmp_path: Path, capfd: pytest.CaptureFixture[str], held_out: bool
) -> None:
    path = tmp_path / "short.csv"
    path.write_text("\n".join((concealed[0] / "fit.csv").read_text().splitlines()[:120]) + "\n")
    more = ["--holdout", str(concealed[0] / "hold.csv")] if held_out else []
    assert run(["diagnose", str(path), *more, "--out", str(tmp_path / "out")]) == 5
    assert "100 s" in " ".join(capfd.readouterr().err.split())
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["verdict"] == "inconclusive"
    assert report["effects"] == []


def test_recording_with_frequently_lost_tracking_is_faulty(
    concealed: tuple[Path, float], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """In a third of the rows motion capture confuses another body with the car."""
    rows = [r.split(",") for r in (concealed[0] / "fit.csv").read_text().splitlines()]
    column = rows[0].index("x")
    for k, row in enumerate(rows[1:]):
        if k % 12 < 4:
            row[column] = str(float(row[column]) + 2.0)
    path = tmp_path / "swapped.csv"
    path.write_text("\n".join(",".join(row) for row in rows) + "\n")
    assert run(["diagnose", str(path), "--out", str(tmp_path / "out")]) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["verdict"] == "data"
    assert report["effects"] == []
    assert "outliers" in {fault["id"] for fault in report["data_faults"]}
    assert "The recording is faulty" in " ".join(capfd.readouterr().err.split())


def test_constant_command_is_inconclusive_and_suggests_a_drive(
    concealed: tuple[Path, float], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    rows = [r.split(",") for r in (concealed[0] / "fit.csv").read_text().splitlines()]
    column = rows[0].index("throttle")
    path = tmp_path / "constant.csv"
    path.write_text("\n".join(",".join([*r[:column], "throttle" if k == 0 else "0.3", *r[column + 1 :]])
                              for k, r in enumerate(rows)) + "\n")  # fmt: skip
    assert run(["diagnose", str(path), "--out", str(tmp_path / "out")]) == 5
    assert "--policy throttle_steps" in " ".join(capfd.readouterr().err.split())


def test_fitted_recording_cannot_be_held_out(concealed: tuple[Path, float], tmp_path: Path) -> None:
    same = str(concealed[0] / "fit.csv")
    assert run(["diagnose", same, "--holdout", same, "--out", str(tmp_path / "out")]) == 2
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("share", [0.3, 0.5])
def test_held_out_share_is_not_fitted(
    concealed: tuple[Path, float], tmp_path: Path, capfd: pytest.CaptureFixture[str], share: float
) -> None:
    """The 1.5 s before it, the history of held-out windows, are not fitted either."""
    rows = [
        r for r in (concealed[0] / "fit.csv").read_text().splitlines() if r[0] == "t" or float(r.split(",")[0]) < 12
    ]
    path = tmp_path / "short.csv"
    path.write_text("\n".join(rows) + "\n")
    assert run(["diagnose", str(path), "--holdout-share", str(share), "--out", str(tmp_path / "out")]) == 5
    found = re.search(r"but only ([\d.]+) s without the last part", " ".join(capfd.readouterr().err.split()))
    assert found is not None
    assert float(found[1]) == pytest.approx((1.0 - share) * 12.0 - 1.5, abs=0.11)


@pytest.mark.parametrize("share", ["0", "0.6", "nan"])
def test_held_out_share_out_of_range_raises_an_error(
    concealed: tuple[Path, float], tmp_path: Path, capfd: pytest.CaptureFixture[str], share: str
) -> None:
    path = str(concealed[0] / "fit.csv")
    assert run(["diagnose", path, "--holdout-share", share, "--out", str(tmp_path / "out")]) == 2
    assert "give a share above 0 and at most 0.5" in " ".join(capfd.readouterr().err.split())
    assert not (tmp_path / "out").exists()


def test_share_together_with_held_out_recordings_raises_an_error(
    concealed: tuple[Path, float], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    paths = [str(concealed[0] / "fit.csv"), "--holdout", str(concealed[0] / "hold.csv")]
    assert run(["diagnose", *paths, "--holdout-share", "0.1", "--out", str(tmp_path / "out")]) == 2
    assert "has no effect together with held-out recordings" in " ".join(capfd.readouterr().err.split())
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("stated", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_unknown_latency_is_a_parameter_and_not_an_effect(
    concealed: tuple[Path, float], tmp_path: Path, stated: bool
) -> None:
    """Commands logged one row (33 ms) early and 12 ms of latency of the car give 45 ms."""
    rows = [r.split(",") for r in (concealed[0] / "fit.csv").read_text().splitlines()]
    first = rows[0].index("steering")
    late = [r[:first] + c[first:] for r, c in pairwise(rows[1:])]
    path = tmp_path / "late.csv"
    path.write_text("\n".join(",".join(r) for r in [rows[0], *late]) + "\n")
    car = (concealed[0] / "car.toml").read_text()
    latency_s = tomllib.loads(car)["mocap"]["latency"]
    text = car if stated else re.sub(r"(?m)^latency = .*\n", "", car)
    (tmp_path / "car.toml").write_text(text)
    report = carlab.diagnose(path, tmp_path / "car.toml", effects=("steering_lag", "mocap_latency"))
    assert ("mocap_latency" in report.effects) == stated
    assert ("mocap.latency" in report.parameters) != stated
    found = report.effects["mocap_latency"].parameters["latency"] if stated else report.parameters["mocap.latency"]
    assert found.unit == "s"
    assert found.value == pytest.approx(latency_s + 1 / 30, abs=0.005)
    assert report.effects["steering_lag"].parameters["time_constant"].value == pytest.approx(concealed[1], rel=0.1)
    if not stated:
        written = report.model.simulator
        assert written.mocap.latency_s == found.value
        assert written.parameter_std["mocap.latency"] == found.std
        assert not written.unknown
