"""A learning run alternates training and driving, resumes after interruptions, and trains on the sent commands."""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import signal
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from learning_runs import HISTORY, TICKS, InterruptedRun, drive, log_sent_actions, names, tiny_plan

import carlab
from carlab.cars import choose_car
from carlab.core.documents import EpisodeEnded, Tick
from carlab.core.errors import DataError, NotReadyError
from carlab.core.observation import encode
from carlab.core.outcome import EndReason
from carlab.core.quantities import CarState, Reality
from carlab.experiment.campaign import training
from carlab.experiment.campaign.campaign import Campaign, resumed_campaign, saved_plan
from carlab.experiment.campaign.figures import EpisodeFigures, predict_windows
from carlab.experiment.campaign.hooks import LearnHooks
from carlab.experiment.campaign.picture import draw
from carlab.experiment.campaign.report import learning_curve, restore_missing_rows, save_row, write_report
from carlab.experiment.campaign.run_recording import write_run_recording
from carlab.experiment.campaign.training import recorded_features
from carlab.recording.mcap.sink import McapSink
from carlab.recording.mcap.source import read_documents, read_episode
from carlab.recording.pipe_file import PipeFile
from carlab.recording.recorder import Recorder
from carlab.recording.run_folder import RunDirectory
from learning.evaluation import negative_log_likelihood
from learning.policy.sac_agent import SacAgent, SacSettings
from learning.transitions import transitions_of
from learning.world import car_fit
from learning.world.car_fit import load_car
from tests.helpers.rerun_files import cells, tabs


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory: pytest.TempPathFactory) -> InterruptedRun:
    choice = choose_car("sim", seed=0)
    run = RunDirectory.create(tmp_path_factory.mktemp("runs"), "learn")
    record = InterruptedRun(run, tiny_plan(choice), log_sent_actions(choice))

    def run_episodes(stop: Callable[[], bool] = lambda: False, **callbacks: Callable[..., None]) -> None:
        hooks = LearnHooks(on_figures=record.figures.append, **callbacks)
        campaign = Campaign(choice, record.plan, 2, run, hooks, max_ticks=TICKS, record_rerun=False, stop=stop)
        campaign.write_plan()
        for result in campaign.run_episodes():
            record.results.append(result)
            write_report(run, record.plan, record.figures[-1])

    def kill(stage: str, done: int, total: int) -> None:
        if record.results and stage == "learning to drive":
            (child,) = multiprocessing.active_children()
            (run.models / "0002.partial").mkdir(exist_ok=True)
            (run.models / "0002.partial" / "dynamics.pt").write_bytes(b"rubbish")
            os.kill(child.pid or 0, signal.SIGKILL)

    with choice.car:
        run_episodes((run.models / "0001").is_dir)
        record.files_after_stop = names(run)
        record.first_model = (run.models / "0001" / "policy.npz").read_bytes()
        with pytest.raises(DataError) as error:
            run_episodes(on_training=kill)
        record.error_text = str(error.value)
        record.files_after_kill = names(run)
        (run.models / "0002.partial").mkdir()  # as after a kill of the whole program
        (run.models / "0002.partial" / "policy.npz").write_bytes(b"rubbish")
        run_episodes()
    return record


def test_interrupted_run_resumes_at_the_next_episode(interrupted: InterruptedRun) -> None:
    assert interrupted.files_after_stop == ["models/0001"]
    assert interrupted.files_after_kill == ["episodes/0001.mcap", "models/0001"]
    assert "exit code -9" in interrupted.error_text
    assert "Resume the run with --resume" in interrupted.error_text
    assert "\n" not in interrupted.error_text
    assert names(interrupted.run) == ["episodes/0001.mcap", "episodes/0002.mcap", "models/0001", "models/0002"]
    assert [r.reason for r in interrupted.results] == [EndReason.COMPLETED] * 2
    assert [p.name for p in sorted((interrupted.run.models / "0002").iterdir())] == [
        "diagnosis.json", "dynamics.pt", "policy.npz", "prior.toml", "training.json",
    ]  # fmt: skip
    assert (interrupted.run.models / "0001" / "policy.npz").read_bytes() == interrupted.first_model, (
        "the first model is not trained again"
    )


def test_complete_run_trains_and_drives_nothing(interrupted: InterruptedRun) -> None:
    before = names(interrupted.run)
    choice = choose_car("sim")
    assert list(Campaign(choice, interrupted.plan, 2, interrupted.run).run_episodes()) == [], (
        "no episode is driven: the car is not open"
    )
    assert names(interrupted.run) == before


def test_training_plan_is_read_from_the_run_folder(interrupted: InterruptedRun, tmp_path: Path) -> None:
    resumed = resumed_campaign(interrupted.run, choose_car("sim"))
    assert (resumed.plan, resumed.episodes, resumed.max_ticks) == (interrupted.plan, 2, TICKS)
    assert (resumed.place, resumed.record_rerun) == (True, False)
    invalid_run = RunDirectory.create(tmp_path, "other")
    complete = json.loads((interrupted.run.path / "campaign.json").read_text())
    changes: list[dict[str, object]] = [
        {"threads": "x"},
        {"method": "other"},
        {"device": "mps"},
        {"ticks": 0},
        {"seed": 1.5},
        {"seed": 2**32},
        {"history": 101},
        {"prior_toml": "x = " + "[" * 3000},
    ]
    invalid_plans = [json.dumps({**complete, "plan": {**complete["plan"], **change}}) for change in changes]
    for content in (None, "{", "{}", '{"episodes": 3, "plan": {"prior_toml": "no toml"}}', *invalid_plans):
        if content is not None:
            (invalid_run.path / "campaign.json").write_text(content)
        with pytest.raises(DataError, match="cannot be resumed"):
            resumed_campaign(invalid_run, choose_car("sim"))
        with pytest.raises(DataError, match="is not the folder of a run of carlab learn"):
            saved_plan(invalid_run.path)


@pytest.mark.parametrize("history", [HISTORY - 1, HISTORY + 2])
def test_history_other_than_that_of_the_policy_is_refused(interrupted: InterruptedRun, history: int) -> None:
    run = RunDirectory(shutil.copytree(interrupted.run.path, interrupted.run.path.with_name(f"history_{history}")))
    content = json.loads((run.path / "campaign.json").read_text())
    content["plan"]["history"] = history
    (run.path / "campaign.json").write_text(json.dumps(content))
    with pytest.raises(DataError, match=f"observes {HISTORY} past commands and .* states a history of {history};"):
        resumed_campaign(run, choose_car("sim"))


def test_learning_curve_has_the_figures_of_the_recordings(interrupted: InterruptedRun) -> None:
    rows = json.loads((interrupted.run.path / "learn.json").read_text())["episodes"]
    assert [r["episode"] for r in rows] == [1, 2]
    for row in rows:
        episode = read_episode(interrupted.run.episode_path(row["episode"]))
        training_figures = json.loads((interrupted.run.models / f"{row['episode']:04d}" / "training.json").read_text())
        assert episode.ticks == TICKS
        assert episode.metadata["model"] == str(row["episode"])
        assert row["total_reward"] == pytest.approx(episode.rewards.sum())
        x, y, yaw, vx, vy, _ = episode.states[-1]
        assert row["distance_m"] == pytest.approx(np.hypot(x, y))
        assert row["yaw_error_rad"] == pytest.approx(abs(np.angle(np.exp(1j * yaw))))
        assert row["speed_mps"] == pytest.approx(np.hypot(vx, vy))
        assert row["success"] is False
        assert row["end"] == episode.metadata["end_reason"] == "COMPLETED"
        assert row["predicted_return"] == training_figures["predicted_return"]
        assert row["predicted_low"] < row["predicted_return"] < row["predicted_high"]
    assert [r["rows"] for r in rows] == [0, TICKS - HISTORY]
    assert rows[0]["updates"] > rows[1]["updates"] == 32, "the first training makes more updates"
    assert [str(r) for r in learning_curve(interrupted.run)] == [str(f) for f in interrupted.figures]
    assert (interrupted.run.path / "learn.png").read_bytes().startswith(b"\x89PNG")


def test_recording_of_a_run_has_predictions_and_figures(interrupted: InterruptedRun, tmp_path: Path) -> None:
    run, file = interrupted.run, tmp_path / "view.rrd"
    carlab.save_run(run.path, file)
    for path in (file, run.path / "learn.rrd"):
        assert {"Drive by episode", "Learning curve"} <= set(tabs(path))
        figures = cells(path, "Scalars:scalars", "episode")["learning/total_reward"]
        assert figures == [(f.episode, [f.total_reward]) for f in interrupted.figures]
        starts = [cell[0][0][:2] for _, cell in cells(path, "LineStrips3D:strips", "car_time")["map/predicted"]]
        driven = [read_episode(recording).states[:TICKS:3, :2] for recording in run.recordings()]
        np.testing.assert_allclose(starts, np.concatenate(driven), atol=1e-5, err_msg="paths start at the car")
    shutil.copytree(run.path, tmp_path / "run")
    shutil.rmtree(tmp_path / "run" / "models")
    carlab.save_run(tmp_path / "run", file)
    assert "map/predicted" not in cells(file, "LineStrips3D:strips", "car_time"), "without models no predictions"
    assert "Predicted against driven" not in tabs(file)


def test_picture_has_one_axis_a_panel_and_no_cut_text(
    interrupted: InterruptedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    figures: list[Any] = []
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda figure, path, dpi: figures.append(figure))
    episode = read_episode(interrupted.run.recordings()[0])
    windows = predict_windows(load_car(interrupted.run.models / "0001" / "dynamics.pt"), episode)
    row = replace(interrupted.figures[0], verdict="left", diagnosis="The simulator leaves an error. " * 20)
    draw([row], 1, episode, windows, interrupted.plan.task, tmp_path / "picture.png")
    (figure,) = figures
    figure.draw_without_rendering()
    boxes = [axis.get_position().bounds for axis in figure.axes]
    assert len(set(boxes)) == len(boxes) == 3 + 6, "return, distance, plan and six states; no likelihood yet"
    texts = [figure._suptitle, *(axis.title for axis in figure.axes)]
    for text in texts:
        box = text.get_window_extent()
        assert box.x0 >= 0, text.get_text()
        assert box.x1 <= figure.bbox.width, text.get_text()
    assert figure._suptitle.get_text().replace("\n", " ").strip() == row.diagnosis.strip()
    (plan,) = (axis for axis in figure.axes if axis.get_xlabel() == "x [m]")
    labels = [text.get_text() for text in plan.get_legend().get_texts()]
    assert sorted(labels) == ["arena", "driven", "end", "goal"], "the episode is too short for predictions"
    (goal,) = (line.get_xydata() for line in plan.get_lines() if line.get_label() == "goal")
    assert goal[:, 0].max() == pytest.approx(0.21), (
        "the nose of a car at the goal, with heading 0, is at half its length"
    )
    assert np.abs(goal[np.argmax(goal[:, 0]), 1]) < 1e-12, "the outline has a pointed front"


def test_likelihood_uses_the_model_trained_before_the_episode(interrupted: InterruptedRun) -> None:
    rows = transitions_of([read_episode(interrupted.run.episode_path(1))], HISTORY)
    inputs, outputs = (torch.from_numpy(v).float() for v in (rows.inputs, rows.targets))
    nll = [
        negative_log_likelihood(
            load_car(interrupted.run.models / n / "dynamics.pt").predict(inputs).smoothed(), outputs
        )
        for n in ("0001", "0002")
    ]
    assert nll[0] > nll[1] + 0.1, "the second model was trained on this episode"
    assert interrupted.figures[1].last_episode_nll == pytest.approx(nll[0], abs=1e-3)
    assert np.isnan(interrupted.figures[0].last_episode_nll)


def test_transition_input_ends_with_the_command_sent_at_its_tick(interrupted: InterruptedRun) -> None:
    episodes = [read_episode(path) for path in interrupted.run.recordings()]
    sent_commands = np.array([a.to_array() for a in interrupted.sent_actions])
    np.testing.assert_array_equal(np.concatenate([e.sent for e in episodes]), sent_commands)
    assert len(np.unique(sent_commands, axis=0)) > TICKS
    rows = transitions_of(episodes, HISTORY)
    assert len(rows) == 2 * (TICKS - HISTORY)
    for row, number, tick in zip(rows.inputs, rows.episode, rows.tick, strict=True):
        np.testing.assert_array_equal(row[-2:], sent_commands[number * TICKS + tick])


def test_policy_and_training_features_contain_the_past_commands(
    interrupted: InterruptedRun,
) -> None:
    path = interrupted.run.episode_path(2)
    ticks = [d for d in read_documents(path) if isinstance(d, Tick)]
    assert len(ticks) == TICKS
    assert ticks[0].features[-2 * HISTORY :].tolist() == [0.0] * 2 * HISTORY
    for previous, current in pairwise(ticks):
        np.testing.assert_array_equal(current.features[-2:], previous.sent.to_array())
        np.testing.assert_array_equal(current.features[-4:-2], previous.features[-2:])
    episode = read_episode(path)
    expected = np.array([t.features for t in ticks[HISTORY:]])
    np.testing.assert_allclose(recorded_features([episode], HISTORY), expected, atol=1e-12)
    states = episode.states.copy()
    states[5, 4] = np.nan
    with_nan_state = recorded_features([episode, replace(episode, states=states)], HISTORY)
    assert len(with_nan_state) == 2 * len(expected) - 1
    np.testing.assert_allclose(recorded_features([episode], 0), encode(episode.states[:-1], np.zeros((TICKS, 0, 2))))


def test_interrupted_episode_is_kept_and_repeated(interrupted: InterruptedRun, tmp_path: Path) -> None:
    """The recording is moved to ``stopped``, and the run reaches the requested number of complete episodes."""
    run = interrupted.copied(tmp_path, "0001")
    steps: list[int] = []

    def on_tick(tick: Tick) -> None:
        steps.append(tick.step)
        if len(steps) == 5:
            signal.raise_signal(signal.SIGINT)

    choice = choose_car("sim", seed=0)
    figures: list[EpisodeFigures] = []
    hooks = LearnHooks(on_tick=on_tick, on_figures=figures.append)
    campaign = Campaign(choice, interrupted.plan, 1, run, hooks, max_ticks=TICKS, record_rerun=False)
    with choice.car:
        assert list(campaign.run_episodes()) == []
        assert (run.recordings(), figures) == ([], [])
        stopped_episode = read_episode(run.stopped / "0001.mcap")
        assert (stopped_episode.ticks, stopped_episode.metadata["end_reason"]) == (5, "STOP_REQUESTED")
        (result,) = campaign.run_episodes()
    assert [p.name for p in run.recordings()] == ["0002.mcap"], "the number of a stopped episode is not reused"
    assert (result.data.ticks, result.reason, figures[0].episode) == (TICKS, EndReason.COMPLETED, 1)


def test_episode_of_a_car_that_cannot_be_armed_is_repeated(
    interrupted: InterruptedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = interrupted.copied(tmp_path, "0001")
    choice = choose_car("sim", seed=0)
    figures: list[EpisodeFigures] = []
    hooks = LearnHooks(on_figures=figures.append)
    campaign = Campaign(choice, interrupted.plan, 1, run, hooks, max_ticks=TICKS, record_rerun=False)

    def refuse() -> None:
        raise NotReadyError("car", ["it moves"])

    with choice.car, monkeypatch.context() as patch:
        patch.setattr(choice.car, "arm", refuse)
        with pytest.raises(NotReadyError, match="it moves"):
            list(campaign.run_episodes())
        patch.undo()
        (result,) = campaign.run_episodes()
    assert (result.data.ticks, figures[0].episode, figures[0].rows) == (TICKS, 1, 0)
    assert [p.name for p in run.recordings()] == ["0002.mcap"]


def test_hung_episode_is_moved_to_stopped_if_no_model_was_trained_on_it(
    interrupted: InterruptedRun, tmp_path: Path
) -> None:
    run = interrupted.copied(tmp_path, "0001", "0002", recordings=True)
    last_recording = run.recordings()[-1]
    documents = read_documents(last_recording)
    with Recorder([McapSink(run.episode_path(3))]) as recorder:
        for document in documents:
            is_end = isinstance(document, EpisodeEnded)
            recorder.emit(replace(document, reason=EndReason.LOOP_HUNG) if is_end else document)
    campaign = Campaign(choose_car("sim"), interrupted.plan, 3, run)
    shutil.copytree(interrupted.run.models / "0002", run.models / "0004")
    campaign.move_stopped_episode()
    assert len(run.recordings()) == 3, "a model was trained on the episode"
    shutil.rmtree(run.models / "0004")
    campaign.move_stopped_episode()
    campaign.move_stopped_episode()
    assert [p.name for p in run.recordings()] == ["0001.mcap", "0002.mcap"]
    assert (run.stopped / "0003.mcap").is_file()
    assert run.next_episode() == 4


def test_missing_row_of_the_learning_curve_is_restored_from_the_recording(
    interrupted: InterruptedRun, tmp_path: Path
) -> None:
    run = interrupted.copied(tmp_path, "0001", "0002", recordings=True)
    complete = json.loads((interrupted.run.path / "learn.json").read_text())
    (run.path / "learn.json").write_text(json.dumps({**complete, "episodes": complete["episodes"][:1]}))
    restore_missing_rows(run, interrupted.plan.task)
    expected = [replace(f, verdict="", excess=np.nan, excess_std=np.nan, diagnosis="") for f in interrupted.figures]
    assert str(learning_curve(run)[1]) == str(expected[1])
    before = (run.path / "learn.json").read_bytes()
    restore_missing_rows(run, interrupted.plan.task)
    assert (run.path / "learn.json").read_bytes() == before


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_full_disk_is_reported_for_each_file_of_a_run(
    interrupted: InterruptedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    car_model, model_dir = load_car(interrupted.run.models / "0002" / "dynamics.pt"), interrupted.run.models / "0002"
    agent = SacAgent.load(model_dir, SacSettings(), 0)
    for name, write in (
        ("dynamics.pt", lambda folder: car_fit.save_car(car_model, folder / "dynamics.pt")),
        ("policy.npz", agent.save),
    ):

        def write_to_full_disk(folder: Path, name: str = name, write: Any = write) -> None:
            (folder / name).symlink_to("/dev/full")
            write(folder)

        with pytest.raises(DataError, match="the disk is full; free some space") as error:
            training._publish(tmp_path / "0001", {}, write_to_full_disk)
        assert "\n" not in str(error.value)
        assert list(tmp_path.glob("0001*")) == []

    def open_full_disk(self: PipeFile) -> None:
        self._file = Path("/dev/full").open("wb", buffering=0)  # noqa: SIM115

    curve = tmp_path / "learn.rrd"
    curve.write_bytes(b"previous content")
    monkeypatch.setattr(PipeFile, "open", open_full_disk)
    with pytest.raises(DataError, match="the disk is full; free some space"):
        write_run_recording(interrupted.run, {}, curve)
    assert curve.read_bytes() == b"previous content"
    (interrupted.run.path / "learn.json.partial").symlink_to("/dev/full")
    with pytest.raises(DataError, match="the disk is full; free some space"):
        save_row(interrupted.run, interrupted.figures[0])


@pytest.mark.parametrize(("reality", "n_episodes"), [(Reality.SIMULATED, 2), (Reality.REAL, 1)])
def test_real_car_drives_no_further_episode_after_a_safety_stop(
    interrupted: InterruptedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reality: Reality, n_episodes: int
) -> None:
    choice = choose_car("sim", seed=0)
    monkeypatch.setattr(choice.car, "reality", reality)
    run = interrupted.copied(tmp_path, *("0001", "0002")[:n_episodes])
    for diagnosis in run.models.glob("*/diagnosis.json"):
        diagnosis.unlink()
    with choice.car as car:
        car.place(CarState(5.0, 5.0))
        results = list(Campaign(choice, interrupted.plan, 2, run, place=False, record_rerun=False).run_episodes())
    assert [r.reason.name for r in results] == ["GEOFENCE"] * n_episodes
    is_repeated = reality is Reality.REAL
    assert [p.name for p in run.stopped.glob("*.mcap")] == ["0001.mcap"] * is_repeated, "no tick was driven"
    assert not (run.models / "0001" / "diagnosis.json").exists()


def test_report_is_written_for_an_episode_without_a_tick(interrupted: InterruptedRun, tmp_path: Path) -> None:
    run = drive(tmp_path, TICKS, CarState(5.0, 5.0))
    shutil.copytree(interrupted.run.models / "0001", run.models / "0001")
    row = replace(interrupted.figures[0], end="GEOFENCE", total_reward=0.0)
    write_report(run, interrupted.plan, row)
    assert [str(r) for r in learning_curve(run)] == [str(row)]
