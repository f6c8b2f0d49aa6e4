"""SAC in the learned car: training, files, and the policy that drives the car."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from torch import Tensor

from carlab.core.errors import CarlabError, DataError, DivergedError
from carlab.core.observation import STATE_FEATURES
from carlab.core.policy import PolicyInput
from carlab.core.quantities import Action
from learning.networks.array_file import read_arrays, whole_number, write_arrays
from learning.policy.sac import FastSac
from learning.world.model_env import ModelEnv, policy_inputs, policy_spaces

AGENT_FILE = "policy.npz"
EARLIER_AGENT_FILE = "agent.zip"
FILE_VERSION = 1
MAX_OBSERVATION_SIZE = 1000
UNLIMITED_STEPS = 2**62
"""A number of steps that no training reaches; callbacks end it."""
DIVERGED = "The policy diverged; train it with a smaller learning rate."


@dataclass(frozen=True, slots=True)
class SacSettings:
    """Settings of the training of a policy.

    Attributes:
        hidden: widths of the hidden layers of policy and critics.
        cars: copies of the learned car that run at once.
        ticks_between: ticks of all copies between updates.
        updates: gradient steps after those ticks.
        batch: transitions of a gradient step.
        replay: size of the replay buffer [transitions].
        warm_up: transitions before the first update; with random actions if there is no earlier policy.
        discount: discount factor of a tick at 30 Hz; a caller sets it for other rates.
        learning_rate: step size of the optimiser.
        target_rate: rate of the target networks' moving average.
        temperature: initial entropy coefficient.
        target_entropy: target entropy of the action [nat].
        steps_ahead: number of rewards in an n-step return.
    """

    hidden: tuple[int, ...] = (64, 64)
    cars: int = 128
    ticks_between: int = 4
    updates: int = 32
    batch: int = 256
    replay: int = 100_000
    warm_up: int = 4096
    discount: float = 0.99
    learning_rate: float = 1e-3
    target_rate: float = 0.01
    temperature: float = 1.0
    target_entropy: float = -2.0
    steps_ahead: int = 5


class SacAgent:
    """A policy trained in a ``ModelEnv``. A new agent is untrained; ``load`` reads a trained one."""

    def __init__(self, settings: SacSettings, seed: int, device: torch.device | str = "cpu") -> None:
        self._settings, self._seed, self._device = settings, seed, device
        self._sac: FastSac | None = None

    def train(
        self,
        env: ModelEnv,
        updates: int,
        progress: Callable[[int], None] = lambda done: None,
        evaluate: Callable[[SacAgent], float] | None = None,
        n_evaluations: int = 5,
    ) -> dict[str, float]:
        """Train from the current networks and optimiser state, with an empty replay buffer.

        Args:
            env: the environment.
            updates: gradient steps.
            progress: called with the number of gradient steps done.
            evaluate: score of a policy. An earlier policy and ``n_evaluations`` equally spaced policies, including the
                last one, are evaluated; the best one is kept with its temperature and optimiser state.
            n_evaluations: number of evaluations during the training.

        Returns:
            Figures of the last gradient step.

        Raises:
            DivergedError: the policy diverged; the earlier policy is kept.
            DataError: the earlier policy has another observation space.
            ConfigError: a reward or cost of the task is not finite; the earlier policy is kept.
        """
        earlier = self._sac
        sac = self._learner(env, earlier)
        best = _Best()

        def check() -> None:
            if not all(bool(torch.isfinite(p).all()) for p in sac.policy.parameters()):
                raise DivergedError(DIVERGED)
            if evaluate is not None:
                best.offer(evaluate(self), sac)

        parts = n_evaluations if evaluate is not None else 1
        milestones = [updates * (part + 1) // parts for part in range(parts)]
        self._sac = sac
        try:
            if earlier is not None:
                check()
            sac.learn(self._settings.warm_up, log_interval=UNLIMITED_STEPS)
            sac.gradient_steps = self._settings.updates
            callback = _Milestones(milestones, progress, check)
            sac.learn(UNLIMITED_STEPS, callback=callback, log_interval=UNLIMITED_STEPS, reset_num_timesteps=False)
        except BaseException as error:
            self._sac = earlier
            is_refusal = isinstance(error, ValueError) and not isinstance(error, CarlabError)
            if is_refusal and "nan" in str(error):  # torch's distributions refuse NaN.
                raise DivergedError(DIVERGED) from error
            raise
        if best.state is not None:
            sac.load_learned_state(best.state)
        return {name: float(value) for name, value in sac.logger.name_to_value.items()}

    def _learner(self, env: ModelEnv, earlier: FastSac | None) -> FastSac:
        """Learner for this environment, with the networks, temperature and optimiser state of ``earlier`` if given."""
        if earlier is not None and earlier.observation_space != env.observation_space:
            raise DataError("The earlier policy has another shape; remove its folder to train again.")
        s = self._settings
        sac = FastSac(
            "MlpPolicy", env, learning_rate=s.learning_rate, buffer_size=s.replay, batch_size=s.batch,
            learning_starts=0 if earlier is not None else s.warm_up, tau=s.target_rate, gamma=s.discount,
            train_freq=(s.ticks_between, "step"), gradient_steps=0, ent_coef=f"auto_{s.temperature}",
            target_entropy=s.target_entropy, n_steps=s.steps_ahead, policy_kwargs={"net_arch": list(s.hidden)},
            seed=self._seed, device=self._device,
        )  # fmt: skip
        if earlier is not None:
            sac.load_learned_state(earlier.learned_state())
        sac.set_logger(Logger(None, []))
        env.restore_seed()
        return sac

    @property
    def observation_size(self) -> int:
        """Number of features that the policy observes."""
        assert self._sac is not None
        return int((self._sac.observation_space.shape or (0,))[0])

    def policy(self) -> SacPolicy:
        """The policy that drives: the mean action, without noise."""
        assert self._sac is not None
        return SacPolicy(self._sac)

    def act(self, observations: NDArray[np.float32]) -> NDArray[np.float32]:
        """Mean actions (N, 2) for observations (N, F)."""
        assert self._sac is not None
        actions: NDArray[np.float32] = self._sac.predict(observations, deterministic=True)[0]
        return actions

    def widen(self, observation_size: int) -> None:
        """Observe more past commands, with zero weights: the policy acts as before until it is trained again.

        Args:
            observation_size: number of features; not below the current one.
        """
        assert self._sac is not None
        if observation_size <= self.observation_size:
            return
        wider = _without_environment(observation_size, self._settings, self._seed)
        state, wider_state = self._sac.learned_state(), wider.learned_state()
        for name, value in state.items():
            target = wider_state[name]
            if isinstance(value, Tensor) and isinstance(target, Tensor):
                for old, new in zip(self._sac.layers_of(name, value), wider.layers_of(name, target), strict=True):
                    new.copy_(_with_zeros(old, new))
            else:
                wider_state[name] = value
        wider.load_learned_state(wider_state)
        self._sac = wider

    def save(self, folder: Path) -> None:
        """Write networks, temperature and optimiser state into a folder. Raises OSError if the disk is full."""
        assert self._sac is not None
        header = {"version": FILE_VERSION, "observation_size": self.observation_size}
        write_arrays(folder / AGENT_FILE, header | self._sac.learned_state())

    @classmethod
    def load(cls, folder: Path, settings: SacSettings, seed: int, device: torch.device | str = "cpu") -> SacAgent:
        """Read an agent that was saved with the same layer widths.

        The agent acts on the CPU until it is trained again on ``device``, so that a car's policy has low latency.

        Raises:
            DataError: the file is missing, broken, of an earlier version or of another shape. Its content is not run.
        """
        if (folder / EARLIER_AGENT_FILE).exists() and not (folder / AGENT_FILE).exists():
            raise DataError(
                f"{folder / EARLIER_AGENT_FILE} is a policy of an earlier version of carlab, whose format may run code "
                f"and is not read; remove the folders in {folder.parent} to train again."
            )
        try:
            arrays = read_arrays(folder / AGENT_FILE)
            version, width = (whole_number(arrays, name) for name in ("version", "observation_size"))
            if version != FILE_VERSION or not 0 < width <= MAX_OBSERVATION_SIZE:
                raise DataError(f"it has version {version} and {width} features")
            agent = cls(settings, seed, device)
            agent._sac = _without_environment(width, settings, seed)
            agent._sac.load_learned_state(agent._sac.checked_state(arrays))
        except DataError as error:
            raise DataError(
                f"The policy in {folder} cannot be read ({error}); use an earlier model of the run, or remove the "
                "folder to train again."
            ) from error
        return agent


def _with_zeros(value: Tensor, shape_of: Tensor) -> Tensor:
    """A tensor with zeros for further past commands, which precede the earlier ones, in the shape of another."""
    for axis, (old, new) in enumerate(zip(value.shape, shape_of.shape, strict=True)):
        if old != new:
            zeros = torch.zeros_like(value.narrow(axis, 0, 1)).repeat_interleave(new - old, dim=axis)
            state = value.narrow(axis, 0, STATE_FEATURES)
            rest = value.narrow(axis, STATE_FEATURES, old - STATE_FEATURES)
            value = torch.cat([state, zeros, rest], dim=axis)
    return value


def _without_environment(observation_size: int, settings: SacSettings, seed: int) -> FastSac:
    """An untrained agent on the CPU without an environment."""
    hidden = {"net_arch": list(settings.hidden)}
    sac = FastSac(
        "MlpPolicy", cast(Any, None), buffer_size=1, target_entropy=settings.target_entropy, policy_kwargs=hidden,
        seed=seed, device="cpu", _init_setup_model=False,
    )  # fmt: skip
    sac.observation_space, sac.action_space = policy_spaces(observation_size)
    sac.n_envs = 1
    sac._setup_model()
    return sac


@dataclass
class _Best:
    """The learned state with the highest score so far."""

    score: float = -math.inf
    state: dict[str, Tensor | int] | None = None

    def offer(self, score: float, sac: FastSac) -> None:
        """Keep a copy of the state of ``sac`` if its score is the highest."""
        if score > self.score:
            self.score, self.state = score, sac.learned_state()


@dataclass
class SacPolicy:
    """The trained policy on a car."""

    sac: FastSac
    name: str = "sac"

    def reset(self) -> None:
        """Do nothing: the policy has no state, and its observation holds the past commands."""

    def act(self, view: PolicyInput) -> Action | None:
        """The mean action."""
        action: Any = self.sac.predict(policy_inputs(view.features)[None], deterministic=True)[0][0]
        return Action.from_array(action.astype(np.float64))


class _Milestones(BaseCallback):
    """Checks the policy after given numbers of gradient steps, and ends training after the last check.

    Checks take place between two ticks. stable-baselines3 drops the tick in which a callback ends training; the replay
    buffer would join the ticks before and after it.
    """

    def __init__(self, milestones: list[int], progress: Callable[[int], None], check: Callable[[], None]) -> None:
        super().__init__()
        self._milestones, self._progress, self._check = milestones, progress, check

    def _on_rollout_start(self) -> None:
        model = self.model
        assert isinstance(model, FastSac)
        done = int(model._n_updates)
        self._progress(done)
        while self._milestones and done >= self._milestones[0]:
            self._milestones.pop(0)
            self._check()

    def _on_step(self) -> bool:
        return bool(self._milestones)
