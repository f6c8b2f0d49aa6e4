"""Learning loads no compiler of PyTorch, which takes two seconds."""

from __future__ import annotations

import sys

import gymnasium as gym
import numpy as np
import pytest
import torch
from torch.optim import Optimizer

from learning.networks.uncompiled_optimisers import uncompiled_optimisers
from learning.policy.sac import FastSac
from learning.world import disturbance_fit
from learning.world.disturbance_fit import CHANNELS, RolloutErrors


@pytest.fixture(autouse=True)
def no_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    """An import of the compiler fails, as if it were the first one in this process."""
    monkeypatch.delattr(Optimizer.add_param_group.__wrapped__, "__dynamo_disable", raising=False)
    monkeypatch.delattr(Optimizer.zero_grad.__wrapped__, "__dynamo_disable", raising=False)
    monkeypatch.setitem(sys.modules, "torch._dynamo", None)


class Env(gym.Env[np.ndarray, np.ndarray]):
    observation_space = gym.spaces.Box(-1.0, 1.0, (3,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)


def test_plain_optimiser_loads_the_compiler() -> None:
    with pytest.raises(ImportError, match=r"torch\._dynamo"):
        torch.optim.LBFGS([torch.zeros(2, requires_grad=True)])


def test_context_ends_and_may_be_nested() -> None:
    parameters = [torch.zeros(2, requires_grad=True)]
    with uncompiled_optimisers():
        with uncompiled_optimisers():
            torch.optim.LBFGS(parameters)
        torch.optim.Adam(parameters)
    with pytest.raises(ImportError):
        torch.optim.Adam(parameters)


def test_agent_loads_no_compiler() -> None:
    FastSac("MlpPolicy", Env(), policy_kwargs={"net_arch": [4]}, device="cpu")


def test_fit_of_a_disturbance_loads_no_compiler() -> None:
    """Errors with twice the standard deviation of the disturbance of unit scale: the scale is 2."""
    generator = torch.Generator().manual_seed(1)
    n = len(CHANNELS)
    error = 2.0 * torch.randn((2000, n), generator=generator, dtype=torch.float64)
    errors = RolloutErrors(error, torch.full_like(error, 1e-6), pulses=error, period_s=0.1)
    responses = torch.eye(n, dtype=torch.float64).expand(2000, n, n)
    _, scales = disturbance_fit._maximise_scale(errors, responses, torch.ones(1, dtype=torch.float64))
    assert scales == pytest.approx([2.0] * n, rel=0.05)
