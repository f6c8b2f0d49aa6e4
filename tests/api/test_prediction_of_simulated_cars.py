"""A simulator predicts the recordings of the simulated car that has its own parameters."""

import csv
from pathlib import Path

import numpy as np
import tomli_w

import carlab
from sim_backends.car_parameters import MocapParameters, SimulatorConfig


def test_latency_of_an_effect_is_that_of_the_recorded_states(tmp_path: Path) -> None:
    """Otherwise the states are 42 ms younger than the simulator assumes, and the position errs by 2 cm."""
    quiet = MocapParameters(position_std_m=1e-5, yaw_std_rad=1e-4)
    config = SimulatorConfig(mocap=quiet, effects={"mocap_latency": {"latency": 0.05}})
    car = tmp_path / "late.toml"
    car.write_text(tomli_w.dumps(config.to_tables()))
    run = carlab.drive(car, policy="figure_eight", ticks=240, out=tmp_path, rerun=False, picture=False)
    errors = carlab.predict(run.recordings, car, horizon_s=0.8).score.whole.errors["model"]
    assert len(errors) > 5
    assert np.sqrt(np.mean(errors**2, axis=0))[:3].max() < 5e-4, errors


def test_states_of_an_exported_recording_have_the_same_age(tmp_path: Path) -> None:
    """A pose of a row was exposed before the row; a pose with the time of its row counts the latency twice (2 cm)."""
    quiet = MocapParameters(position_std_m=1e-5, yaw_std_rad=1e-4, latency_s=0.05)
    car = tmp_path / "late.toml"
    car.write_text(tomli_w.dumps(SimulatorConfig(mocap=quiet).to_tables()))
    run = carlab.drive(car, policy="figure_eight", ticks=240, out=tmp_path, rerun=False, picture=False)
    exported = carlab.load(run.recordings[0]).save(tmp_path / "drive.csv")
    imported = carlab.load(exported).save(tmp_path / "imported.mcap")
    for path in (exported, imported):
        errors = carlab.predict(path, car, horizon_s=0.8).score.whole.errors["model"]
        assert len(errors) > 5
        assert np.sqrt(np.mean(errors**2, axis=0))[:3].max() < 3e-3, errors


def test_poses_alone_at_30_hz_are_predicted_to_the_noise_floor(tmp_path: Path) -> None:
    """With other velocities than those of the measurement model, a diagnosis names physics of a car that lacks none."""
    run = carlab.drive("sim", policy="excitation", ticks=900, seed=5, out=tmp_path, rerun=False, picture=False)
    exported = carlab.load(run.recordings[0]).save(tmp_path / "drive.csv")
    with exported.open(newline="") as file:
        rows = list(csv.DictReader(file))
    poses = tmp_path / "poses.csv"
    with poses.open("w", newline="") as file:
        columns = ("t", "x", "y", "yaw", "steering", "throttle")
        writer = csv.DictWriter(file, columns, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
    for path in (poses, exported):
        assert carlab.predict(path, "sim").summary["model"].score < 1.3
