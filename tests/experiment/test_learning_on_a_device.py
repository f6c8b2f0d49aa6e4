"""A run that learns on another device: it learns what it would have learned here, and drives from the CPU."""

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
from carlab.experiment.campaign.campaign import Campaign, CampaignHooks, prior_simulator, resumed_campaign
from carlab.experiment.campaign.training import TrainingPlan
from carlab.experiment.episodes.session import Session
from carlab.recording.run_folder import RunDirectory
from learning.policy.sac_agent import SacAgent, SacPolicy
from learning.world.car_fit import load_car, save_car

SMALL = {"history": 1, "model_steps": 20, "updates": 32, "ticks": 12, "threads": 1}


@pytest.fixture(autouse=True)
def brief(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two episodes in this process, for the stand-in is in this process, too; nothing is to be learned well."""
    monkeypatch.setattr(
        campaign, "train_in_subprocess",
        lambda plan, models, recordings, envelope, tell, stop: training.train(plan, models, recordings, envelope, tell),
    )  # fmt: skip
    monkeypatch.setattr("learning.posterior.discrepancy.STEPS", 10)
    monkeypatch.setattr("learning.posterior.inference.PRIOR_DRAWS", 64)
    monkeypatch.setattr("learning.posterior.inference.PARAMETER_DRAWS", 16)
    monkeypatch.setattr("learning.posterior.parameter_posterior.MAX_TEMPERING_STEPS", 2)
    monkeypatch.setattr("learning.posterior.parameter_posterior.RANDOM_WALK_STEPS", 1)


def learned(folder: Path, device: str, episodes: int) -> RunDirectory:
    choice = choose_car("sim", seed=0)
    run = RunDirectory.create(folder, device)
    prior = tomli_w.dumps(prior_simulator(choice.simulator, "kinematic").to_tables())
    plan = replace(TrainingPlan(prior, **SMALL), device=device)
    with choice.car:
        going = Campaign(choice, plan, episodes, run, max_ticks=SMALL["ticks"], record_rerun=False)
        going.write_plan()
        assert len(list(going.run_episodes())) == episodes
    return run


def device_of(agent: SacAgent | SacPolicy) -> torch.device:
    """Of the numbers that act."""
    sac = agent.policy().sac if isinstance(agent, SacAgent) else agent.sac
    return next(sac.policy.parameters()).device


def test_a_run_learns_there_and_drives_here(device: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    where: list[tuple[str, str]] = []

    def noting(what: str, device_of: Callable[..., torch.device], own: Callable[..., Any]) -> Callable[..., Any]:
        def noted(*given: Any, **others: Any) -> Any:
            where.append((what, device_of(*given).type))
            return own(*given, **others)

        return noted

    car = noting("car", lambda dynamics, path: dynamics.posterior.parameters.device, save_car)
    monkeypatch.setattr("learning.world.car_fit.save_car", car)
    policy = noting("policy", lambda agent, folder: device_of(agent), SacAgent.save)
    monkeypatch.setattr(SacAgent, "save", policy)
    monkeypatch.setattr(campaign, "Session", noting("driving", lambda car, policy, *_: device_of(policy), Session))
    there = learned(tmp_path, device, 2)
    assert where == [("car", "cuda"), ("policy", "cuda"), ("driving", "cpu")] * 2
    here = learned(tmp_path, "cpu", 1)
    assert {device for _, device in where[6:]} == {"cpu"}
    first, wanted = (load_car(run.models / "0001" / training.DYNAMICS_FILE).posterior for run in (there, here))
    torch.testing.assert_close(first.parameters, wanted.parameters, rtol=1e-3, atol=1e-3)
    figures = json.loads((there.models / "0002" / training.FIGURES_FILE).read_text())
    assert figures["rows"] == SMALL["ticks"] - SMALL["history"]
    assert np.isfinite(figures["last_episode_nll"])
    choice = choose_car("sim", seed=0)
    assert resumed_campaign(there, choice, CampaignHooks()).plan.device == "cuda"
    assert resumed_campaign(there, choice, CampaignHooks(), "cpu").plan.device == "cpu"
    old = json.loads((there.path / campaign.CAMPAIGN_FILE).read_text())
    del old["plan"]["device"]
    (there.path / campaign.CAMPAIGN_FILE).write_text(json.dumps(old))
    assert resumed_campaign(there, choice, CampaignHooks()).plan.device == "cpu"
