"""How many past commands the data ask for, on simulated cars whose delays are known."""

import math

import numpy as np
import pytest
import torch

from carlab.core.episode_data import EpisodeData
from learning.world.history import CANDIDATE_LENGTHS, MIN_ROWS, find_history
from sim_backends.batch.rollout import rollout
from sim_backends.car_parameters import MocapParameters, SimulatorConfig

PERIOD_S = 1 / 30
NOISE = (0.0005, 0.0005, 0.001, 0.005, 0.005, 0.02)


def drive(delay_s: float, rows: int, seed: int = 0) -> EpisodeData:
    """A new command every tick, and as many rows with the longest history as required."""
    config = SimulatorConfig(command_delay_s=delay_s, control_period_s=PERIOD_S, mocap=MocapParameters(latency_s=0.0))
    rng = np.random.default_rng(seed)
    sent = rng.uniform([-1.0, 0.0], [1.0, 0.6], (rows + CANDIDATE_LENGTHS[-1], 2))
    start = torch.tensor([[0.0, 0.0, 0.0, 1.5, 0.0, 0.0]], dtype=torch.float64)
    states = rollout(config, start, torch.from_numpy(sent[None])).states[0].numpy()
    states = states + rng.normal(size=states.shape) * NOISE
    return EpisodeData(np.arange(len(sent) + 1) * PERIOD_S, states, sent, sent, np.zeros(len(sent)))


def test_a_longer_delay_asks_for_more_commands_and_for_no_fewer_than_it_needs() -> None:
    """What moves the car during a step was sent up to its delay before."""
    chosen = []
    for delay_s in (0.02, 0.15):
        found = find_history([drive(delay_s, 80)])
        assert found is not None
        needed = math.ceil(delay_s / PERIOD_S)
        assert found.history >= needed
        assert found.nll[max(h for h in CANDIDATE_LENGTHS if h < needed)] > found.nll[found.history] + 1.0
        assert f"supports {found.history} past commands" in found.message()
        chosen.append(found.history)
    assert chosen[0] <= 4 < chosen[1], "five are needed by the longer delay, one by the shorter"


@pytest.mark.parametrize("rows", [(0,), (MIN_ROWS - 1,), (MIN_ROWS // 2, MIN_ROWS // 2 - 1)])
def test_too_few_rows_say_nothing(rows: tuple[int, ...]) -> None:
    assert find_history([drive(0.02, n, seed=n) for n in rows]) is None


def test_rows_that_hold_no_numbers_do_not_count() -> None:
    episode = drive(0.02, MIN_ROWS)
    episode.states[30, 3] = np.nan
    assert find_history([episode]) is None
    assert find_history([]) is None
