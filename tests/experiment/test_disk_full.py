"""A disk that fills up while a car drives: the run ends, one sentence names the disk, and no traceback appears."""

from __future__ import annotations

import errno
import json
import logging
import os
from pathlib import Path
from typing import Any

import pytest

from carlab.cars import choose_car
from carlab.core.documents import EpisodeEnded, Tick
from carlab.core.errors import DataError
from carlab.core.outcome import EndReason
from carlab.core.safety import SafetyEnvelope
from carlab.core.task import ParkingTask
from carlab.experiment.campaign.campaign import Campaign
from carlab.experiment.campaign.training import model_folder
from carlab.experiment.campaign.training_plan import TrainingPlan
from carlab.experiment.episodes.hooks import RunHooks
from carlab.experiment.episodes.result import EpisodeResult
from carlab.experiment.episodes.scripted_policies import NeutralPolicy
from carlab.experiment.episodes.session import Session
from carlab.recording.mcap.sink import McapSink
from carlab.recording.run_folder import RunDirectory
from drivers.emulators.command_log import CommandLog
from sim_backends.simulated_car import SimulatedCar

FULL = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
needs_dev_full = pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")


def fill_disk(monkeypatch: pytest.MonkeyPatch, failing: type[Tick] | type[EpisodeEnded]) -> None:
    """Let the MCAP sink fail with ENOSPC when it writes a document of type ``failing``."""
    write = McapSink._write

    def failing_write(self: McapSink, item: Any) -> None:
        if isinstance(item, failing):
            raise FULL
        write(self, item)

    monkeypatch.setattr(McapSink, "_write", failing_write)


@pytest.mark.parametrize("failing", [Tick, EpisodeEnded])
def test_recording_that_cannot_be_finished_ends_the_run(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    failing: type[Tick] | type[EpisodeEnded],
) -> None:
    fill_disk(monkeypatch, failing)
    run = RunDirectory.create(tmp_path, "full")
    with SimulatedCar() as car:
        session = Session(
            car, NeutralPolicy(), ParkingTask(), SafetyEnvelope(), run, 1 / 30, max_ticks=400, record_rerun=False,
            hooks=RunHooks(),
        )  # fmt: skip
        (result,) = session.drive(3)
    assert result.reason is EndReason.RECORDER_ERROR
    assert result.data.metadata["end_reason"] == "RECORDER_ERROR"
    sentence = result.data.metadata["end_detail"]
    assert f"{run.episodes / '0001.mcap'} could not be written because the disk is full; free some space" in sentence
    assert "MB free) and start again." in sentence
    assert "\n" not in sentence
    assert "Traceback" not in capfd.readouterr().err
    assert not (run.episodes / "0001.mcap").exists()


def test_learning_run_ends_with_one_sentence_when_the_disk_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fill_disk(monkeypatch, EpisodeEnded)
    run, choice = RunDirectory.create(tmp_path, "full"), choose_car("sim", seed=0)
    plan = TrainingPlan("", ticks=20)
    model_folder(run.models, 1).mkdir(parents=True)
    figures = {
        "episode": 1,
        "rows": 0,
        "updates": 1,
        "return_in_model": 0.0,
        "model_seconds": 0.0,
        "policy_seconds": 0.0,
    }
    (model_folder(run.models, 1) / "training.json").write_text(json.dumps(figures))

    class Untrained:
        def policy(self) -> NeutralPolicy:
            return NeutralPolicy()

    monkeypatch.setattr("carlab.experiment.campaign.campaign.SacAgent.load", lambda *arguments: Untrained())
    with choice.car, pytest.raises(DataError, match=r"the disk is full; free some space on the disk of .* MB free"):
        list(Campaign(choice, plan, 2, run, max_ticks=20, record_rerun=False).run_episodes())
    assert run.recordings() == []


@needs_dev_full
def test_run_log_prints_no_traceback_when_the_disk_is_full(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    run = RunDirectory.create(tmp_path, "full")
    (run.path / "log.jsonl").symlink_to("/dev/full")
    handler, logger = run.log_handler(), logging.getLogger("carlab.test_disk_full")
    logger.addHandler(handler)
    try:
        logger.warning("a line")
    finally:
        logger.removeHandler(handler)
        handler.close()
    assert "Traceback" not in capfd.readouterr().err


@needs_dev_full
def test_command_log_keeps_its_entries_when_the_disk_is_full(tmp_path: Path) -> None:
    path = tmp_path / "firmware.jsonl"
    path.symlink_to("/dev/full")
    log = CommandLog(path)
    log.open()
    for k in range(20_000):
        log.add(float(k), "current", 1.0)
    log.close()
    assert len(log.entries("current")) == 20_000


def test_results_before_a_lack_of_space_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The space ends after two of three episodes: both are in result.json, and the error names the limit."""
    import carlab

    driven: list[int] = []

    def on_result(result: EpisodeResult) -> None:
        driven.append(result.episode)
        if len(driven) == 2:
            monkeypatch.setattr("carlab.recording.sink.MIN_FREE_BYTES", 10**18)

    with pytest.raises(DataError, match=r"less than 20 MB are free; free some space .* has the 2 episodes before"):
        carlab.drive(
            "sim", policy="neutral", episodes=3, ticks=5, out=tmp_path, rerun=False,
            hooks=carlab.RunHooks(on_result=on_result),
        )  # fmt: skip
    (run,) = tmp_path.iterdir()
    assert [row["episode"] for row in json.loads((run / "result.json").read_text())["episodes"]] == [1, 2]
    assert (run / "summary.png").stat().st_size > 0


def test_unfinished_recording_has_no_picture_and_its_own_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    from carlab.cli import run

    fill_disk(monkeypatch, Tick)
    assert run(["drive", "--policy", "neutral", "--ticks", "300", "--out", str(tmp_path), "--no-rerun"]) == 1
    text = " ".join("".join(capfd.readouterr()).split())
    assert "the disk is full; free some space" in text
    assert "No episode is complete." in text
    assert "carlab view" not in text


def test_full_disk_error_of_a_command_names_the_disk_and_no_cable(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    from carlab.cli import run
    from carlab.cli.check import Check

    def run_with_full_disk(self: Check) -> int:
        raise FULL

    monkeypatch.setattr(Check, "run", run_with_full_disk)
    assert run(["check"]) == 1
    text = capfd.readouterr().err
    assert "the disk is full; free some space on the disk of" in text
    assert "cable" not in text
