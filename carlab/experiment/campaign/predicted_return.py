"""Predicted return of the next episode with a 90 % interval, and the time that the car needs for success.

The prediction mixes two kinds of cars: the learned car, and simulated cars drawn from the prior with plausible unknown
effects, of which those that fit the recordings best are used. Before the first recording both have equal weights. The
learned car fits the recordings better, so the weight of the drawn cars falls with the number of recordings.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from carlab.core.episode_data import EpisodeData
from carlab.core.observation import ACTION_SIZE, STATE_FEATURES
from carlab.core.safety import SafetyEnvelope
from carlab.core.toml_files import toml_tables
from carlab.experiment.campaign.training_plan import TrainingPlan
from learning.policy.sac_agent import SacAgent
from learning.world.drawn_cars import draw_cars, select_cars
from learning.world.model_env import ModelEnv
from sim_backends.car_parameters import SimulatorConfig

N_DRAWN, N_SELECTED = 512, 64
"""Number of drawn cars, and of those that fit the recordings best."""
QUANTILES = (0.05, 0.5, 0.95)
FIRST_DRAWN_SHARE = 0.5
"""Weight of the drawn cars without recordings; with n episodes it is divided by (n + 1)**2. With equal weights the
90 % intervals contained all of 36 returns (docs/results/learning.md)."""
LONGER_EPISODE_FACTORS = (1.5, 2.0, 3.0)
"""Lengths of longer drives in the learned car, in lengths of an episode."""
MIN_SUCCESS_SHARE = 0.5
"""Share of drives in the learned car that must succeed for the length of a drive to count as sufficient."""


def predicted_figures(
    plan: TrainingPlan,
    agent: SacAgent,
    learned: ModelEnv,
    episodes: Sequence[EpisodeData],
    envelope: SafetyEnvelope,
    seed: int,
) -> dict[str, Any]:
    """Median return and 90 % interval of a policy, and sufficient ticks if those of an episode are too few.

    The plan has the current prior. The envelope has the limits of the car's safety gate.
    """
    totals = [learned.roll_out(agent.act).returns.numpy()]
    shares = [1.0]
    prior = SimulatorConfig.from_tables(toml_tables(plan.prior_toml))
    if plan.method == "gp-sim-posterior":
        cars = draw_cars(prior, N_DRAWN, torch.Generator().manual_seed(seed), plan.history)
        cars = select_cars(cars, episodes, N_SELECTED)
        task = plan.task.resized(cars.history)
        environment = ModelEnv(cars, task, N_SELECTED, envelope=envelope, period_s=prior.control_period_s, seed=seed)
        totals.append(environment.roll_out(lambda seen: agent.act(_own_features(seen, plan.history))).returns.numpy())
        drawn_share = FIRST_DRAWN_SHARE / (len(episodes) + 1) ** 2
        shares = [1.0 - drawn_share, drawn_share]
    weights = np.concatenate([np.full(len(t), w / len(t)) for t, w in zip(totals, shares, strict=True)])
    low, median, high = np.quantile(np.concatenate(totals), QUANTILES, weights=weights, method="inverted_cdf").tolist()
    figures = {"predicted_return": median, "predicted_low": low, "predicted_high": high}
    return figures | _sufficient_ticks(plan, agent, learned)


def _own_features(seen: NDArray[np.float32], history: int) -> NDArray[np.float32]:
    """Policy inputs (N, 7 + 2 H) with only the last H = ``history`` of the past commands in ``seen``."""
    first = seen.shape[1] - ACTION_SIZE * history
    assert first >= STATE_FEATURES, f"{seen.shape[1]} features hold fewer than {history} past commands"
    return np.concatenate([seen[:, :STATE_FEATURES], seen[:, first:]], axis=1)


def _sufficient_ticks(plan: TrainingPlan, agent: SacAgent, learned: ModelEnv) -> dict[str, Any]:
    """``needed_ticks`` if the policy succeeds in the learned car only in longer drives; empty otherwise."""
    ticks = plan.task.max_ticks
    for factor in (1.0, *LONGER_EPISODE_FACTORS):
        length = round(factor * ticks)
        ends = learned.roll_out(agent.act, max_ticks=length).final
        if float(plan.task.success(ends).float().mean()) >= MIN_SUCCESS_SHARE:
            return {} if length == ticks else {"needed_ticks": length}
    return {}
