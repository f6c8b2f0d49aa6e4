"""``carlab prove --set real``: recordings of a folder, a sealed run, and refusals in one sentence."""

import sys
from pathlib import Path

import pytest
from recorded_drives import drive

from carlab.api.cars import load_car
from carlab.cli.prove_real import car_path
from carlab.recording.csv.export import write_csv
from sim_backends import SimulatorConfig
from tests.helpers.command_line import Carlab

FAKE = Path(__file__).resolve().parents[1] / "benchmark" / "fake_comparison.py"


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recordings")
    for seed in (1, 2):
        write_csv(drive(SimulatorConfig(), 85.0, seed), folder / f"{seed}.csv")
    return folder


def test_recordings_of_a_folder_are_sealed_answered_and_scored(
    data: Path, tmp_path: Path, carlab: Carlab, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("carlab.cli.prove.CARLAB", (sys.executable, str(FAKE)))
    options = ("prove", "--set", "real", "--data", data, "--car", "rc_car", "--out", tmp_path / "proof", "--limit", 3)
    code, text = carlab(*options)
    assert code == 0, text
    assert text.index("sha256") < text.index("references diagnosed") < text.index("The seal is intact")
    assert (tmp_path / "proof" / "scores.json").exists()
    page = (tmp_path / "proof" / "results.md").read_text()
    assert "false alarms, untouched recordings" in page
    assert "answered steering_offset" in page, "the fake has answered"
    first = (tmp_path / "proof" / "seal.json").read_bytes()
    assert carlab(*options)[0] == 0
    assert (tmp_path / "proof" / "seal.json").read_bytes() == first


def test_missing_data_and_car_are_refused(data: Path, tmp_path: Path, carlab: Carlab) -> None:
    out = ("--out", tmp_path / "proof")
    for options, words in (
        (("--car", "rc_car"), "--data"),
        (("--data", data), "--car"),
        (("--data", data, "--car", "no_such_car"), "no_such_car"),
        (("--data", tmp_path / "absent", "--car", "rc_car"), "is not a folder"),
    ):
        code, text = carlab("prove", "--set", "real", *out, *options)
        assert code == 2
        assert words in text
    assert "Traceback" not in text


@pytest.mark.parametrize("car", ["sim", "rc_car"])
def test_named_car_becomes_a_file_with_its_parameters(car: str, tmp_path: Path) -> None:
    path = car_path(car, tmp_path / "proof")
    assert load_car(path).simulator == load_car(car).simulator
