"""The prior with measured curves: its recordings, its simulator, and its place in the rollout study."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from linear_cars import linear_car

import carlab.studies.curve_prior as curve_prior
import carlab.studies.rollouts as study
from carlab.cli import bench_jobs, run
from carlab.cli.bench_jobs import StudyJob
from carlab.core.episode_data import EpisodeData
from carlab.studies.curve_prior import unbroken_parts
from carlab.studies.regression.recordings import RecordedCase
from carlab.studies.rollouts import RolloutScore
from learning.priors.simulator_model import CarModel
from learning.world.car_dynamics import CarDynamics
from learning.world.disturbance import DisturbanceProcess
from sim_backends import SimulatorConfig
from tests.helpers.recorded_drives import PERIOD_S, drive
from tests.studies.test_rollouts import write_drive

pytestmark = pytest.mark.usefixtures("few_correlation_times")
SECONDS = 120.0
BRAKING = {f"effects.drive_map.value_6_{k}": -1.0 for k in range(11)}
"""One metre per second squared less with the throttle released, at any speed."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a drive to fit and a held-out drive."""
    data = tmp_path_factory.mktemp("curves") / "data"
    data.mkdir()
    for name, seconds, seed in (("a.csv", SECONDS, 1), ("b.csv", 40.0, 2)):
        write_drive(data / name, drive(SimulatorConfig(), seconds, seed))
    return data


def test_each_fold_has_curves_of_the_other_blocks(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Curves that are fitted to a held-out block would make the errors of the cross-validation too small."""
    fitted: list[Sequence[EpisodeData]] = []
    priors: list[CarModel] = []

    def simulator(episodes: Sequence[EpisodeData], nominal: SimulatorConfig) -> SimulatorConfig:
        fitted.append(episodes)
        return nominal.with_values(BRAKING)

    def fit(case: RecordedCase, *others: object) -> CarDynamics:
        assert isinstance(case.prior, CarModel)
        priors.append(case.prior)
        return linear_car(case, *others)

    monkeypatch.setattr(curve_prior, "simulator_with_curves", simulator)
    monkeypatch.setattr(study, "fit_rows", fit)
    monkeypatch.setattr(study, "fit_rollouts", lambda car, windows, rows, *, seed: car)
    monkeypatch.setattr(study, "fit_disturbance", lambda errors: DisturbanceProcess((0.5,) * 3, (0.4,) * 3, PERIOD_S))
    monkeypatch.setattr(study, "N_SAMPLES", 20)
    out = folder.parent / "figures.json"
    command = ["bench", "rollouts", "--data", str(folder), "--seeds", "2", "--history", "3", "--car", "rc_car"]
    assert run([*command, "--curves", "--out", str(out)]) == 0
    assert {score["all_rows"] for score in json.loads(out.read_text())["scores"]} == {True}
    assert len(fitted) == 4, "a second seed has the same curves"
    for fold, parts in enumerate(fitted[:3]):
        times_s = np.concatenate([part.times_s[:-1] for part in parts])
        seconds = np.bincount((times_s // study.BLOCK_S).astype(int), minlength=6) * PERIOD_S
        expected = [0.0 if block % 3 == fold else study.BLOCK_S for block in range(6)]
        assert seconds == pytest.approx(expected, abs=2 * PERIOD_S)
    assert sum(part.ticks for part in fitted[3]) == pytest.approx(SECONDS / PERIOD_S, abs=2)
    assert len(priors) == 8
    for prior in priors:
        values = prior.config.values()
        assert all(values[name] == value for name, value in BRAKING.items())
        assert prior.size == 0
        assert prior.history == 3


def test_parallel_jobs_have_curves_too(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    commands: list[tuple[str, ...]] = []

    def run_jobs(jobs: Sequence[StudyJob[RolloutScore]], *others: object) -> tuple[list[RolloutScore], bool]:
        commands.extend(job.job.command for job in jobs)
        return [], False

    monkeypatch.setattr(bench_jobs, "run_jobs", run_jobs)
    command = ["bench", "rollouts", "--data", str(folder), "--seeds", "2", "--history", "3", "--car", "rc_car"]
    assert run([*command, "--curves", "--jobs", "2"]) == 0
    assert len(commands) == 2
    for own in commands:
        assert "--curves" in own
        assert own[own.index("--rows") + 1] == "all"


def test_number_of_rows_with_curves_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["bench", "rollouts", "--data", str(folder), "--rows", "200", "--history", "3", "--car", "rc_car"]
    assert run([*command, "--curves"]) != 0
    error = " ".join(capsys.readouterr().err.split())
    assert "Measured curves are fitted to whole recordings, not to random rows; use --rows all." in error


def test_curves_have_no_effect_in_another_study(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["bench", "regression", "--curves"]) != 0
    assert "--curves has no effect in 'bench regression" in " ".join(capsys.readouterr().err.split())


def test_parts_of_an_episode_have_their_commands_and_the_states_around_them() -> None:
    count = 10
    states = np.arange(6.0 * (count + 1)).reshape(count + 1, 6)
    times_s = 0.1 * np.arange(count + 1)
    commands = np.arange(2.0 * count).reshape(count, 2)
    poses = np.column_stack([0.05 * np.arange(2 * count + 1), np.zeros((2 * count + 1, 3))])
    extra = {"segment": np.arange(count + 1.0)}
    episode = EpisodeData(times_s, states, commands, commands, np.zeros(count), poses, {"car": "a"}, extra)
    kept = np.array([True, True, False, False, False, True, True, True, False, True])
    first, second, last = unbroken_parts(episode, kept)
    assert [part.ticks for part in (first, second, last)] == [2, 3, 1]
    assert second.times_s.tolist() == times_s[5:9].tolist()
    assert second.states.tolist() == states[5:9].tolist()
    assert second.sent.tolist() == commands[5:8].tolist()
    assert second.extra["segment"].tolist() == [5.0, 6.0, 7.0, 8.0]
    assert second.poses[:, 0] == pytest.approx(np.arange(0.5, 0.81, 0.05))
    assert last.states.tolist() == states[9:].tolist()
    assert unbroken_parts(episode, np.zeros(count, dtype=bool)) == []
