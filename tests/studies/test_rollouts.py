"""Rollout study: scores against closed forms, and the command on drives of a simulated car with a linear model."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from linear_cars import linear_car

import carlab.studies.rollouts as study
from carlab.cli import run
from carlab.core.episode_data import EpisodeData
from carlab.prediction.learned import recorded_windows
from carlab.studies.rollouts import DISTURBED, INDEPENDENT, energy_score, folds, folds_of_rows
from learning.transitions import Transitions, transitions_of
from learning.world.car_dynamics import CarDynamics
from learning.world.disturbance import DisturbanceProcess
from learning.world.drive_windows import DriveWindows
from sim_backends import SimulatorConfig
from tests.helpers.recorded_drives import PERIOD_S, drive

pytestmark = pytest.mark.usefixtures("few_correlation_times")


def write_drive(path: Path, episode: EpisodeData) -> None:
    """Write a recording as CSV."""
    states, commands = episode.states[:-1], episode.sent
    table = np.column_stack([episode.times_s[:-1], states, commands])
    np.savetxt(path, table, "%.6f", ",", header="t,x,y,yaw,vx,vy,yaw_rate,steering,throttle", comments="")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a drive to fit and a held-out drive."""
    data = tmp_path_factory.mktemp("study") / "data"
    data.mkdir()
    for name, seconds, seed in (("a.csv", 120.0, 1), ("b.csv", 60.0, 2)):
        write_drive(data / name, drive(SimulatorConfig(), seconds, seed))
    return data


def test_study_prints_calibrated_bands_of_a_wrong_model(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Errors of a wrong model last. With redrawn noise its bands are too narrow, with the disturbance they are not."""
    fitted_rows = []

    def fit(case: object, rows: Transitions, *others: object) -> CarDynamics:
        fitted_rows.append(len(rows))
        return linear_car(case, rows, *others)

    monkeypatch.setattr(study, "fit_rows", fit)
    out = folder.parent / "figures.json"
    command = ["bench", "rollouts", "--data", str(folder), "--rows", "200", "--seeds", "1", "--history", "3"]
    assert run([*command, "--car", "rc_car", "--out", str(out)]) == 0
    assert max(fitted_rows[:3]) < 0.75 * fitted_rows[3], "each fold is held out"
    scores = json.loads(out.read_text())["scores"]
    coverage = {(s["model"], s["horizon_s"]): s["coverage"] for s in scores}
    for horizon_s in (0.5, 1.0):
        ahead, left = coverage[INDEPENDENT, horizon_s][:2]
        assert min(ahead, left) < 0.8
        for covered in coverage[DISTURBED, horizon_s][:2]:
            assert 0.82 <= covered <= 0.98
    rms = {s["model"]: s["position_rms_m"] for s in scores if s["horizon_s"] == 1.0}
    assert rms[DISTURBED] == pytest.approx(rms[INDEPENDENT], rel=0.1)
    assert f"{rms[DISTURBED]:.3f}" in capsys.readouterr().out


def test_particles_of_the_study_are_those_of_the_option(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kinds = []

    def fit(case: object, rows: Transitions, count: int, seed: int, settings: study.FitSettings) -> CarDynamics:
        kinds.append(settings.correct_simulator)
        return linear_car(case, rows, count, seed)

    monkeypatch.setattr(study, "fit_rows", fit)
    monkeypatch.setattr(study, "fit_disturbance", lambda errors: DisturbanceProcess((0.5,) * 3, (0.4,) * 3, PERIOD_S))
    monkeypatch.setattr(study, "N_SAMPLES", 20)
    command = ["bench", "rollouts", "--data", str(folder), "--rows", "200", "--seeds", "1", "--history", "3"]
    for option, expected in (([], False), (["--particles", "simulator"], True)):
        kinds.clear()
        assert run([*command, "--car", "rc_car", *option]) == 0
        assert kinds == [expected] * 4


def test_fit_to_all_rows_has_the_windows_of_its_rows(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Windows of a held-out fold would start at states that are not among the rows."""
    numbers = []

    def fit(car: CarDynamics, windows: DriveWindows, rows: Transitions, *, seed: int) -> CarDynamics:
        known = {tuple(row) for row in np.round(rows.inputs[:, :3], 4)}
        starts = [tuple(row) for row in np.round(windows.velocities.double().numpy(), 4)]
        assert np.mean([start in known for start in starts]) > 0.95
        numbers.append((len(rows), len(windows)))
        return car

    monkeypatch.setattr(study, "fit_rows", linear_car)
    monkeypatch.setattr(study, "fit_rollouts", fit)
    monkeypatch.setattr(study, "fit_disturbance", lambda errors: DisturbanceProcess((0.5,) * 3, (0.4,) * 3, PERIOD_S))
    monkeypatch.setattr(study, "N_SAMPLES", 20)
    command = ["bench", "rollouts", "--data", str(folder), "--rows", "all", "--seeds", "1", "--history", "3"]
    assert run([*command, "--car", "rc_car"]) == 0
    (*folds, (rows, windows)) = numbers
    assert [n / rows for n, _ in folds] == pytest.approx([2 / 3] * 3, abs=0.05)
    assert max(n for _, n in folds) < 0.67 * windows, "windows that overlap a held-out block are left out"
    assert f"{rows} (all)" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "bench rollouts needs --data FOLDER"),
        (["--data", "nowhere"], "--data nowhere is not a folder"),
        (
            ["--data", "data", "--rows", "100000", "--history", "3", "--car", "rc_car"],
            "rows, not 100000; give fewer with --rows.",
        ),
    ],
)
def test_bad_input_is_refused_in_one_sentence(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    monkeypatch.chdir(folder.parent)
    assert run(["bench", "rollouts", *options]) != 0
    error = " ".join(capsys.readouterr().err.split())
    assert message in error
    assert "Traceback" not in error


def test_energy_score_of_a_gaussian_is_the_closed_form() -> None:
    """In one dimension it is the CRPS (Gneiting and Raftery 2007, equation 21)."""
    errors = 2.0 * np.random.default_rng(0).normal(size=(4000, 1, 1)) - 1.0  # a forecast of std 2, half a std too low
    z = 0.5
    density, below = math.exp(-0.5 * z**2) / math.sqrt(2 * math.pi), 0.5 * (1 + math.erf(z / math.sqrt(2)))
    crps = 2.0 * (z * (2 * below - 1) + 2 * density - 1 / math.sqrt(math.pi))
    assert energy_score(errors) == pytest.approx(crps, rel=0.05)


def test_no_row_of_a_fit_lies_in_a_held_out_window_of_a_recording_with_a_gap() -> None:
    """Rows and windows of a recording that paused for 25 s have the folds of the same recorded times."""
    first, second = drive(SimulatorConfig(), 60.0, 3), drive(SimulatorConfig(), 60.0, 4)
    gap = EpisodeData(
        np.concatenate([first.times_s[:-1], second.times_s + first.times_s[-1] + 25.0]),
        np.concatenate([first.states[:-1], second.states]),
        *(np.concatenate([first.sent, second.sent]),) * 2, np.zeros(first.ticks + second.ticks),
    )  # fmt: skip
    rows, windows = transitions_of([gap], 3), recorded_windows([gap], 1.0, 0.25)
    t_s = gap.times_s[rows.tick] - gap.times_s[0]
    of_rows = folds_of_rows(rows, [gap])
    starts, ends = folds(windows.recording, windows.t0_s), folds(windows.recording, windows.t0_s + 1.0)
    checked = 0
    for fold in range(3):
        for start_s in windows.t0_s[(starts == fold) & (ends == fold)]:
            inside = (t_s >= start_s) & (t_s < start_s + 1.0)
            assert (of_rows[inside] == fold).all()
            checked += 1
    assert checked > 100


def test_folds_are_blocks_of_time_in_turn() -> None:
    found = folds(np.array([0, 0, 0, 0, 1]), np.array([0.0, 19.9, 20.1, 60.5, 0.0]))
    assert found.tolist() == [0, 0, 1, 0, 1]
