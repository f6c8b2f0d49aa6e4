"""A run that trains on another device: the model equals that of the CPU, and the policy drives on the CPU."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
import torch

from carlab.cars import choose_car
from carlab.experiment.campaign import campaign, training
from carlab.experiment.campaign.campaign import Campaign, prior_simulator, resumed_campaign
from carlab.experiment.campaign.training_plan import TrainingPlan
from carlab.experiment.episodes.session import Session
from carlab.recording.run_folder import RunDirectory
from learning.policy.sac_agent import SacAgent, SacPolicy
from learning.world.car_fit import load_car, save_car

SMALL = {"history": 1, "model_steps": 20, "updates": 8, "ticks": 6, "threads": 1}


@pytest.fixture(autouse=True)
def small_training(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few draws and steps; training in this process, where the stand-in of the device is installed."""

    def train_here(request: Any, on_progress: Any, stop: Any) -> Any:
        return training.train(request, on_progress)

    monkeypatch.setattr(campaign, "train_in_subprocess", train_here)
    monkeypatch.setattr("carlab.experiment.campaign.predicted_return.LONGER_EPISODE_FACTORS", (1.5,))
    monkeypatch.setattr("learning.posterior.discrepancy.STEPS", 10)
    monkeypatch.setattr("learning.posterior.inference.PRIOR_DRAWS", 64)
    monkeypatch.setattr("learning.posterior.inference.PARAMETER_DRAWS", 16)
    monkeypatch.setattr("learning.posterior.parameter_posterior.MAX_TEMPERING_STEPS", 2)
    monkeypatch.setattr("learning.posterior.parameter_posterior.RANDOM_WALK_STEPS", 1)


def learn(folder: Path, device: str, episodes: int) -> RunDirectory:
    choice = choose_car("sim", seed=0)
    run = RunDirectory.create(folder, device)
    prior = tomli_w.dumps(prior_simulator(choice.simulator, "kinematic").to_tables())
    plan = replace(TrainingPlan(prior, **SMALL), device=device)
    with choice.car:
        learning_run = Campaign(choice, plan, episodes, run, max_ticks=SMALL["ticks"], record_rerun=False)
        learning_run.write_plan()
        assert len(list(learning_run.run_episodes())) == episodes
    return run


def device_of(agent: SacAgent | SacPolicy) -> torch.device:
    """Device of the policy's parameters."""
    sac = agent.policy().sac if isinstance(agent, SacAgent) else agent.sac
    return next(sac.policy.parameters()).device


@pytest.mark.slow
def test_run_trains_on_the_device_and_drives_on_the_cpu(
    device: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    devices: list[tuple[str, str]] = []

    def log_device(
        step: str, device_of: Callable[..., torch.device], function: Callable[..., Any]
    ) -> Callable[..., Any]:
        def logged(*arguments: Any, **others: Any) -> Any:
            devices.append((step, device_of(*arguments).type))
            return function(*arguments, **others)

        return logged

    car = log_device("car", lambda dynamics, path: dynamics.posterior.parameters.device, save_car)
    monkeypatch.setattr("carlab.experiment.campaign.training.save_car", car)
    policy = log_device("policy", lambda agent, folder: device_of(agent), SacAgent.save)
    monkeypatch.setattr(SacAgent, "save", policy)
    monkeypatch.setattr(campaign, "Session", log_device("driving", lambda car, policy, *_: device_of(policy), Session))
    device_run = learn(tmp_path, device, 2)
    assert devices == [("car", "cuda"), ("policy", "cuda"), ("driving", "cpu")] * 2
    cpu_run = learn(tmp_path, "cpu", 1)
    assert {device for _, device in devices[6:]} == {"cpu"}
    device_posterior, cpu_posterior = (
        load_car(run.models / "0001" / training.DYNAMICS_FILE).posterior for run in (device_run, cpu_run)
    )
    torch.testing.assert_close(device_posterior.parameters, cpu_posterior.parameters, rtol=1e-3, atol=1e-3)
    figures = json.loads((device_run.models / "0002" / training.FIGURES_FILE).read_text())
    assert figures["rows"] == SMALL["ticks"] - SMALL["history"]
    assert np.isfinite(figures["last_episode_nll"])
    choice = choose_car("sim", seed=0)
    assert resumed_campaign(device_run, choice).plan.device == "cuda"
    assert resumed_campaign(device_run, choice, "cpu").plan.device == "cpu"
    without_device = json.loads((device_run.path / campaign.CAMPAIGN_FILE).read_text())
    del without_device["plan"]["device"]
    (device_run.path / campaign.CAMPAIGN_FILE).write_text(json.dumps(without_device))
    assert resumed_campaign(device_run, choice).plan.device == "cpu"
