"""A simulated car and a task as a Gymnasium environment, with the observation and reward of real episodes.

``carlab.experiment.episodes.gym_registration`` registers ``carlab/Parking-v0`` and the other tasks. The observation
holds the last H actions, oldest first, as in Rothfuss et al., arXiv 2403.16644.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from carlab.core.car import Car
from carlab.core.clock import Pacer
from carlab.core.errors import ConfigError
from carlab.core.geofence import contains
from carlab.core.observation import STATE_FEATURES, ActionHistory, encode, feature_size
from carlab.core.outcome import EndReason
from carlab.core.quantities import Action, FloatArray, Observation, Reality
from carlab.core.task import Task
from carlab.core.task_choice import choose_task

if TYPE_CHECKING:
    from carlab.cars import CarFile

# Bounds of the observation space, beyond the range of a car of this size; observations are clipped to them.
STATE_BOUNDS = np.array([20.0, 20.0, 1.0, 1.0, 20.0, 20.0, 60.0])


class CarEnv(gym.Env[NDArray[np.float32], NDArray[np.float32]]):
    """A car and a task.

    Action: Box(2,) float32, steering and throttle in [-1, 1]. Observation: Box(7 + 2 H,) float32, the features of
    ``carlab.core.observation``. ``terminated`` is the task's termination; ``truncated`` follows the last tick or the
    exit from the arena. ``info["end_reason"]`` names the reason,
    ``info["summary"]`` has the task's figures of the episode.
    """

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(self, car_of_seed: Callable[[int], Car], task: Task, period_s: float) -> None:
        self._car_of_seed = car_of_seed
        self._task = task
        self._period_s = period_s
        self._history = ActionHistory(task.history_length)
        self._car: Car | None = None
        self._pacer: Pacer | None = None
        self._features = np.zeros(feature_size(task.history_length))
        self._times_s: list[float] = []
        self._states: list[FloatArray] = []
        self._steps = 0
        high = np.concatenate([STATE_BOUNDS, np.ones(2 * task.history_length)]).astype(np.float32)
        self.observation_space = gym.spaces.Box(-high, high, dtype=np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,), dtype=np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Put the car at a start pose drawn by the task; returns features (7 + 2 H,). A seed also seeds the sensors.

        Raises:
            ConfigError: the car is not simulated.
        """
        super().reset(seed=seed)
        if self._car is None or seed is not None:
            self.close()
            car = self._car_of_seed(int(self.np_random.integers(2**31)))
            if car.reality is not Reality.SIMULATED:
                raise ConfigError(
                    f"'{car.name}' is not a simulated car; drive it with run_episode, which has a safety gate."
                )
            self._car = car
            self._car.open()
        self._car.stop(planned=True)
        self._car.place(self._task.sample_start(self.np_random))
        self._car.arm()
        self._history.reset()
        self._pacer = Pacer(self._car.clock, self._period_s)
        self._pacer.start()
        self._steps = 0
        self._times_s, self._states = [], []
        self._observe()
        return self._output(), self._info(is_last=False)

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Send the clipped action (2,) and wait one period.

        Returns:
            Features (7 + 2 H,), reward, ``terminated``, ``truncated`` and the dictionary of information.
        """
        if self._car is None or self._pacer is None:
            raise gym.error.ResetNeeded("Call reset() before step().")
        before = self._features
        sent = self._car.command(Action.from_array(np.clip(action, -1.0, 1.0)))
        self._history.push(sent)
        self._pacer.wait()
        observation = self._observe()
        self._steps += 1
        reward = float(self._task.reward(before, sent.to_array(), self._features))
        terminated = bool(self._task.terminated(self._features))
        outside = bool(self._task.arena_m) and not contains(
            self._task.arena_m, observation.state.x_m, observation.state.y_m
        )
        truncated = not terminated and (outside or self._steps >= self._task.max_ticks)
        info = self._info(is_last=terminated or truncated)
        if terminated or truncated:
            task_end = EndReason.GOAL_REACHED if bool(self._task.success(self._features)) else EndReason.TASK_ENDED
            reason = task_end if terminated else EndReason.GEOFENCE if outside else EndReason.COMPLETED
            info["end_reason"] = reason.name
        return self._output(), reward, terminated, truncated, info

    def close(self) -> None:
        """Close the car. Idempotent."""
        if self._car is not None:
            self._car.close()
            self._car = None

    def _observe(self) -> Observation:
        assert self._car is not None
        observation = self._car.observe()
        self._features = encode(observation.state.to_array(), self._history.rows)
        self._times_s.append(self._car.clock.now_s())
        self._states.append(observation.state.to_array())
        return observation

    def _output(self) -> NDArray[np.float32]:
        clipped = self._features.copy()
        clipped[:STATE_FEATURES] = np.clip(clipped[:STATE_FEATURES], -STATE_BOUNDS, STATE_BOUNDS)
        return clipped.astype(np.float32)

    def _info(self, *, is_last: bool) -> dict[str, Any]:
        """The state; after the last step also the task's summary of the episode."""
        info: dict[str, Any] = {"state": self._states[-1]}
        if is_last:
            info["summary"] = self._task.summary(np.array(self._times_s), np.array(self._states))
        return info


def make_env(task: str | Task = "parking", vehicle: str | Path | CarFile | None = None) -> CarEnv:
    """Create the environment of a task and a simulated car.

    Args:
        task: name, FILE.py:CLASS, or an object.
        vehicle: car file; None: the default car.

    Raises:
        ConfigError: an unknown task, or an error in the task or in the car file.
    """
    from carlab.cars import choose_car

    def car_of_seed(seed: int) -> Car:
        return choose_car("sim", vehicle=vehicle, seed=seed).car

    period_s = choose_car("sim", vehicle=vehicle).control_period_s
    return CarEnv(car_of_seed, choose_task(task).load().at_period(period_s), period_s)
