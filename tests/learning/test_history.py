"""Test the selection of the history length on simulated cars with known delays."""

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
    """Simulate a new random command every tick; ``rows`` transitions have the longest history."""
    config = SimulatorConfig(command_delay_s=delay_s, control_period_s=PERIOD_S, mocap=MocapParameters(latency_s=0.0))
    rng = np.random.default_rng(seed)
    sent = rng.uniform([-1.0, 0.0], [1.0, 0.6], (rows + CANDIDATE_LENGTHS[-1], 2))
    start = torch.tensor([[0.0, 0.0, 0.0, 1.5, 0.0, 0.0]], dtype=torch.float64)
    states = rollout(config, start, torch.from_numpy(sent[None])).states[0].numpy()
    states = states + rng.normal(size=states.shape) * NOISE
    return EpisodeData(np.arange(len(sent) + 1) * PERIOD_S, states, sent, sent, np.zeros(len(sent)))


def test_history_covers_the_command_delay() -> None:
    """The commands that act during a step were sent up to one delay earlier."""
    chosen = []
    for delay_s in (0.02, 0.15):
        found = find_history([drive(delay_s, 80)])
        assert found is not None
        needed = math.ceil(delay_s / PERIOD_S)
        assert found.history >= needed
        assert found.nll[max(h for h in CANDIDATE_LENGTHS if h < needed)] > found.nll[found.history] + 1.0
        assert f"supports {found.history} past commands" in found.message()
        chosen.append(found.history)
    assert chosen[0] <= 4 < chosen[1], "the longer delay needs five commands, the shorter one"


@pytest.mark.parametrize("rows", [(0,), (MIN_ROWS - 1,), (MIN_ROWS // 2, MIN_ROWS // 2 - 1)])
def test_too_few_rows_give_no_history(rows: tuple[int, ...]) -> None:
    assert find_history([drive(0.02, n, seed=n) for n in rows]) is None


def test_rows_with_nan_are_not_counted() -> None:
    episode = drive(0.02, MIN_ROWS)
    episode.states[30, 3] = np.nan
    assert find_history([episode]) is None
    assert find_history([]) is None
