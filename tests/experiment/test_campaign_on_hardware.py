"""A learning run on the emulated car: recorded commands are those of the firmware, and no training while it drives."""

from __future__ import annotations

import multiprocessing
from pathlib import Path

import numpy as np
import pytest
from learning_runs import ENVELOPE, HISTORY, TICKS, log_sent_actions, tiny_plan

from carlab.cars import choose_car
from carlab.core.clock import MonotonicClock
from carlab.core.documents import Tick
from carlab.core.policy import PolicyInput
from carlab.core.quantities import Action
from carlab.experiment.campaign.campaign import Campaign
from carlab.experiment.campaign.hooks import LearnHooks
from carlab.experiment.campaign.training import TrainingRequest, train
from carlab.recording.mcap.source import read_episode
from carlab.recording.run_folder import RunDirectory
from drivers.emulators.command_log import read_log
from learning.policy.sac_agent import SacPolicy
from learning.transitions import transitions_of

pytestmark = pytest.mark.realtime


@pytest.mark.usefixtures("short_inference")
def test_recorded_command_equals_the_command_received_by_the_firmware(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def act(self: SacPolicy, view: PolicyInput) -> Action:
        rng = np.random.default_rng(view.step)
        return Action(float(rng.uniform(-0.3, 0.3)), float(rng.uniform(0.05, 0.3)))

    monkeypatch.setattr(SacPolicy, "act", act)
    run = RunDirectory.create(tmp_path, "wire")
    choice = choose_car("emulated", seed=0)
    plan = tiny_plan(choice)
    train(TrainingRequest(plan, run.models, [], ENVELOPE), lambda *what: None)
    choice.log_to(run.path)
    sent_actions = log_sent_actions(choice)
    with choice.car:
        (result,) = Campaign(choice, plan, 1, run, max_ticks=TICKS, record_rerun=False).run_episodes()
    episode = read_episode(result.path)
    rows = transitions_of([episode], HISTORY)
    assert len(rows) > TICKS // 2
    sent_commands = np.array([a.to_array() for a in sent_actions])
    np.testing.assert_array_equal(rows.inputs[:, -2:], sent_commands[rows.tick])
    currents = [e for e in read_log(run.path / "firmware.jsonl") if e.name == "current"]
    times_s, values = np.array([e.t_s for e in currents]), np.array([e.value for e in currents])
    # The last current received before the next tick; on a busy machine some commands arrive later.
    last_currents = values[np.searchsorted(times_s, episode.times_s[rows.tick + 1]) - 1]
    throttles = rows.inputs[:, -1]
    is_moving = throttles != 0.0  # neutral while the telemetry was stale; such a row counts as different
    per_throttle = last_currents[is_moving] / throttles[is_moving]
    assert np.sum(np.abs(per_throttle / np.median(per_throttle) - 1.0) < 0.01) > 0.7 * len(rows)


def test_training_and_driving_do_not_overlap(tmp_path: Path) -> None:
    """No training process is alive at any tick; between the episodes the firmware receives neutral commands."""
    run = RunDirectory.create(tmp_path, "late")
    choice = choose_car("emulated", seed=0)
    choice.log_to(run.path)
    clock = MonotonicClock()
    child_names: list[str] = []
    progress_s: list[float] = []
    ticks_s: list[float] = []

    def on_tick(tick: Tick) -> None:
        child_names.extend(child.name for child in multiprocessing.active_children())
        ticks_s.append(tick.t_s)

    hooks = LearnHooks(on_tick=on_tick, on_training=lambda stage, done, total: progress_s.append(clock.now_s()))
    with choice.car:
        campaign = Campaign(choice, tiny_plan(choice), 2, run, hooks, max_ticks=TICKS, record_rerun=False)
        assert len(list(campaign.run_episodes())) == 2
    assert len(ticks_s) > TICKS
    assert not {"training", "quick check"} & set(child_names)
    training_s = np.array(progress_s)
    second_training_s = training_s[training_s > ticks_s[0]]
    assert len(second_training_s) > 3, "a second training runs after the first episode"
    entries = [e for e in read_log(run.path / "firmware.jsonl") if ticks_s[0] < e.t_s < ticks_s[-1]]
    currents = [e for e in entries if e.name == "current"]
    commands_during_training = [e for e in currents if second_training_s.min() < e.t_s < second_training_s.max()]
    assert len(commands_during_training) > 3
    assert all(e.value == 0.0 for e in commands_during_training), "the car is in neutral during training"
    assert not [e for e in entries if e.name == "motor_timeout"], "no gap in the commands lets the firmware time out"
    training_periods_s = np.diff([e.t_s for e in commands_during_training])
    driving_periods_s = np.diff([e.t_s for e in currents if e.t_s < ticks_s[0] + 0.5 * TICKS * choice.control_period_s])
    assert np.median(training_periods_s) == pytest.approx(np.median(driving_periods_s), rel=0.5)
    late_s = np.concatenate([read_episode(path).extra["late_s"][:-1] for path in run.recordings()])
    assert np.median(late_s) < 0.005
