"""A learned car as a vectorised environment of stable-baselines3, with the task of the real car.

Start states of a training are drawn from the task and from recorded states with their past commands. An episode ends
after the task's ticks, at the task's termination, or when the safety gate would stop a real car; no reward follows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor

from carlab.core.errors import ConfigError, DataError
from carlab.core.geofence import can_stop_inside_batch, stopping_distance_m
from carlab.core.observation import ACTION_SIZE, decode_state, encode, feature_size
from carlab.core.safety import SafetyEnvelope
from carlab.core.task import Task
from learning.rollouts import RolloutModel

FEATURE_UNITS = (2.0, 2.0, 1.0, 1.0, 2.0, 1.0, 4.0)
"""Units of x, y [m], sine, cosine, vx, vy [m/s] and yaw rate [rad/s] in a policy's inputs."""
REWARD_SCALE = 10.0
MAX_POLICY_INPUT = 10.0
"""Clip of a policy's inputs, in these units."""


def policy_inputs(features: Any) -> NDArray[np.float32]:
    """A policy's inputs for features (..., 7 + 2 H): scaled by ``FEATURE_UNITS`` and clipped."""
    inputs = np.array(features, dtype=np.float32)
    inputs[..., : len(FEATURE_UNITS)] /= np.array(FEATURE_UNITS, dtype=np.float32)
    return np.clip(inputs, -MAX_POLICY_INPUT, MAX_POLICY_INPUT)


def policy_spaces(width: int) -> tuple[gym.spaces.Box, gym.spaces.Box]:
    """Spaces of a policy's inputs (width,) and of its actions (2,)."""
    high = np.full(width, MAX_POLICY_INPUT, dtype=np.float32)
    return gym.spaces.Box(-high, high, dtype=np.float32), gym.spaces.Box(-1.0, 1.0, (ACTION_SIZE,), np.float32)


class RolloutEpisodes(NamedTuple):
    """Episodes in the learned car, on the CPU: returns (N,), constraint costs (N,) and final features (N, 7 + 2 H)."""

    returns: Tensor
    costs: Tensor
    final: Tensor


class ModelEnv(VecEnv):
    """Parallel copies of a learned car.

    Args:
        model: the learned car; with a disturbance, each episode has one particle and one path of the disturbance.
        task: reward, termination and start states, with the history of the model.
        cars: number of copies.
        recorded: features (R, 7 + 2 H) of recorded states; may be empty.
        from_recorded: share of start states from ``recorded``, unless it is empty.
        envelope: limits of the safety gate, which slews commands and stops a car that could not stop inside the arena.
        period_s: control period, for the slew limits [s].
        bonus: additional reward (cars,) for features (cars, 7 + 2 H) after a step; not part of the returns of
            ``roll_out``.
        seed: of start states, particles, noise and disturbances.
        device: of the model's tensors.

    Raises:
        ConfigError: task and model have different histories.
        DataError: recorded states have another number of features.
    """

    def __init__(
        self,
        model: RolloutModel,
        task: Task,
        cars: int,
        *,
        recorded: NDArray[np.float64] | None = None,
        from_recorded: float = 0.5,
        envelope: SafetyEnvelope | None = None,
        period_s: float = 1.0 / 30.0,
        bonus: Callable[[Tensor], Tensor] | None = None,
        seed: int = 0,
        device: torch.device | str = "cpu",
    ) -> None:
        width = feature_size(model.history)
        if task.history_length != model.history:
            raise ConfigError(
                f"The task has {task.history_length} past commands, the learned car {model.history}; use the same "
                "number."
            )
        if recorded is not None and recorded.shape[1:] != (width,):
            raise DataError(f"Recorded states have {recorded.shape[1:]} features, this car {width}; encode them again.")
        super().__init__(cars, *policy_spaces(width))
        self._model, self._task, self._device = model, task, torch.device(device)
        self._envelope = SafetyEnvelope() if envelope is None else envelope
        rates = (self._envelope.steering_rate_per_s, self._envelope.throttle_rate_per_s)
        self._slew = torch.tensor(rates, device=self._device) * period_s
        limits = (self._envelope.max_steering, self._envelope.max_throttle)
        self._limits = torch.tensor(limits, device=self._device)
        self._recorded = np.zeros((0, width)) if recorded is None else recorded
        self._from_recorded = from_recorded if len(self._recorded) else 0.0
        self._bonus = bonus
        self._own_seed = seed
        self._rng = np.random.default_rng(seed)
        self._generator = torch.Generator().manual_seed(seed)
        self._rollouts = model.rollouts(cars, self._generator)
        self._features = torch.zeros((cars, width), device=self._device)
        self._ticks = np.zeros(cars, dtype=np.int64)
        self._actions = torch.zeros((cars, ACTION_SIZE), device=self._device)
        self._arena_m = self._envelope.arena_m or task.arena_m

    def reset(self) -> NDArray[np.float32]:
        """Start all cars; returns policy inputs (cars, 7 + 2 H).

        Their episodes end at different ticks, so that no batch consists of start states.
        """
        self._start(np.arange(self.num_envs))
        self._ticks = self._rng.integers(self._task.max_ticks, size=self.num_envs)
        return self._policy_inputs()

    def step_async(self, actions: NDArray[np.float32]) -> None:
        """Store the commands (cars, 2)."""
        self._actions = torch.as_tensor(actions, dtype=torch.float32).to(self._device)

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """One step of every car; a car whose episode ends starts again.

        Returns:
            Policy inputs (cars, 7 + 2 H), rewards times ``REWARD_SCALE`` (cars,), mask of ended episodes (cars,), and
            one dictionary for each car.

        Raises:
            ConfigError: the task gives a reward or cost that is not finite in a plausible state.
        """
        before = self._features
        with torch.no_grad():
            action = self._gate(before, self._actions)
            after = self._rollouts.step(before, action, self._generator)
            reward = self._task.reward(before, action, after)
            if self._bonus is not None:
                reward = reward + self._bonus(after)
            self._check_rewards(reward, before, after)
            reward = reward * REWARD_SCALE
        here = after.cpu()
        terminated = self._task.terminated(here).numpy() | self._stopped(here)
        self._features = after
        self._ticks += 1
        seen = policy_inputs(here.numpy())
        truncated = (self._ticks >= self._task.max_ticks) & ~terminated
        done = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        ended = np.flatnonzero(done)
        for k in ended:
            infos[k] = {"terminal_observation": seen[k].copy(), "TimeLimit.truncated": bool(truncated[k])}
        if len(ended):
            seen[ended] = policy_inputs(self._start(ended))
        return seen, reward.cpu().numpy().astype(np.float32), done, infos

    def roll_out(
        self, act: Callable[[NDArray[np.float32]], NDArray[np.float32]], max_ticks: int | None = None
    ) -> RolloutEpisodes:
        """Drive one complete episode of every car by a policy, from start states of the task.

        Args:
            act: actions (cars, 2) for policy inputs (cars, 7 + 2 H).
            max_ticks: length of the episode; by default that of the task.

        Returns:
            Unscaled return, constraint cost and final features of each episode.

        Raises:
            ConfigError: the task gives a reward or cost that is not finite in a plausible state.
        """
        self._start(np.arange(self.num_envs), training=False)
        total, cost = torch.zeros(self.num_envs), torch.zeros(self.num_envs)
        ended = torch.zeros(self.num_envs, dtype=torch.bool)
        last, inputs = self._features.cpu().clone(), self._policy_inputs()
        with torch.no_grad():
            for _ in range(max_ticks or self._task.max_ticks):
                before = self._features
                action = self._gate(before, torch.as_tensor(act(inputs)).to(self._device))
                after = self._rollouts.step(before, action, self._generator)
                here = after.cpu()
                reward, step_cost = self._task.reward(before, action, after), self._task.cost(here)
                reward, step_cost = (torch.where(ended, 0.0, value) for value in (reward.cpu(), step_cost))
                self._check_rewards(reward - step_cost, before, after)
                total += reward
                cost += step_cost
                last = torch.where(ended[:, None], last, here)
                ended |= torch.from_numpy(self._stopped(here)) | self._task.terminated(here)
                self._features, inputs = after, policy_inputs(here.numpy())
        return RolloutEpisodes(total, cost, last)

    @property
    def features(self) -> Tensor:
        """Current features (cars, 7 + 2 H)."""
        return self._features

    def _gate(self, features: Tensor, requested: Tensor) -> Tensor:
        """Commands (cars, 2) that the safety gate would send after the previous ones (``carlab.core.safety.slew``)."""
        requested = torch.minimum(torch.maximum(requested, -self._limits), self._limits)
        if not self._model.history:
            return requested
        previous = features[:, -ACTION_SIZE:]
        previous = torch.where(requested * previous < 0.0, 0.0, previous)
        slewed = torch.minimum(torch.maximum(requested, previous - self._slew), previous + self._slew)
        return torch.where(requested.abs() <= previous.abs(), requested, slewed)

    def _check_rewards(self, rewards: Tensor, before: Tensor, after: Tensor) -> None:
        """Raise ConfigError if a reward (cars,) is not finite although the car's state (cars, 7 + 2 H) is plausible.

        A policy that is trained with such a reward diverges. States beyond the clip of the policy's inputs are those of
        a learned car that has diverged.
        """
        if bool(torch.isfinite(rewards).all()):
            return
        features = np.stack([before.cpu().numpy(), after.cpu().numpy()])
        plausible = (np.abs(policy_inputs(features)) < MAX_POLICY_INPUT).all(axis=(0, 2))
        wrong = np.flatnonzero(plausible & ~torch.isfinite(rewards).cpu().numpy())
        if not len(wrong):
            return
        x, y, yaw, vx, vy, yaw_rate = decode_state(after[int(wrong[0])].cpu()).tolist()
        raise ConfigError(
            f"The task {self._task.name} gives a reward or cost that is not finite, in the learned car at x {x:.3g} m, "
            f"y {y:.3g} m, yaw {yaw:.3g} rad, vx {vx:.3g} m/s, vy {vy:.3g} m/s, yaw rate {yaw_rate:.3g} rad/s; avoid a "
            "division by zero or a root of a negative number."
        )

    def _stopped(self, features: Tensor) -> NDArray[np.bool_]:
        """Mask (cars,) of the cars that the gate stops: too fast, or unable to stop inside the arena; on the CPU."""
        state = decode_state(features).numpy()
        speed = np.hypot(state[:, 3], state[:, 4])
        course = state[:, 2] + np.arctan2(state[:, 4], state[:, 3])
        needed = stopping_distance_m(speed, self._envelope.reaction_s, self._envelope.deceleration_mps2)
        stopped: NDArray[np.bool_] = ~(speed <= self._envelope.max_speed_mps)
        if self._arena_m:
            stopped |= ~can_stop_inside_batch(self._arena_m, state[:, :2], course, needed)
        return stopped

    def _start(self, cars: NDArray[np.int64], *, training: bool = True) -> NDArray[np.float32]:
        """Start new episodes of cars (indices), for a training or as on the car; returns their features."""
        sample = self._task.sample_training_start if training else self._task.sample_start
        starts = np.array([sample(self._rng).to_array() for _ in cars])
        rows = encode(starts, np.zeros((len(cars), self._model.history, ACTION_SIZE)))
        use_recorded = self._rng.random(len(cars)) < (self._from_recorded if training else 0.0)
        if use_recorded.any():
            rows[use_recorded] = self._recorded[self._rng.integers(len(self._recorded), size=int(use_recorded.sum()))]
        start_features = torch.from_numpy(rows).float()
        features = self._features.clone()
        features[torch.from_numpy(cars).to(self._device)] = start_features.to(self._device)
        self._features = features
        self._rollouts.restart(torch.from_numpy(cars), self._generator)
        self._ticks[cars] = 0
        array: NDArray[np.float32] = start_features.numpy()
        return array

    def _policy_inputs(self) -> NDArray[np.float32]:
        return policy_inputs(self._features.cpu().numpy())

    def close(self) -> None:
        """Do nothing: the environment holds no resources."""

    def restore_seed(self) -> None:
        """Seed with the number given at construction, after an agent of stable-baselines3 has set its seed."""
        self.seed(self._own_seed)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed start states, particles and noise."""
        if seed is not None:
            self._rng = np.random.default_rng(seed)
            self._generator.manual_seed(seed)
        return [seed] * self.num_envs

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute of the environment, repeated for each requested car."""
        return [getattr(self, attr_name, None)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of all cars."""
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Call a method of the environment once; its result is repeated for each requested car."""
        result = getattr(self, method_name)(*method_args, **method_kwargs)
        return [result] * len(list(self._get_indices(indices)))

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]], indices: Any = None) -> list[bool]:
        """False for each requested car."""
        return [False] * len(list(self._get_indices(indices)))
