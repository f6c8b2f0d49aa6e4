"""``carlab bench priors`` from the command line."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tomli_w

from carlab.benchmark.world.measurement import COLUMNS, write_csv
from carlab.core.quantities import Action, CarState
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.plant import Plant
from tests.helpers.command_line import Carlab

CAR = SimulatorConfig.from_preset()


def record(path: Path, seed: int, ticks: int = 180) -> None:
    """Record a drive of the simulated car without extra effects as CSV."""
    rng = np.random.default_rng(seed)
    plant, period_s, rows = Plant(CAR), CAR.control_period_s, []
    plant.reset(CarState(0.0, 0.0, 0.0, 1.0, 0.0, 0.0), 0.0)
    command = (0.0, 0.0)
    for tick in range(ticks):
        if tick % 6 == 0:
            command = (float(rng.uniform(-1, 1)), float(rng.uniform(0.1, 0.6)))
        state = plant.advance(tick * period_s)
        noise = rng.normal(size=6) * [3e-4, 3e-4, 1e-3, 5e-3, 5e-3, 0.02]
        rows.append([tick * period_s, *(state.to_array() + noise), *command])
        plant.command(tick * period_s, Action(*command))
    write_csv(path, dict(zip(COLUMNS, np.array(rows).T, strict=True)))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    data = tmp_path / "data"
    data.mkdir()
    record(data / "1.csv", 1)
    record(data / "2.csv", 2)
    return data


@pytest.fixture
def model(tmp_path: Path) -> Path:
    path = tmp_path / "found" / "model.toml"
    path.parent.mkdir()
    found = replace(CAR.with_values({"effects.motor_lag.time_constant": 0.02}), parameter_std={"motor.drive_gain": 0.2})
    path.write_text(tomli_w.dumps(found.to_tables()))
    return path


@pytest.mark.usefixtures("short_inference")
def test_recordings_are_learned_with_four_priors(carlab: Carlab, folder: Path, model: Path, tmp_path: Path) -> None:
    out = tmp_path / "study.json"
    arguments = ("--rows", 20, "--seeds", 1, "--history", 3, "--steps", 30, "--out", out)
    code, text = carlab("bench", "priors", "--data", folder, "--car", "rc_car", "--diagnosed", model, *arguments)
    assert code == 0, text
    assert "Held out: 2.csv." in text
    study = json.loads(out.read_text())
    names = ["none (gp-posterior)", "kinematic", "nominal", "diagnosed"]
    assert [(r["method"], r["rows"], r["seeds"]) for r in study["rows"]] == [(name, 20, 1) for name in names]
    for row in study["rows"]:
        assert f"{row['nll']:.2f}" in text
        assert np.isfinite([row["nll"], row["calibration"]]).all()
    assert out.with_suffix(".png").stat().st_size > 10_000


@pytest.mark.slow
def test_two_concealed_effects_are_diagnosed_and_used_as_a_prior(carlab: Carlab, tmp_path: Path) -> None:
    out = tmp_path / "study.json"
    arguments = ("--recorded-s", 40, 20, "--rows", 20, "--seeds", 1, "--history", 4, "--steps", 30, "--out", out)
    code, text = carlab("bench", "priors", *arguments)
    assert code == 0, text
    assert "Concealed in the simulated car: motor lag and mocap yaw misalignment" in text
    assert {p.name for p in (tmp_path / "study" / "recordings").iterdir()} == {
        "car.toml", "1_training.csv", "2_held_out.csv",
    }  # fmt: skip
    report = json.loads((tmp_path / "study" / "diagnosis" / "report.json").read_text())
    assert [Path(use["path"]).name for use in report["recordings"]] == ["1_training.csv"]
    assert len(json.loads(out.read_text())["scores"]) == 4


def test_invalid_studies_are_reported(carlab: Carlab, folder: Path, model: Path, tmp_path: Path) -> None:
    def error_of(*arguments: object) -> str:
        code, text = carlab("bench", "priors", *arguments)
        assert code == 2
        return text

    assert "is not a folder" in error_of("--data", tmp_path / "none")
    assert "no pair 7; choose 1 to 3" in error_of("--pair", 7)
    assert "--rows 0: give a number above zero" in error_of("--rows", 0)
    options = ("--data", folder, "--car", "rc_car", "--diagnosed")
    assert "none.toml" in error_of(*options, tmp_path / "none.toml")
    recordings = [
        {"path": "2.csv", "sha256": hashlib.sha256((folder / "2.csv").read_bytes()).hexdigest(), "role": "held out"}
    ]
    (model.parent / "report.json").write_text(json.dumps({"recordings": recordings}))
    assert "was diagnosed with 2.csv, which is held out here" in error_of(*options, model)
    (model.parent / "report.json").write_text(json.dumps({"recordings": []}))
    slow = tmp_path / "slow.toml"
    slow.write_text(tomli_w.dumps(replace(CAR, control_period_s=0.05).to_tables()))
    assert "control_period of the prior is 0.05 s, that of a recording is 0.033" in error_of(
        "--data", folder, "--car", slow, "--diagnosed", model
    )
    assert "prior is 0.05 s, that of the car's file is 0.033" in error_of(*options, slow, "--history", 3)
    (folder / "2.csv").unlink()
    code, text = carlab("bench", "priors", "--data", folder)
    assert code == 1
    assert "has 1 recordings; add some (at least 2)" in text
