"""Write a task: drive 1 m forwards and stop there. Takes two seconds.

A task defines start pose, reward, termination and arena. Reward and termination take arrays (NumPy or torch), so that
learned and simulated cars use the same functions.
"""

import argparse
from dataclasses import dataclass
from typing import Any

import numpy as np
from array_api_compat import array_namespace

import carlab
from carlab.core.geofence import rectangle
from carlab.core.policy import PolicyInput


@dataclass(frozen=True)
class StopAfterOneMetre:
    """Features are x, y [m], sin yaw, cos yaw, vx, vy [m/s], yaw rate [rad/s], then past actions."""

    name: str = "stop_after_1_m"
    history_length: int = 3
    max_ticks: int = 120
    arena_m: tuple[tuple[float, float], ...] = rectangle(-2.0, 4.0, -2.0, 2.0)
    goal: tuple[float, float, float] = (1.0, 0.0, 0.0)
    path_m: tuple[tuple[float, float], ...] = ()

    def sample_start(self, rng: np.random.Generator) -> carlab.CarState:
        return carlab.CarState(y_m=rng.uniform(-0.05, 0.05))

    def reward(self, features: Any, action: Any, next_features: Any) -> Any:
        xp = array_namespace(next_features)
        return 1.0 - xp.abs(next_features[..., 0] - self.goal[0])

    def terminated(self, next_features: Any) -> Any:
        xp = array_namespace(next_features)
        is_near = xp.abs(next_features[..., 0] - self.goal[0]) < 0.05
        return is_near & (xp.abs(next_features[..., 4]) < 0.05)

    def summary(self, final: carlab.CarState) -> dict[str, float]:
        return {"distance_m": abs(final.x_m - self.goal[0]), "speed_mps": final.speed_mps}


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
    print(
        f"{episode.reason.name}: {episode.summary['distance_m']:.2f} m from the line after {episode.data.ticks} ticks"
    )


if __name__ == "__main__":
    main()
