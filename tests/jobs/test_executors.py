"""Test jobs on a local Ray cluster: files travel, a lost worker costs nothing, a proof equals that of this machine."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from carlab.benchmark.cases.proof_set import CaseSpec
from carlab.benchmark.proof.runner import Proof
from carlab.core.errors import ConfigError, DataError
from carlab.jobs.child_jobs import PYTHON, ChildJob, Executor, LocalExecutor, write_files
from carlab.jobs.ray_executor import RayExecutor

FAKE_DIAGNOSIS = (sys.executable, str(Path(__file__).parents[1] / "benchmark" / "fake_diagnosis.py"))


@pytest.fixture(scope="module")
def cluster() -> Iterator[RayExecutor]:
    pytest.importorskip("ray", reason="Ray is an extra: pip install -e '.[ray]'")
    with RayExecutor("local") as executor:
        yield executor


@pytest.fixture(scope="module", params=["local", "ray"])
def executor(request: pytest.FixtureRequest) -> Executor:
    return LocalExecutor() if request.param == "local" else request.getfixturevalue("cluster")


def never() -> bool:
    return False


def test_job_reads_its_input_files_and_returns_its_output_files(executor: Executor) -> None:
    program = (
        "import pathlib, sys, os; p = pathlib.Path; (p('out')).mkdir(); "
        "p('out/sum.txt').write_text(p('a.txt').read_text() + sys.stdin.read() + os.environ['C']); print('printed')"
    )
    job = ChildJob((PYTHON, "-c", program), 60.0, {"a.txt": b"a"}, ("out/sum.txt", "absent"), "b", {"C": "c"})
    done = executor.run(job, never)
    assert (done.end.exit_status, done.end.output.strip()) == (0, "printed")
    assert done.outputs == {"out/sum.txt": b"abc"}


def test_job_returns_all_files_of_a_folder(executor: Executor) -> None:
    program = "import pathlib; p = pathlib.Path('runs/a'); p.mkdir(parents=True); (p / 'b').write_text('c')"
    done = executor.run(ChildJob((PYTHON, "-c", program), 60.0, {"runs/d/e": b"f"}, ("runs",)), never)
    assert done.outputs == {"runs/a/b": b"c", "runs/d/e": b"f"}


def test_failed_job_states_its_last_line(executor: Executor) -> None:
    program = "import sys; print('first'); print('last'); sys.exit(3)"
    done = executor.run(ChildJob((PYTHON, "-c", program), 60.0), never)
    assert (done.end.exit_status, done.failure) == (3, "last")


@pytest.mark.parametrize("name", ["../outside", "/outside", "a/../../outside"])
def test_file_outside_its_folder_is_not_written(tmp_path: Path, name: str) -> None:
    (tmp_path / "job").mkdir()
    with pytest.raises(DataError, match="is not a path within the folder"):
        write_files(tmp_path / "job", {"inside": b"1", name: b"2"})
    assert [p.name for p in tmp_path.rglob("*")] == ["job"]


def test_job_that_takes_too_long_has_no_exit_status(executor: Executor) -> None:
    done = executor.run(ChildJob((PYTHON, "-c", "import time; time.sleep(60)"), 0.5), never)
    assert done.end.exit_status is None
    assert not done.end.abandoned


def test_abandoned_job_ends_at_once(executor: Executor) -> None:
    started = threading.Event()
    threading.Timer(0.5, started.set).start()
    done = executor.run(ChildJob((PYTHON, "-c", "import time; time.sleep(600)"), 600.0), started.is_set)
    assert done.end.abandoned


def test_job_of_a_killed_worker_runs_again(cluster: RayExecutor, tmp_path: Path) -> None:
    """The first attempt kills the worker process, which is the parent of the job."""
    mark = tmp_path / "attempted"
    program = (
        "import os, pathlib, signal, sys, time; mark = pathlib.Path(sys.argv[1])\n"
        "if not mark.exists(): mark.touch(); os.kill(os.getppid(), signal.SIGKILL); time.sleep(60)\n"
        "print('second attempt')"
    )
    done = cluster.run(ChildJob((PYTHON, "-c", program, str(mark)), 60.0), never)
    assert (done.end.exit_status, done.end.output.strip()) == (0, "second attempt")


def test_proof_on_ray_has_the_reports_and_the_seal_of_a_proof_on_this_machine(
    cluster: RayExecutor, tmp_path: Path
) -> None:
    spec = CaseSpec("null", 2, fit_s=8.0, hold_s=5.0)
    handed, reports = [], []
    for name, executor in (("here", LocalExecutor()), ("ray", cluster)):
        proof = Proof(tmp_path / name, [spec], command=FAKE_DIAGNOSIS, executor=executor)
        assert proof.make() is not None
        assert proof.diagnose()
        (case,) = proof.open_seal()
        handed.append({p.name: p.read_bytes() for p in (proof.root / "handed" / case).iterdir()})
        report = json.loads((proof.root / "reports" / case / "report.json").read_text())
        assert report["seen"]["files"] == ["car.toml", "fit.csv", "hold.csv", "out"]
        del report["seen"]["folder"]
        reports.append(report)
    assert handed[0] == handed[1]
    assert reports[0] == reports[1]


def test_unreachable_cluster_is_refused_with_the_remedy() -> None:
    pytest.importorskip("ray", reason="Ray is an extra: pip install -e '.[ray]'")
    for address in ("localhost:1", "ray://127.0.0.1:1"):
        with pytest.raises(ConfigError, match=r"no Ray cluster answers .* use --ray local"), RayExecutor(address):
            pass


def test_machine_with_another_version_is_refused(cluster: RayExecutor, monkeypatch: pytest.MonkeyPatch) -> None:
    """The sender states another version than the worker has."""
    monkeypatch.setattr("carlab.jobs.ray_executor.VERSION", "99.0")
    with pytest.raises(ConfigError, match=r"cluster has carlab .*, this one 99\.0; install the same version on both"):
        cluster.run(ChildJob((PYTHON, "-c", ""), 60.0), never)


def test_cluster_without_a_gpu_is_refused() -> None:
    pytest.importorskip("ray", reason="Ray is an extra: pip install -e '.[ray]'")
    program = "from carlab.jobs.ray_executor import RayExecutor\nRayExecutor('local', gpu=True).__enter__()"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    if done.returncode == 0:
        pytest.skip("this machine has a GPU")
    assert "ConfigError: --ray local: the cluster has no GPU; add a machine, or" in done.stderr


def test_lost_cluster_ends_the_command_with_the_remedy(cluster: RayExecutor, monkeypatch: pytest.MonkeyPatch) -> None:
    def wait(*arguments: object, **options: object) -> None:
        raise ConnectionError("the channel is closed")

    monkeypatch.setattr(cluster._ray, "wait", wait)
    with pytest.raises(DataError, match=r"does not answer any more \(the channel is closed\); finished cases are"):
        cluster.run(ChildJob((PYTHON, "-c", ""), 60.0), never)


def test_missing_ray_is_refused_with_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"pip install .* -e '\.\[ray\]'"):
        RayExecutor("local")
