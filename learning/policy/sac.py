"""Soft actor-critic of stable-baselines3 with the gradient step written out: same update, a fraction of the time.

At the sizes of a small car's networks nearly all of a step of stable-baselines3 is bookkeeping: autograd's tape, one
optimiser call for each matrix, one copy for each figure that is logged. Here both critics are one batched network,
every network is one tensor of numbers, and the derivatives (Haarnoja et al., "Soft Actor-Critic Algorithms and
Applications", arXiv 1812.05905, equations 6, 9 and 18) are taken by hand. Policy, replay, collecting and files are
those of stable-baselines3, whose modules hold views of the same memory.
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
from learning.devices import denormals_flushed
from learning.networks.adam import Adam
from learning.networks.array_file import checked_tensor, whole_number
from learning.networks.particles import Layers, Network, Pullback

_SQUASH = 1e-6
"""Added under the logarithm of tanh's derivative, as stable-baselines3 does."""
_HALF_LOG_TWO_PI = 0.5 * math.log(2.0 * math.pi)


class _Batch(NamedTuple):
    """Rows of a gradient step.

    Attributes:
        views: now, and then afterwards (2 N, F).
        taken: views now and the actions then (N, F + A).
        kept: discount of what is afterwards, 0 at an end (N, 1).
        reward: (N, 1).
        noise: of the actions at both views (2 N, A).
        unlikely: negative logarithm of its density (2 N,).
    """

    views: Tensor
    taken: Tensor
    kept: Tensor
    reward: Tensor
    noise: Tensor
    unlikely: Tensor


@dataclass
class _Flat:
    """Some networks of one shape as one tensor (L, P), which their modules see as views."""

    network: Network
    numbers: Tensor
    layers: Layers = field(init=False)
    adam: Adam = field(init=False)

    def __post_init__(self) -> None:
        self.layers, self.adam = self.network.split(self.numbers), Adam(self.numbers)

    def __call__(self, inputs: Tensor) -> tuple[Tensor, Pullback]:
        """Outputs (L, N, O) and their derivative."""
        return self.network.through(self.layers, inputs)


class FastSac(SAC):
    """``stable_baselines3.SAC`` for small perceptrons with ReLUs; ``train`` makes the same steps faster."""

    def _setup_model(self) -> None:
        super()._setup_model()
        policy = self.policy
        plain = policy.features_extractor_class is FlattenExtractor and policy.activation_fn is nn.ReLU
        if not plain or self.use_sde or self.log_ent_coef is None:
            raise ConfigError("FastSac takes ReLU perceptrons and a learned temperature; use stable_baselines3.SAC.")
        actor = policy.actor
        heads = [[m for head in (actor.mu, actor.log_std) for m in _linear(cast(nn.Module, head))]]
        self._actor = _flattened([[[m] for m in _linear(actor.latent_pi)] + heads])
        self._critics = _flattened([[[m] for m in _linear(q)] for q in policy.critic.q_networks])
        self._targets = _flattened([[[m] for m in _linear(q)] for q in policy.critic_target.q_networks])
        self._temperature = Adam(self.log_ent_coef.detach())

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Make so many gradient steps on batches of the replay buffer."""
        assert self.replay_buffer is not None
        assert self.log_ent_coef is not None
        rate = float(self.lr_schedule(self._current_progress_remaining))
        self.logger.record("train/learning_rate", rate)
        with torch.no_grad(), denormals_flushed():
            rows = self.replay_buffer.sample(gradient_steps * batch_size, env=self._vec_normalize_env)
            noise = torch.randn((gradient_steps, 2 * batch_size, rows.actions.shape[1])).to(self.device)
            unlikely = 0.5 * noise.square().sum(dim=2) + noise.shape[2] * _HALF_LOG_TWO_PI
            discounts = self.gamma if rows.discounts is None else rows.discounts
            kept = (1.0 - rows.dones) * discounts
            seen, after = (v.view(gradient_steps, batch_size, -1) for v in (rows.observations, rows.next_observations))
            taken = torch.cat([rows.observations, rows.actions], dim=1)
            fields = (torch.split(f, batch_size) for f in (taken, kept, rows.rewards))
            found: dict[str, Tensor] = {}
            views = torch.cat([seen, after], dim=1)
            for step, batch in enumerate(zip(views, *fields, noise, unlikely, strict=True)):
                losses = self._gradient_step(_Batch(*batch), rate, last=step + 1 == gradient_steps)
                found = losses or found
                if step % self.target_update_interval == 0:
                    self._targets.numbers.lerp_(self._critics.numbers, self.tau)
        self._n_updates += gradient_steps
        for name, value in found.items():
            self.logger.record(f"train/{name}", float(value))
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")

    def learned_state(self) -> dict[str, Tensor | int]:
        """A copy of networks, temperature and optimiser state, on the CPU: what a saved policy needs to train on."""
        assert self.log_ent_coef is not None
        state: dict[str, Tensor | int] = {
            f"policy/{name}": value.detach().cpu().clone() for name, value in self.policy.state_dict().items()
        }
        state["log_temperature"] = self.log_ent_coef.detach().cpu().clone()
        for adam_name, adam in self._adams().items():
            state |= {f"{adam_name}/{name}": value for name, value in adam.state().items()}
        return state

    def load_learned_state(self, state: Mapping[str, Tensor | int]) -> None:
        """Take over what ``learned_state`` of an agent of the same shape returned."""
        assert self.log_ent_coef is not None
        self.policy.load_state_dict({name: state[f"policy/{name}"] for name in self.policy.state_dict()})
        self.log_ent_coef.data.copy_(torch.as_tensor(state["log_temperature"]))
        for adam_name, adam in self._adams().items():
            adam.load({name: state[f"{adam_name}/{name}"] for name in adam.state()})

    def checked_state(self, arrays: Mapping[str, NDArray[np.generic]]) -> dict[str, Tensor | int]:
        """The state in arrays of a file. Raises DataError where one is missing or does not fit this agent."""
        return {
            name: checked_tensor(arrays, name, tuple(own.shape))
            if isinstance(own, Tensor)
            else whole_number(arrays, name)
            for name, own in self.learned_state().items()
        }

    def _adams(self) -> dict[str, Adam]:
        return {"actor": self._actor.adam, "critics": self._critics.adam, "temperature": self._temperature}

    def _gradient_step(self, batch: _Batch, rate: float, *, last: bool) -> dict[str, Tensor]:
        """One step of temperature, critics and actor; of the ``last`` the temperature and the losses."""
        count, width = len(batch.taken), batch.noise.shape[1]
        heads, through_actor = self._actor(batch.views[None])
        mean, raw_log_std = heads[0, :, :width], heads[0, :, width:]
        log_std = raw_log_std.clamp(LOG_STD_MIN, LOG_STD_MAX)
        swing = log_std.exp() * batch.noise
        action = torch.tanh(mean + swing)
        slope = 1.0 - action * action
        log_density = -(log_std + torch.log(slope + _SQUASH)).sum(dim=1) - batch.unlikely

        temperature = self._temperature.numbers.exp()
        self._temperature.step(-(log_density[:count].mean() + float(self.target_entropy)).view(1), rate)

        chosen = torch.cat([batch.views, action], dim=1)
        worth = self._targets(chosen[count:])[0].amin(dim=0)
        worth = worth - (temperature * log_density[count:])[:, None]
        wanted = batch.reward + batch.kept * worth
        values, through_critics = self._critics(batch.taken)
        off = values - wanted
        self._critics.adam.step(through_critics(off / count), rate)

        values, through_critics = self._critics(chosen[:count])
        least, which = values.min(dim=0, keepdim=True)
        of_least = torch.zeros_like(values).scatter_(0, which, -1.0 / count)
        by_action = through_critics.on_inputs(of_least).sum(dim=0)[:, -width:]
        # The logarithm of the density by what tanh is given, its noise held fixed.
        now, bent, raw = action[:count], slope[:count], raw_log_std[:count]
        scale = temperature / count
        by_mean = bent * (by_action + scale * (2.0 * now / (bent + _SQUASH)))
        by_log_std = (by_mean * swing[:count] - scale) * ((raw >= LOG_STD_MIN) & (raw <= LOG_STD_MAX))
        own = torch.cat([by_mean, by_log_std], dim=1)[None]
        self._actor.adam.step(through_actor.of_first(count)(own), rate)
        if not last:
            return {}
        return {
            "ent_coef": temperature,
            "actor_loss": (temperature * log_density[:count]).mean() - least.mean(),
            "critic_loss": 0.5 * (off * off).mean(dim=1).sum(),
        }


def _linear(module: nn.Module) -> list[nn.Linear]:
    return [m for m in module.modules() if isinstance(m, nn.Linear)]


def _flattened(networks: Iterable[list[list[nn.Linear]]]) -> _Flat:
    """Move the numbers of equal networks into one tensor and let their modules see them there.

    Args:
        networks: of each the layers; linear maps of the same input stand in one layer, side by side.
    """
    networks = list(networks)
    first = networks[0]
    hidden = tuple(sum(m.out_features for m in layer) for layer in first[:-1])
    shape = Network(first[0][0].in_features, sum(m.out_features for m in first[-1]), hidden, slope=0.0)
    like = first[0][0].weight
    numbers = torch.empty((len(networks), shape.parameters), dtype=like.dtype, device=like.device)
    for k, layers in enumerate(networks):
        for (weights, biases), layer in zip(shape.split(numbers), layers, strict=True):
            begin = 0
            for linear in layer:
                own = slice(begin, begin + linear.out_features)
                for parameter, place in ((linear.weight, weights[k][:, own].T), (linear.bias, biases[k, 0, own])):
                    place.copy_(parameter.data)
                    parameter.data = place
                begin = own.stop
    return _Flat(shape, numbers)


__all__ = ["FastSac"]
