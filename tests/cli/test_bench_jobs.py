"""``carlab bench --jobs`` and ``--ray``: the scores of one process, and a lost worker that costs its part only."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
import tyro
from forked_jobs import run_forked_job
from linear_cars import linear_car

from carlab.cars import load_car_file
from carlab.cli import _verbs
from carlab.jobs.child_jobs import ChildJob, Executor, JobEnd
from carlab.jobs.child_processes import ChildEnd
from sim_backends import SimulatorConfig
from tests.helpers.command_line import Carlab
from tests.helpers.recorded_drives import drive

REGRESSION = ("bench", "regression", "--case", "1d", "--seeds", 2, "--methods", "SysID", "gp-posterior", "--steps", 40)


@dataclass
class FakeExecutor:
    """Runs no job of a seed in ``lost`` and, after ``abandoned`` jobs, abandons; runs the others on this machine."""

    lost: tuple[str, ...] = ()
    abandoned: int = 1000
    jobs: int = 1
    seen: list[ChildJob] = field(default_factory=list)
    run_here: Callable[[ChildJob, Callable[[], bool]], JobEnd] = run_forked_job

    def run(self, job: ChildJob, abandon: Callable[[], bool]) -> JobEnd:
        self.seen.append(job)
        if len(self.seen) > self.abandoned:
            return JobEnd(ChildEnd(None, 0.0, "abandoned", 0.0, abandoned=True))
        if given(job, "--first-seed") in self.lost or given(job, "--name") in self.lost:
            return JobEnd(ChildEnd(None, 1.0, "worker lost: the machine is gone", 0.0))
        return self.run_here(job, abandon)


def given(job: ChildJob, option: str) -> str:
    """Value of an option of a job's command; empty without it."""
    return job.command[job.command.index(option) + 1] if option in job.command else ""


@pytest.fixture
def executor(monkeypatch: pytest.MonkeyPatch) -> FakeExecutor:
    """The executor that every ``--ray`` gets."""
    fake = FakeExecutor()
    monkeypatch.setattr("carlab.cli.bench_jobs.chosen_executor", lambda ray, jobs, gpu: nullcontext(fake))
    return fake


@pytest.fixture(scope="module")
def cluster() -> Any:
    pytest.importorskip("ray", reason="Ray is an extra: pip install -e '.[ray]'")
    from carlab.jobs.ray_executor import RayExecutor

    with RayExecutor("local") as executor:
        yield executor


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a drive to fit and a held-out drive."""
    folder = tmp_path_factory.mktemp("study") / "data"
    folder.mkdir()
    for name, seconds, seed in (("a.csv", 60.0, 1), ("b.csv", 30.0, 2)):
        episode = drive(SimulatorConfig(), seconds, seed)
        table = np.column_stack([episode.times_s[:-1], episode.states[:-1], episode.sent])
        header = "t,x,y,yaw,vx,vy,yaw_rate,steering,throttle"
        np.savetxt(folder / name, table, "%.6f", ",", header=header, comments="")
    return folder


def scores_in(path: Path) -> list[dict[str, Any]]:
    """Scores of a file without the durations."""
    return [{k: v for k, v in score.items() if k != "seconds"} for score in json.loads(path.read_text())["scores"]]


def scores_here(folder: Path) -> list[dict[str, Any]]:
    """Scores of the study in this process."""
    from carlab.cli import run

    out = folder / "out.json"
    assert run([str(word) for word in (*REGRESSION, "--out", out)]) == 0
    return scores_in(out)


@pytest.fixture(scope="module")
def regression_scores(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    return scores_here(tmp_path_factory.mktemp("here"))


def assert_equal_scores(found: list[dict[str, Any]], expected: list[dict[str, Any]]) -> None:
    assert [(s["method"], s["rows"], s["seed"]) for s in found] == [
        (s["method"], s["rows"], s["seed"]) for s in expected
    ]
    for one, other in zip(found, expected, strict=True):
        assert one["nll"] == pytest.approx(other["nll"], rel=1e-5)
        assert one["rmse"] == pytest.approx(other["rmse"], rel=1e-5)


@pytest.mark.slow
def test_parallel_jobs_have_the_scores_of_one_process_in_the_same_order(
    carlab: Carlab, regression_scores: list[dict[str, Any]], tmp_path: Path
) -> None:
    """One method: each job is a program that imports everything; the tests below run both methods in forks."""
    out = tmp_path / "out.json"
    one_method = [word for word in REGRESSION if word != "SysID"]
    assert carlab(*one_method, "--out", out, "--jobs", 2)[0] == 0
    assert_equal_scores(scores_in(out), [s for s in regression_scores if s["method"] == "gp-posterior"])
    assert out.with_suffix(".png").is_file()


def test_jobs_on_ray_have_the_scores_of_one_process(
    carlab: Carlab,
    executor: FakeExecutor,
    cluster: Executor,
    regression_scores: list[dict[str, Any]],
    tmp_path: Path,
) -> None:
    executor.run_here, executor.jobs = cluster.run, 2
    out = tmp_path / "out.json"
    assert carlab(*REGRESSION, "--out", out, "--ray", "local")[0] == 0
    assert_equal_scores(scores_in(out), regression_scores)
    assert json.loads(out.read_text())["device"] == "cpu of Ray local"


@pytest.mark.usefixtures("short_inference", "short_identification")
def test_lost_worker_costs_its_fits_and_nothing_else(carlab: Carlab, executor: FakeExecutor, tmp_path: Path) -> None:
    executor.lost = ("1",)
    out = tmp_path / "jobs.json"
    code, text = carlab(*REGRESSION, "--out", out, "--ray", "local")
    assert code == 1
    assert "SysID, 2 rows, seed 1 failed: worker lost: the machine is gone" in text
    scores = scores_in(out)
    expected = [s for s in scores_here(tmp_path) if s["seed"] == 0]
    assert_equal_scores([s for s in scores if s["failed"] is None], expected)
    assert [(s["method"], s["seed"], s["nll"]) for s in scores if s["failed"] is not None] == [
        ("SysID", 1, None),
        ("gp-posterior", 1, None),
    ]


def test_stopped_study_keeps_the_finished_fits(carlab: Carlab, executor: FakeExecutor, tmp_path: Path) -> None:
    executor.abandoned = 1
    out = tmp_path / "out.json"
    code, text = carlab(*REGRESSION, "--out", out, "--ray", "local")
    assert code == 130
    assert "interrupted" in text
    assert [(s["method"], s["seed"]) for s in scores_in(out)] == [("SysID", 0)]


@pytest.mark.usefixtures("short_inference")
def test_job_of_recordings_gets_its_files_only(
    carlab: Carlab, executor: FakeExecutor, recordings: Path, tmp_path: Path
) -> None:
    """Real recordings: the priors study with one job for each seed; a copy of each file travels."""
    model = tmp_path / "model.toml"

    model.write_text(tomli_w.dumps(load_car_file(Path("rc_car")).simulator.to_tables()))
    out, alone = tmp_path / "out.json", tmp_path / "alone.json"
    study = ("bench", "priors", "--data", recordings, "--car", "rc_car", "--diagnosed", model, "--rows", 20)
    study += ("--seeds", 1, "--first-seed", 3, "--history", 3, "--steps", 30)
    assert carlab(*study, "--out", alone)[0] == 0
    assert carlab(*study, "--out", out, "--ray", "local")[0] == 0
    (job,) = executor.seen
    assert set(job.inputs) == {"data/a.csv", "data/b.csv", "model.toml"}
    assert job.inputs["data/a.csv"] == (recordings / "a.csv").read_bytes()
    assert str(tmp_path) not in " ".join(job.command)
    assert len(scores_in(out)) == 4
    assert_equal_scores(scores_in(out), scores_in(alone))


def test_rollouts_of_a_lost_worker_are_missing_and_the_others_are_written(
    carlab: Carlab, executor: FakeExecutor, recordings: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The jobs return figures that this process computes with a quick fit; their commands are checked apart."""
    monkeypatch.setattr("carlab.studies.rollouts.fit_rows", linear_car)
    monkeypatch.setattr("learning.world.disturbance_fit.CORRELATION_TIMES_S", (0.4,))
    out, alone = tmp_path / "out.json", tmp_path / "alone.json"
    study = ("bench", "rollouts", "--data", recordings, "--car", "rc_car", "--rows", 100, "--history", 3)
    assert carlab(*study, "--out", alone, "--seeds", 1)[0] == 0
    files = {"figures.json": alone.read_bytes()}
    executor.run_here = lambda job, abandon: JobEnd(ChildEnd(0, 1.0, "", 0.0), files)
    executor.lost = ("1",)
    code, text = carlab(*study, "--out", out, "--seeds", 2, "--ray", "local")
    assert code == 1
    assert "100 rows, seed 1 failed: worker lost" in text
    found, expected = (json.loads(path.read_text())["scores"] for path in (out, alone))
    assert len(found) == 6
    assert found == expected
    commands = [shlex.split(shlex.join(job.command))[3:] for job in executor.seen]
    parsed = [tyro.extras.subcommand_cli_from_dict(_verbs(), args=command) for command in commands]
    assert [(c.rows, c.seeds, c.first_seed, c.history) for c in parsed] == [((100,), 1, 0, 3), ((100,), 1, 1, 3)]
    assert all(str(c.data) == "data" and str(c.out) == "figures.json" for c in parsed)


def test_parking_runs_come_back_into_one_folder_and_a_lost_one_is_driven_by_the_next_command(
    carlab: Carlab, executor: FakeExecutor, tmp_path: Path
) -> None:
    runs, out = tmp_path / "runs", tmp_path / "out.json"
    study = ("bench", "parking", "--methods", "gp-posterior", "--updates", 40, "--steps", 50, "--runs", runs)
    study += ("--out", out, "--ray", "local")
    executor.lost = ("gp-posterior-seed1",)
    code, text = carlab(*study, "--seeds", 2, "--episodes", 1)
    assert code == 1
    assert "gp-posterior, seed 1 failed: worker lost" in text
    (folder,) = runs.iterdir()
    assert folder.name.endswith("_gp-posterior-seed0")
    first_model = (folder / "models" / "0001" / "policy.npz").read_bytes()
    assert [(r["seed"], len(r["episodes"])) for r in json.loads(out.read_text())["runs"]] == [(0, 1)]

    executor.lost, executor.seen = (), []
    assert carlab(*study, "--seeds", 1, "--episodes", 1)[0] == 0
    assert executor.seen == [], "the run is complete"
    assert carlab(*study, "--seeds", 1, "--episodes", 2)[0] == 0
    assert [given(job, "--resume") for job in executor.seen] == [f"runs/{folder.name}"]
    assert [p.name for p in (folder / "episodes").glob("*.mcap")] == ["0001.mcap", "0002.mcap"]
    assert (folder / "models" / "0001" / "policy.npz").read_bytes() == first_model, "the run was resumed"


def test_ray_and_jobs_together_are_refused(carlab: Carlab) -> None:
    code, text = carlab(*REGRESSION, "--jobs", 2, "--ray", "local")
    assert code == 2
    assert "--ray replaces --jobs; leave one of them out." in text
    code, text = carlab("bench", "realcars", "--ray", "local")
    assert code == 2
    assert "--ray has no effect in 'bench realcars'" in text
