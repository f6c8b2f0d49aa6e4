"""Write a task: drive 1 m forwards and stop there, and keep out of a disc. Takes two seconds.

A task defines start, reward, end and success. Its functions take arrays (NumPy or torch), so that real, emulated,
simulated and learned cars use the same functions. Check, learn and drive it without a change of the package:

    carlab check --task examples/write_task.py:StopAfterOneMetre
    carlab learn --task examples/write_task.py:StopAfterOneMetre
"""

import argparse
from typing import Any

import numpy as np
from array_api_compat import array_namespace

import carlab
from carlab.core.geofence import rectangle
from carlab.core.keep_out import Disc
from carlab.core.policy import PolicyInput
from carlab.core.task import Task


class StopAfterOneMetre(Task):
    """Features are x, y [m], sin yaw, cos yaw, vx, vy [m/s], yaw rate [rad/s], then past actions."""

    name = "stop_after_1_m"
    max_ticks = 120
    arena_m = rectangle(-2.0, 4.0, -2.0, 2.0)
    goal = (1.0, 0.0, 0.0)
    keep_out = (Disc(0.5, 0.6, 0.3),)

    def sample_start(self, rng: np.random.Generator) -> carlab.CarState:
        return carlab.CarState(y_m=rng.uniform(-0.05, 0.05))

    def reward(self, features: Any, action: Any, next_features: Any) -> Any:
        """Progress, 1 at 1 m/s, and 10 for success: a reward for each tick near the goal would delay the end."""
        progress_m = self.distance_m(features) - self.distance_m(next_features)
        return 30.0 * progress_m + 10.0 * self.success(next_features)

    def success(self, features: Any) -> Any:
        xp = array_namespace(features)
        return (self.distance_m(features) < 0.05) & (xp.abs(features[..., 4]) < 0.05)

    def terminated(self, next_features: Any) -> Any:
        return self.success(next_features)

    def distance_m(self, features: Any) -> Any:
        xp = array_namespace(features)
        return xp.abs(features[..., 0] - self.goal[0])


class Brake:
    """Throttle by distance and speed (a PD controller)."""

    name = "brake"

    def reset(self) -> None:
        pass

    def act(self, view: PolicyInput) -> carlab.Action:
        state = view.observation.state
        return carlab.Action(0.0, min(max(0.6 * (1.0 - state.x_m) - 0.4 * state.vx_mps, -0.5), 0.5))


def main() -> None:
    """Drive the task once and print the end reason."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", default="runs")
    run = carlab.drive("sim", policy=Brake(), task=StopAfterOneMetre(), out=parser.parse_args().out)
    (episode,) = run.episodes
    print(f"{episode.reason.name}: {episode.summary} after {episode.data.ticks} ticks")


if __name__ == "__main__":
    main()
