"""SAC in a learned world: trained for so many steps, kept from episode to episode, and as a policy on the car."""

from __future__ import annotations

import copy
import io
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger

from carlab.core.errors import DataError, DivergedError
from carlab.core.policy import PolicyInput
from carlab.core.quantities import Action
from learning.model_env import ModelEnv, policy_view
from learning.sac import FastSac

AGENT_FILE = "agent.zip"
MOMENTS_FILE = "moments.pt"
NEVER = 2**62
DIVERGED = "The policy diverged; train it with a smaller learning rate."
_BROKEN = (
    *(OSError, ValueError, LookupError, RuntimeError, EOFError, AssertionError, TypeError, AttributeError),
    pickle.UnpicklingError,
)
_NO_REPLAY: dict[str, Any] = {"replay_buffer_class": None, "replay_buffer_kwargs": {}, "buffer_size": 1, "n_steps": 1}
"""An agent that is read drives, or gives its networks to one that learns."""


@dataclass(frozen=True, slots=True)
class SacSettings:
    """How a policy is trained.

    Attributes:
        hidden: widths of the layers of policy and critics.
        cars: copies of the learned car at once.
        ticks_between: ticks of all copies between updates.
        updates: gradient steps after each of those.
        batch: transitions of a gradient step.
        replay: transitions kept.
        warm_up: transitions before the first update, by a random policy where there is none yet.
        discount, learning_rate, target_rate: of SAC.
        temperature: at the start.
        target_entropy: of a policy's action [nat].
        steps_ahead: rewards that are summed before a critic is asked.
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
    """A policy that learns in a ``ModelEnv``. It starts untrained; ``load`` takes up an earlier one."""

    def __init__(self, settings: SacSettings, seed: int, device: torch.device | str = "cpu") -> None:
        self._settings, self._seed, self._device = settings, seed, device
        self._sac: FastSac | None = None

    def train(
        self,
        env: ModelEnv,
        updates: int,
        progress: Callable[[int], None] = lambda done: None,
        judge: Callable[[SacAgent], float] | None = None,
        judged: int = 5,
    ) -> dict[str, float]:
        """Make so many gradient steps in this world; what was learned before stays, the replay does not.

        Args:
            env: the world.
            updates: gradient steps.
            progress: told the gradient steps done.
            judge: says how good the policy is; of those at ``judged`` even distances, the last one among them, the best
                is kept, temperature and moments with it.
            judged: how often it is asked.

        Returns:
            Figures of the last gradient step.

        Raises:
            DivergedError: the policy diverged; the one before is kept.
            DataError: the earlier policy has another shape.
        """
        s = self._settings
        again = self._sac
        if again is not None and (
            again.policy.net_arch != list(s.hidden) or again.observation_space != env.observation_space
        ):
            raise DataError("The earlier policy has another shape; remove its folder, and it is trained anew.")
        made = FastSac(
            "MlpPolicy", env, learning_rate=s.learning_rate, buffer_size=s.replay, batch_size=s.batch,
            learning_starts=0 if again is not None else s.warm_up, tau=s.target_rate, gamma=s.discount,
            train_freq=(s.ticks_between, "step"), gradient_steps=0, ent_coef=f"auto_{s.temperature}",
            target_entropy=s.target_entropy, n_steps=s.steps_ahead, policy_kwargs={"net_arch": list(s.hidden)},
            seed=self._seed, device=self._device,
        )  # fmt: skip
        if again is not None:
            made.policy.load_state_dict(again.policy.state_dict())
            made.load_optimiser_state(again.optimiser_state())
            assert made.log_ent_coef is not None
            assert again.log_ent_coef is not None
            made.log_ent_coef.data.copy_(again.log_ent_coef.data)
        made.set_logger(Logger(None, []))
        env.seed_anew()
        temperature_log = made.log_ent_coef
        assert temperature_log is not None
        best, kept = -np.inf, None
        parts = judged if judge is not None else 1

        def look() -> None:
            nonlocal best, kept
            if not all(bool(torch.isfinite(p).all()) for p in made.policy.parameters()):
                raise DivergedError(DIVERGED)
            if judge is not None and (value := judge(self)) > best:
                kept = copy.deepcopy((made.policy.state_dict(), temperature_log.data, made.optimiser_state()))
                best = value

        self._sac = made
        try:
            made.learn(s.warm_up, log_interval=NEVER)
            made.gradient_steps = s.updates
            watch = _Watch([updates * (part + 1) // parts for part in range(parts)], progress, look)
            made.learn(NEVER, callback=watch, log_interval=NEVER, reset_num_timesteps=False)
        except BaseException as error:
            self._sac = again
            if isinstance(error, ValueError) and "nan" in str(error):  # torch's distributions refuse what is no number.
                raise DivergedError(DIVERGED) from error
            raise
        if kept is not None:
            networks, temperature, moments = kept
            made.policy.load_state_dict(networks)
            temperature_log.data.copy_(temperature)
            made.load_optimiser_state(moments)
        return {name: float(value) for name, value in made.logger.name_to_value.items()}

    def policy(self) -> SacPolicy:
        """What drives: the mean action, without noise."""
        assert self._sac is not None
        return SacPolicy(self._sac)

    def act(self, seen: NDArray[np.float32]) -> NDArray[np.float32]:
        """Mean actions (N, 2) for views (N, F)."""
        assert self._sac is not None
        found: NDArray[np.float32] = self._sac.predict(seen, deterministic=True)[0]
        return found

    def save(self, folder: Path) -> None:
        """Write the agent and its optimisers into a folder. Raises OSError where the disk is full."""
        assert self._sac is not None
        agent, moments = io.BytesIO(), io.BytesIO()
        self._sac.save(agent, exclude=["env", "replay_buffer"])
        torch.save(self._sac.optimiser_state(), moments)
        (folder / AGENT_FILE).write_bytes(agent.getvalue())
        (folder / MOMENTS_FILE).write_bytes(moments.getvalue())

    @classmethod
    def load(cls, folder: Path, settings: SacSettings, seed: int, device: torch.device | str = "cpu") -> SacAgent:
        """Take up an agent. Raises DataError where its files are of another shape or broken.

        Until it is trained again, on ``device``, it acts on the CPU: what drives a car waits for no other device.
        """
        found = cls(settings, seed, device)
        try:
            found._sac = FastSac.load(folder / AGENT_FILE, device="cpu", custom_objects=_NO_REPLAY)
            found._sac.load_optimiser_state(torch.load(folder / MOMENTS_FILE, weights_only=True, map_location="cpu"))
        except _BROKEN as error:
            raise DataError(
                f"The policy in {folder} cannot be read ({error}); remove the folder, and it is trained anew."
            ) from error
        return found


@dataclass
class SacPolicy:
    """The trained policy on a car."""

    sac: FastSac
    name: str = "sac"

    def reset(self) -> None:
        """A policy of this kind has no memory; the commands it needs are in what it sees."""

    def act(self, view: PolicyInput) -> Action | None:
        """The mean action."""
        action: Any = self.sac.predict(policy_view(view.features)[None], deterministic=True)[0][0]
        return Action.from_array(action.astype(np.float64))


class _Watch(BaseCallback):
    """Looks at the policy after so many gradient steps, and ends training after the last look.

    It looks between two ticks of the world. stable-baselines3 forgets the tick in which a callback ends it, and a
    replay that goes on after that would hold two ticks as one.
    """

    def __init__(self, goals: list[int], progress: Callable[[int], None], look: Callable[[], None]) -> None:
        super().__init__()
        self._goals, self._progress, self._look = goals, progress, look

    def _on_rollout_start(self) -> None:
        model = self.model
        assert isinstance(model, FastSac)
        done = int(model._n_updates)
        self._progress(done)
        while self._goals and done >= self._goals[0]:
            self._goals.pop(0)
            self._look()

    def _on_step(self) -> bool:
        return bool(self._goals)


__all__ = ["SacAgent", "SacPolicy", "SacSettings"]
