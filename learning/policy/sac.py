"""Soft actor-critic of stable-baselines3 with explicit gradients: the same update in a fraction of the time.

For networks of this size, overhead dominates a step of stable-baselines3: autograd's tape, one optimiser call for each
matrix, one copy for each logged figure. Here both critics are one batched network, the parameters of each network are
one tensor, and the derivatives (Haarnoja et al., "Soft Actor-Critic Algorithms and Applications", arXiv 1812.05905,
equations 6, 9 and 18) are explicit. Policy, replay buffer and rollouts are those of stable-baselines3, whose modules
hold views of the same memory.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import SAC
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.sac.policies import LOG_STD_MAX, LOG_STD_MIN
from torch import Tensor, nn

from carlab.core.errors import ConfigError
from learning.devices import CapturedFunction, can_capture, denormals_flushed
from learning.networks.adam import Adam
from learning.networks.array_file import checked_tensor, whole_number
from learning.networks.particles import Layers, Network, Pullback
from learning.networks.uncompiled_optimisers import uncompiled_optimisers

_LOG_OFFSET = 1e-6
"""Offset inside the logarithm of tanh's derivative, as in stable-baselines3."""
_HALF_LOG_TWO_PI = 0.5 * math.log(2.0 * math.pi)


class _Batch(NamedTuple):
    """Transitions of a gradient step.

    Attributes:
        observations: before the transitions, followed by those after them (2 N, F).
        state_actions: observations and recorded actions before the transitions (N, F + A).
        discount: of the next value, 0 at a termination (N, 1).
        reward: (N, 1).
        noise: standard normal noise of the policy's actions at the observations (2 N, A).
        noise_nll: negative log density of the noise (2 N,).
    """

    observations: Tensor
    state_actions: Tensor
    discount: Tensor
    reward: Tensor
    noise: Tensor
    noise_nll: Tensor


@dataclass
class _StackedNetworks:
    """Networks of one shape as one tensor (L, P); the parameters of their modules are views of it."""

    network: Network
    parameters: Tensor
    layers: Layers = field(init=False)
    adam: Adam = field(init=False)

    def __post_init__(self) -> None:
        self.layers, self.adam = self.network.split(self.parameters), Adam(self.parameters)

    def __call__(self, inputs: Tensor) -> tuple[Tensor, Pullback]:
        """Outputs (L, N, O) and their derivative."""
        return self.network.through(self.layers, inputs)


class FastSac(SAC):
    """``stable_baselines3.SAC`` for small ReLU networks, with a faster ``train``.

    Raises:
        ConfigError: another feature extractor or activation, state-dependent exploration, or a fixed temperature.
    """

    def _setup_model(self) -> None:
        with uncompiled_optimisers():
            super()._setup_model()
        policy = self.policy
        plain = policy.features_extractor_class is FlattenExtractor and policy.activation_fn is nn.ReLU
        if not plain or self.use_sde or self.log_ent_coef is None:
            raise ConfigError("FastSac needs ReLU networks and a learned temperature; use stable_baselines3.SAC.")
        actor = policy.actor
        heads = [[m for head in (actor.mu, actor.log_std) for m in _linear(cast(nn.Module, head))]]
        self._actor = _stacked([[[m] for m in _linear(actor.latent_pi)] + heads])
        self._critics = _stacked([[[m] for m in _linear(q)] for q in policy.critic.q_networks])
        self._targets = _stacked([[[m] for m in _linear(q)] for q in policy.critic_target.q_networks])
        self._temperature = Adam(self.log_ent_coef.detach())
        self._captured: dict[tuple[float, int], CapturedFunction] = {}

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Do gradient steps on batches of the replay buffer."""
        assert self.replay_buffer is not None
        assert self.log_ent_coef is not None
        rate = float(self.lr_schedule(self._current_progress_remaining))
        self.logger.record("train/learning_rate", rate)
        with torch.no_grad(), denormals_flushed():
            rows = self.replay_buffer.sample(gradient_steps * batch_size, env=self._vec_normalize_env)
            noise = torch.randn((gradient_steps, 2 * batch_size, rows.actions.shape[1])).to(self.device)
            noise_nll = 0.5 * noise.square().sum(dim=2) + noise.shape[2] * _HALF_LOG_TWO_PI
            discount = (1.0 - rows.dones) * (self.gamma if rows.discounts is None else rows.discounts)
            pair = (v.view(gradient_steps, batch_size, -1) for v in (rows.observations, rows.next_observations))
            observations = torch.cat(list(pair), dim=1)
            state_actions = torch.cat([rows.observations, rows.actions], dim=1)
            fields = (torch.split(f, batch_size) for f in (state_actions, discount, rows.rewards))
            gradient_step = self._captured_step(rate, batch_size) if can_capture(self.device) else None
            figures: dict[str, Tensor] = {}
            for step, batch in enumerate(zip(observations, *fields, noise, noise_nll, strict=True)):
                if gradient_step is not None:
                    figures = gradient_step(*batch)
                else:
                    losses = self._gradient_step(_Batch(*batch), rate, last=step + 1 == gradient_steps)
                    figures = losses or figures
                if step % self.target_update_interval == 0:
                    self._targets.parameters.lerp_(self._critics.parameters, self.tau)
        self._n_updates += gradient_steps
        for name, value in figures.items():
            self.logger.record(f"train/{name}", float(value))
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")

    def learned_state(self) -> dict[str, Tensor | int]:
        """A copy of networks, temperature and optimiser state by name on the CPU, from which training can continue.

        Each tensor has the shape of the agent's own.
        """
        assert self.log_ent_coef is not None
        state: dict[str, Tensor | int] = {
            f"policy/{name}": value.detach().cpu().clone() for name, value in self.policy.state_dict().items()
        }
        state["log_temperature"] = self.log_ent_coef.detach().cpu().clone()
        for adam_name, adam in self._adams().items():
            state |= {f"{adam_name}/{name}": value for name, value in adam.state().items()}
        return state

    def load_learned_state(self, state: Mapping[str, Tensor | int]) -> None:
        """Load the output of ``learned_state`` of an agent of the same shape. Raises RuntimeError for another shape."""
        assert self.log_ent_coef is not None
        self.policy.load_state_dict({name: state[f"policy/{name}"] for name in self.policy.state_dict()})
        self.log_ent_coef.data.copy_(torch.as_tensor(state["log_temperature"]))
        for adam_name, adam in self._adams().items():
            adam.load({name: state[f"{adam_name}/{name}"] for name in adam.state()})

    def checked_state(self, arrays: Mapping[str, NDArray[np.generic]]) -> dict[str, Tensor | int]:
        """The state in arrays of a file. Raises DataError if one is missing or has another shape than this agent's."""
        return {
            name: checked_tensor(arrays, name, tuple(own.shape))
            if isinstance(own, Tensor)
            else whole_number(arrays, name)
            for name, own in self.learned_state().items()
        }

    def layers_of(self, name: str, value: Tensor) -> list[Tensor]:
        """Weights (L, in, out) and biases (L, 1, out) in a moment (L, P) of ``learned_state``, as views.

        Args:
            name: of the entry of the state; for one that is no moment of a network, the list has the value itself.
            value: the entry.
        """
        group, _, entry = name.partition("/")
        networks = {"actor": self._actor.network, "critics": self._critics.network}
        if group not in networks or entry not in ("mean", "square"):
            return [value]
        return [v for layer in networks[group].split(value) for v in layer]

    def _adams(self) -> dict[str, Adam]:
        return {"actor": self._actor.adam, "critics": self._critics.adam, "temperature": self._temperature}

    def _captured_step(self, rate: float, batch_size: int) -> CapturedFunction:
        """The gradient step with its figures, as a captured function of the fields of a batch."""

        def gradient_step(*batch: Tensor) -> dict[str, Tensor]:
            return self._gradient_step(_Batch(*batch), rate, last=True)

        return self._captured.setdefault((rate, batch_size), CapturedFunction(gradient_step))

    def _gradient_step(self, batch: _Batch, rate: float, *, last: bool) -> dict[str, Tensor]:
        """One step of temperature, critics and actor; returns temperature and losses of the ``last`` step."""
        count, width = len(batch.state_actions), batch.noise.shape[1]
        heads, actor_pullback = self._actor(batch.observations[None])
        mean, raw_log_std = heads[0, :, :width], heads[0, :, width:]
        log_std = raw_log_std.clamp(LOG_STD_MIN, LOG_STD_MAX)
        deviation = log_std.exp() * batch.noise
        action = torch.tanh(mean + deviation)
        slope = 1.0 - action * action
        log_density = -(log_std + torch.log(slope + _LOG_OFFSET)).sum(dim=1) - batch.noise_nll

        temperature = self._temperature.parameters.exp()
        self._temperature.step(-(log_density[:count].mean() + float(self.target_entropy)).view(1), rate)

        policy_actions = torch.cat([batch.observations, action], dim=1)
        next_value = self._targets(policy_actions[count:])[0].amin(dim=0)
        next_value = next_value - (temperature * log_density[count:])[:, None]
        target = batch.reward + batch.discount * next_value
        values, critic_pullback = self._critics(batch.state_actions)
        error = values - target
        self._critics.adam.step(critic_pullback(error / count), rate)

        values, critic_pullback = self._critics(policy_actions[:count])
        min_value, min_index = values.min(dim=0, keepdim=True)
        by_min_value = torch.zeros_like(values).scatter_(0, min_index, -1.0 / count)
        by_action = critic_pullback.on_inputs(by_min_value).sum(dim=0)[:, -width:]
        # Gradient of the actor's loss with respect to mean and log std before tanh, for fixed noise.
        now, now_slope, raw = action[:count], slope[:count], raw_log_std[:count]
        scale = temperature / count
        by_mean = now_slope * (by_action + scale * (2.0 * now / (now_slope + _LOG_OFFSET)))
        by_log_std = (by_mean * deviation[:count] - scale) * ((raw >= LOG_STD_MIN) & (raw <= LOG_STD_MAX))
        by_heads = torch.cat([by_mean, by_log_std], dim=1)[None]
        self._actor.adam.step(actor_pullback.of_first(count)(by_heads), rate)
        if not last:
            return {}
        return {
            "ent_coef": temperature,
            "actor_loss": (temperature * log_density[:count]).mean() - min_value.mean(),
            "critic_loss": 0.5 * (error * error).mean(dim=1).sum(),
        }


def _linear(module: nn.Module) -> list[nn.Linear]:
    return [m for m in module.modules() if isinstance(m, nn.Linear)]


def _stacked(networks: Iterable[list[list[nn.Linear]]]) -> _StackedNetworks:
    """Move the parameters of networks of one shape into one tensor, of which their modules become views.

    Args:
        networks: the layers of each network; a layer may hold several linear maps of the same input.
    """
    networks = list(networks)
    first = networks[0]
    hidden = tuple(sum(m.out_features for m in layer) for layer in first[:-1])
    shape = Network(first[0][0].in_features, sum(m.out_features for m in first[-1]), hidden, slope=0.0)
    like = first[0][0].weight
    flat = torch.empty((len(networks), shape.parameters), dtype=like.dtype, device=like.device)
    for k, layers in enumerate(networks):
        for (weights, biases), layer in zip(shape.split(flat), layers, strict=True):
            begin = 0
            for linear in layer:
                columns = slice(begin, begin + linear.out_features)
                views = ((linear.weight, weights[k][:, columns].T), (linear.bias, biases[k, 0, columns]))
                for parameter, view in views:
                    view.copy_(parameter.data)
                    parameter.data = view
                begin = columns.stop
    return _StackedNetworks(shape, flat)
